//! Flights in real time are repeated from their recordings: what flies is what is evaluated.

use std::path::Path;

use flockeye_contract::{JournalEntry, JournalHeader, JournalKind, ViewHeader};
use flockeye_recording::channel::VIEW_IMAGES;
use flockeye_recording::file::RecordingFile;
use flockeye_recording::message::decode;
use flockeye_recording::{RecordedMessage, RecordingReader, RecordingWriter};
use flockeye_tests::{SMALL_FLIGHT, Scratch, run};

use crate::explaining::flown_without_losses;
use crate::recording::{forget_all_markers, layout, read, text};

/// The report of a replay.
struct Said {
    /// Messages that were compared.
    messages: u64,
    /// Frames that ended.
    frames: u64,
    /// Background passes that were answered.
    answers: u64,
    whole: String,
}

/// Replays a recording, in which nothing may differ.
fn same(recording: &Path) -> Said {
    let (is_same, whole) = run(&["replay", text(recording), "--stage", "fusion"]);
    assert!(is_same && whole.contains("are the same, byte by byte"), "{whole}");
    let numbers: Vec<u64> = whole.split_whitespace().filter_map(|word| word.parse().ok()).collect();
    let [messages, frames, answers] = numbers[..3] else { panic!("{whole}") };
    Said { messages, frames, answers, whole }
}

impl Said {
    fn assert_complete(&self) {
        for lack in ["the comparison ends", "more messages of fusion"] {
            assert!(!self.whole.contains(lack), "{}", self.whole);
        }
    }
}

/// The messages of a recording's journal.
fn journals(recording: &Path) -> Vec<Vec<JournalEntry>> {
    let (messages, _) = read(recording, "flockeye/journal");
    let mut next = 0;
    let mut journals = Vec::new();
    for message in messages {
        let header: JournalHeader = bytemuck::pod_read_unaligned(&message.header);
        assert_eq!(header.first, next, "it is without gaps");
        let entries = message.items.chunks_exact(size_of::<JournalEntry>());
        let entries: Vec<JournalEntry> = entries.map(bytemuck::pod_read_unaligned).collect();
        next += entries.len() as u64;
        journals.push(entries);
    }
    journals
}

/// Views that fusion heard.
fn heard_views(journals: &[Vec<JournalEntry>]) -> Vec<JournalEntry> {
    let is_view = |entry: &&JournalEntry| entry.kind == JournalKind::View.code();
    journals.iter().flatten().filter(is_view).copied().collect()
}

/// Whether a message of `flockeye/view` is the view that an entry names.
fn is_view(message: &RecordedMessage, entry: &JournalEntry) -> bool {
    if message.channel.topic != "/flockeye/view" {
        return false;
    }
    let found = decode(&layout("flockeye/view"), &message.bytes).expect("a view");
    let header: ViewHeader = bytemuck::pod_read_unaligned(&found.header);
    header.stamp.order() == entry.order()
        && (header.view_index, header.attempt, header.worker)
            == (entry.view_index, entry.attempt, entry.worker)
}

/// Copies a recording without the messages that `is_lost` names.
pub(crate) fn copy_without(
    from: &Path,
    to: &Path,
    mut is_lost: impl FnMut(&RecordedMessage) -> bool,
) {
    let mut reader = RecordingReader::open(from).expect("it is a recording");
    let file = RecordingFile::create(to).expect("it is new");
    let mut writer = RecordingWriter::begin(file, reader.about()).expect("it can be written");
    while let Some(message) = reader.next_message().expect("it can be read") {
        if !is_lost(&message) {
            let (kind, sequence) = (&message.channel, message.sequence);
            let written = writer.write_as(kind, sequence, message.utc_ns, &message.bytes);
            written.expect("it can be written");
        }
    }
    writer.finish().expect("it can be written");
}

#[test]
fn a_flight_in_real_time_gives_the_same_poses_again() {
    let scratch = Scratch::new("repeated");
    let set = [
        SMALL_FLIGHT,
        &["simulator.frames=60", "simulator.frames_per_second=15", "recording.frames=views"],
    ]
    .concat();
    let recording = flown_without_losses("repeated", &scratch, &set);
    let said = same(&recording);
    said.assert_complete();
    assert!(said.messages > 30 && said.frames > 10, "{}", said.whole);

    let journals = journals(&recording);
    // A view that the recorder did not get.
    let heard = heard_views(&journals);
    let missing = heard[heard.len() / 2];
    let (blind, mut lost) = (scratch.path("blind.mcap"), None);
    copy_without(&recording, &blind, |message| {
        if is_view(message, &missing) {
            lost = Some(message.sequence);
        }
        // Its pixels have its number.
        let is_of_views = ["/flockeye/view", VIEW_IMAGES].contains(&message.channel.topic.as_str());
        is_of_views && Some(message.sequence) == lost
    });
    let partly = same(&blind);
    let JournalEntry { view_index, sequence, .. } = missing;
    let named = format!("the comparison ends there: view {view_index} of frame {sequence}, which");
    assert!(partly.whole.contains(&named), "{}", partly.whole);
    assert!(partly.whole.contains(", which fusion heard, is not in"), "{}", partly.whole);
    assert!(partly.whole.contains("more messages of fusion"), "{}", partly.whole);
    assert!(partly.messages < said.messages, "{}", partly.whole);

    // A part of the journal that it did not get.
    let (gap, mut count) = (scratch.path("gap.mcap"), 0);
    copy_without(&recording, &gap, |message| {
        let is_journal = message.channel.topic == "/flockeye/journal";
        count += usize::from(is_journal);
        is_journal && count == journals.len() / 2
    });
    let partly = same(&gap);
    assert!(partly.whole.contains("entries of fusion's journal are not in"), "{}", partly.whole);
    assert!(0 < partly.messages && partly.messages < said.messages, "{}", partly.whole);

    // None at all: as an older version recorded.
    let old = scratch.path("old.mcap");
    copy_without(&recording, &old, |message| message.channel.topic == "/flockeye/journal");
    let (is_same, refusal) = run(&["replay", text(&old)]);
    assert!(!is_same && refusal.contains("has no journal of fusion"), "{refusal}");
    assert!(refusal.contains("Cure: record with"), "{refusal}");

    // Nobody has decoded a marker.
    let changed = scratch.path("changed.mcap");
    forget_all_markers(&recording, &changed, 0);
    let (is_same, refusal) = run(&["replay", text(&changed)]);
    assert!(!is_same && refusal.contains("messages of "), "{refusal}");
}

/// Gusts, and neighbours so far away that some are sought in the background, whose answers come
/// when they come.
#[test]
fn background_passes_in_real_time_are_repeated() {
    let scratch = Scratch::new("repeated-far");
    let far = [
        "simulator.frames=60",
        // Other tests may want the processors too.
        "simulator.frames_per_second=8",
        "recording.frames=views",
        "simulator.seed=904",
        "simulator.neighbours=2",
        "simulator.distance_m=[0.8, 2.4]",
        "simulator.tilt_deg=10",
        "simulator.yaw_swing_deg_s=40",
        "bodies.list=[{name: alpha}, {name: bravo, first_id: 17}]",
        "camera.width=1280",
        "camera.height=640",
        "gateway.enabled=false",
    ];
    let recording = flown_without_losses("repeated-far", &scratch, &far);
    let journals = journals(&recording);
    let is_answer = |entry: &&JournalEntry| entry.kind == JournalKind::Background.code();
    let answers = journals.iter().flatten().filter(is_answer).count();
    let said = same(&recording);
    said.assert_complete();
    assert!(answers > 0, "no background pass ran: {}", said.whole);
    assert_eq!(said.answers, answers as u64, "{}", said.whole);
    assert!(said.messages > 30, "{}", said.whole);
}
