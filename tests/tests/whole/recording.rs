//! Recordings of running pipelines: what is in them, who reads them, and what becomes of them when
//! the recorder is killed or the disk is full.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use flockeye_contract::{DetectionHeader, FrameEnds, Track, TrackState, Tracks};
use flockeye_recording::file::RecordingFile;
use flockeye_recording::message::{decode, encode};
use flockeye_recording::{
    ContractMessage, Ending, RecordingReader, RecordingWriter, TopicLayout, layouts,
};
use flockeye_runtime::recorders;
use flockeye_tests::onlooker::{self, Gated};
use flockeye_tests::{
    Flight, SMALL_FLIGHT, Scratch, WATCHDOG, flockeye, run, small_flight, succeeds, unique,
};
use rustix::process::{Signal, getpgid, kill_process};
use serde_json::Value;

use crate::python::python;

/// `flockeye record` beside a flight, once it has joined.
fn recorder(flight: &mut Flight, arguments: &[&str]) -> Flight {
    let mut command = Command::new(flockeye());
    command.arg("record").args(arguments).args(["--instance", flight.instance.name()]);
    joined(flight, command)
}

fn joined(flight: &mut Flight, command: Command) -> Flight {
    let instance = flight.instance.clone();
    let count = || recorders::running(&instance).len();
    let before = count();
    let mut recorder = Flight::launch(&unique("recorder"), command);
    let start = Instant::now();
    while count() == before {
        let said = recorder.output();
        assert!(!recorder.has_ended() && start.elapsed() < WATCHDOG, "it does not join:\n{said}");
        std::thread::sleep(Duration::from_millis(5));
    }
    recorder
}

pub(crate) fn layout(service: &str) -> TopicLayout {
    layouts().into_iter().find(|layout| layout.service == service).expect("there is this topic")
}

/// The messages of a topic, and how the recording ends.
pub(crate) fn read(path: &Path, service: &str) -> (Vec<ContractMessage>, Ending) {
    let layout = layout(service);
    let mut reader = RecordingReader::open(path).unwrap_or_else(|error| panic!("{error}"));
    let mut found = Vec::new();
    while let Some(message) = reader.next_message().unwrap_or_else(|error| panic!("{error}")) {
        if message.channel.topic == layout.channel() {
            found.push(decode(&layout, &message.bytes).expect("it is as it was recorded"));
        }
    }
    (found, reader.ending().expect("it was read to its end"))
}

pub(crate) fn text(path: &Path) -> &str {
    path.to_str().expect("a plain path")
}

/// Every frame of a lossless flight is in the recording, bit by bit as an onlooker sees it. Other
/// people's tools read the same poses as `--poses` writes.
#[test]
fn every_frame_is_recorded_and_other_peoples_tools_read_it() {
    let scratch = Scratch::new("recorded");
    let (out, poses) = (scratch.path("flight.mcap"), scratch.path("poses.csv"));
    let set = small_flight(&["simulator.frames=40"]);
    let arguments = ["--profile", "repeat", "--poses", text(&poses)];
    let mut gated = Gated::start("recorded", &scratch, &arguments, &set);
    let mut recorder = recorder(&mut gated.flight, &[text(&out), "--frames", "every 10"]);
    let mut ports = onlooker::join(&mut gated.flight);
    let mut tracks = onlooker::subscribe::<Tracks>(&mut gated.flight, &mut ports);
    let mut ends = onlooker::subscribe::<FrameEnds>(&mut gated.flight, &mut ports);
    gated.open();
    let (mut seen_tracks, mut seen_ends) = (Vec::new(), Vec::new());
    let start = Instant::now();
    let mut has_ended = false;
    let looked = ports.attend(|| {
        let had_ended = has_ended;
        while let Some(message) = tracks.receive()? {
            seen_tracks.push(ContractMessage {
                header: bytemuck::bytes_of(&message.header).to_vec(),
                items: bytemuck::cast_slice(message.items()).to_vec(),
                payload_bytes: 0,
            });
        }
        while let Some(message) = ends.receive()? {
            let header = bytemuck::bytes_of(&message.header).to_vec();
            seen_ends.push(ContractMessage { header, ..ContractMessage::default() });
        }
        assert!(start.elapsed() < WATCHDOG, "it does not end:\n{}", gated.flight.output());
        has_ended = gated.flight.has_ended();
        Ok((!had_ended).then_some(Duration::from_millis(20)))
    });
    looked.expect("messages can be waited for");
    drop((tracks, ends, ports));
    assert!(gated.flight.wait().success(), "{}", gated.flight.output());
    assert!(recorder.wait().success(), "{}", recorder.output());
    let said = recorder.output();
    assert!(said.contains("nothing is missing"), "{said}");
    assert_eq!(seen_ends.len(), 40, "{}", gated.flight.output());
    assert_eq!(read(&out, "flockeye/track"), (seen_tracks, Ending::Whole));
    assert_eq!(read(&out, "flockeye/frame_end").0, seen_ends);
    assert_eq!(read(&out, "flockeye/frame").0.len(), 40);
    assert_eq!(read(&out, "flockeye/rotation").0.len(), 40);
    gated.flight.assert_nothing_left();

    let Some(python) = python() else { return };
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/src/recording.py");
    let read = Command::new(python).arg(script).arg(&out).arg(&poses).output();
    let read = read.expect("Python can be started");
    let said = String::from_utf8_lossy(&read.stdout).into_owned();
    assert!(read.status.success(), "{said}\n{}", String::from_utf8_lossy(&read.stderr));
    let report: Value = serde_json::from_str(said.trim()).expect("one JSON object");
    assert!(report["compared"].as_u64() > Some(20), "{report}");
    let topics = &report["topics"];
    assert_eq!(topics["/flockeye/frame/image"], 4, "{report}");
    for topic in ["plan", "view", "detection", "truth", "health"] {
        assert!(topics[format!("/flockeye/{topic}")].as_u64() > Some(0), "{topic} in {report}");
    }
}

/// Fusion alone, given what it got, says what it said, byte by byte; given something else, it says
/// where it differs.
#[test]
fn a_replayed_fusion_says_the_same() {
    let scratch = Scratch::new("replayed");
    let out = scratch.path("flight.mcap");
    let set = small_flight(&["simulator.frames=25"]);
    let mut gated = Gated::start("replayed", &scratch, &["--profile", "repeat"], &set);
    let mut recorder = recorder(&mut gated.flight, &[text(&out), "--frames", "views"]);
    gated.open();
    assert!(gated.flight.wait().success(), "{}", gated.flight.output());
    assert!(recorder.wait().success(), "{}", recorder.output());
    assert!(recorder.output().contains("nothing is missing"), "{}", recorder.output());
    let (is_same, said) = run(&["replay", text(&out), "--stage", "fusion"]);
    assert!(is_same && said.contains("of 25 frames are the same, byte by byte"), "{said}");
    gated.flight.assert_nothing_left();

    // OpenCV sees in the recorded pixels what Flockeye's detector saw.
    if let Some(python) = python() {
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/src/views.py");
        let looked = Command::new(python).arg(script).arg(&out).arg("DICT_5X5_250").output();
        let looked = looked.expect("Python can be started");
        let said = String::from_utf8_lossy(&looked.stdout).into_owned();
        assert!(looked.status.success(), "{said}\n{}", String::from_utf8_lossy(&looked.stderr));
        let report: Value = serde_json::from_str(said.trim()).expect("one JSON object");
        let count = |name: &str| report[name].as_u64().expect("a count");
        // OpenCV does not find small markers.
        assert!(count("found") > 10, "{report}");
        assert!(report["median_px"].as_f64() < Some(1.0), "{report}");
    }

    // Nobody has decoded a marker.
    let changed = scratch.path("changed.mcap");
    forget_all_markers(&out, &changed, 0);
    let (is_same, said) = run(&["replay", text(&changed)]);
    assert!(!is_same, "{said}");
    let is_told = |wanted: &&str| said.contains(*wanted);
    assert!(["recorded and given: ", "a step led to"].iter().any(is_told), "{said}");

    // More hits than markers.
    let lying = scratch.path("lying.mcap");
    forget_all_markers(&out, &lying, 7);
    let (is_same, said) = run(&["replay", text(&lying)]);
    assert!(!is_same && said.contains("flockeye/detection breaks the contract. Cure:"), "{said}");
}

#[test]
fn a_recording_that_was_split_is_replayed_to_its_end() {
    let scratch = Scratch::new("split");
    let out = scratch.path("flight.mcap");
    let set = small_flight(&["simulator.frames=12"]);
    let mut gated = Gated::start("split", &scratch, &["--profile", "repeat"], &set);
    let arguments = [text(&out), "--frames", "views", "--split", "5MB"];
    let mut recorder = recorder(&mut gated.flight, &arguments);
    gated.open();
    assert!(gated.flight.wait().success(), "{}", gated.flight.output());
    assert!(recorder.wait().success(), "{}", recorder.output());
    gated.flight.assert_nothing_left();
    assert!(scratch.path("flight-1.mcap").exists(), "{}", recorder.output());
    let (is_same, said) = run(&["replay", text(&out)]);
    assert!(is_same && said.contains("of 12 frames are the same, byte by byte"), "{said}");
}

/// Copies a recording, with no marker in any detection, and these `hits` in its header.
pub(crate) fn forget_all_markers(from: &Path, to: &Path, hits: u32) {
    let layout = layout("flockeye/detection");
    let mut reader = RecordingReader::open(from).expect("it is a recording");
    let file = RecordingFile::create(to).expect("it is new");
    let mut writer = RecordingWriter::begin(file, reader.about()).expect("it can be written");
    while let Some(mut message) = reader.next_message().expect("it can be read") {
        if message.channel.topic == layout.channel() {
            let mut found = decode(&layout, &message.bytes).expect("a detection");
            let header: DetectionHeader = bytemuck::pod_read_unaligned(&found.header);
            let header = DetectionHeader { hits, ..header };
            found.header = bytemuck::bytes_of(&header).to_vec();
            found.items.clear();
            message.bytes = encode(&layout, &found).expect("it is one still");
        }
        let (kind, sequence) = (&message.channel, message.sequence);
        writer.write_as(kind, sequence, message.utc_ns, &message.bytes).expect("it can be written");
    }
    writer.finish().expect("it can be written");
}

/// Recordings that begin later, and those that lack something, cannot be replayed: it says so.
#[test]
fn what_cannot_be_replayed_says_why() {
    let scratch = Scratch::new("not-replayed");
    let out = scratch.path("flight.mcap");
    let mut flight = Flight::with_poses("not-replayed", &[], SMALL_FLIGHT);
    let mut recorder = recorder(&mut flight, &[text(&out), "--for", "1s", "--frames", "views"]);
    assert!(recorder.wait().success(), "{}", recorder.output());
    let (is_well, said) = run(&["replay", text(&out)]);
    assert!(!is_well && said.contains("entries after fusion's journal"), "{said}");
    assert!(said.contains("Cure: record from the first frame on"), "{said}");
    flight.end_by(Signal::INT);
    let setting = format!("recording.folder={}", scratch.path("blind").display());
    let set = [SMALL_FLIGHT, &[setting.as_str(), "simulator.frames=8"]].concat();
    let mut flight = Flight::start("no-pixels", &["--profile", "repeat"], &set);
    assert!(flight.wait().success(), "{}", flight.output());
    let mut files = std::fs::read_dir(scratch.path("blind")).expect("it was made");
    let blind = files.next().expect("one recording").expect("it can be read").path();
    let (is_well, said) = run(&["replay", text(&blind)]);
    assert!(!is_well && said.contains("a view without its pixels. Cure:"), "{said}");
    flight.assert_nothing_left();
    let none = scratch.path("none.mcap");
    let (is_well, said) = run(&["replay", text(&none)]);
    assert!(!is_well && said.contains("none.mcap: No such file"), "{said}");
}

/// A recorder that is killed harms no stage, and leaves what it had written a second before.
#[test]
fn a_killed_recorder_leaves_a_recording_that_opens() {
    let scratch = Scratch::new("rec-killed");
    let (out, good) = (scratch.path("flight.mcap"), scratch.path("good.mcap"));
    let mut flight = Flight::with_poses("rec-killed", &[], SMALL_FLIGHT);
    let mut killed = recorder(&mut flight, &[text(&out)]);
    let name = flight.instance.name().to_owned();
    let (is_well, said) = run(&["record", text(&out), "--instance", &name]);
    assert!(!is_well && said.contains("is being written by another recorder. Cure:"), "{said}");
    let start = Instant::now();
    // A recording can also be read while it is written.
    while read_any(&out) < 5 {
        assert!(start.elapsed() < WATCHDOG, "nothing is written:\n{}", killed.output());
        std::thread::sleep(Duration::from_millis(100));
    }
    killed.signal(Signal::KILL);
    assert!(!killed.wait().success());
    let (ends, ending) = read(&out, "flockeye/frame_end");
    assert_eq!(ending, Ending::Cut);
    assert!(!ends.is_empty());
    let (is_well, said) = run(&["record", "--recover", text(&out), text(&good)]);
    assert!(is_well && said.contains("it had been cut off"), "{said}");
    assert_eq!(read(&good, "flockeye/frame_end"), (ends, Ending::Whole));
    // The file of before is kept, and the flight goes on.
    let (is_well, said) = run(&["record", text(&out), "--instance", &name]);
    assert!(!is_well && said.contains("is there already. Cure:"), "{said}");
    flight.signal(Signal::INT);
    assert!(flight.wait().success(), "{}", flight.output());
    assert!(!flight.output().contains("is started again"), "{}", flight.output());
    flight.assert_nothing_left();
}

/// A file that may not grow any more is as a full disk that others have filled.
#[test]
fn a_file_that_cannot_grow_ends_the_recording_and_stays_readable() {
    let scratch = Scratch::new("rec-full");
    let out = scratch.path("flight.mcap");
    let mut flight = Flight::with_poses("rec-full", &[], SMALL_FLIGHT);
    let mut command = Command::new("prlimit");
    command.arg("--fsize=4000000").arg(flockeye()).arg("record").arg(&out);
    command.args(["--frames", "views", "--instance", flight.instance.name()]);
    let mut recorder = joined(&mut flight, command);
    assert!(!recorder.wait().success(), "{}", recorder.output());
    let said = recorder.output();
    assert!(said.contains("flight.mcap: File too large"), "{said}");
    let (views, ending) = read(&out, "flockeye/view");
    assert_eq!(ending, Ending::Cut);
    assert!(!views.is_empty());
    flight.end_by(Signal::INT);
}

/// The past is kept in memory, and written on request.
#[test]
fn what_came_before_is_written_on_request() {
    let scratch = Scratch::new("rec-ring");
    let out = scratch.path("ring.mcap");
    let mut flight = Flight::with_poses("rec-ring", &[], SMALL_FLIGHT);
    let name = flight.instance.name().to_owned();
    let (is_well, said) = run(&["record", "--now", "--instance", &name]);
    assert!(!is_well && said.contains("keeps the past. Cure:"), "{said}");
    // A recorder that writes everything has nothing to add.
    let mut other = recorder(&mut flight, &[text(&scratch.path("all.mcap"))]);
    let (is_well, said) = run(&["record", "--now", "--instance", &name]);
    assert!(!is_well && said.contains("keeps the past. Cure:"), "{said}");
    let mut recorder = recorder(&mut flight, &[text(&out), "--trigger", "request", "--past", "2s"]);
    std::thread::sleep(Duration::from_secs(3));
    let (is_well, said) = run(&["record", "--now", "--instance", &name]);
    assert!(is_well && said.contains("asked to write what came before: 1"), "{said}");
    recorder.wait_for("what came before is in");
    assert!(!out.exists(), "only what was asked for is written");
    let written: Vec<PathBuf> = std::fs::read_dir(out.parent().expect("a folder"))
        .expect("it is there")
        .map(|entry| entry.expect("it can be read").path())
        .filter(|path| text(path).contains("ring-20"))
        .collect();
    assert_eq!(written.len(), 1, "{written:?}");
    let mut reader = RecordingReader::open(&written[0]).expect("it is a recording");
    let mut times = Vec::new();
    while let Some(message) = reader.next_message().expect("it can be read") {
        if message.channel.topic == "/flockeye/health" {
            times.push(message.utc_ns);
        }
    }
    assert_eq!(reader.ending(), Some(Ending::Whole));
    let (first, last) = (times[0], times[times.len() - 1]);
    assert!(last - first > 500_000_000 && last - first <= 2_000_000_000, "{} ns", last - first);
    flight.signal(Signal::INT);
    assert!(flight.wait().success(), "{}", flight.output());
    assert!(recorder.wait().success(), "{}", recorder.output());
    assert!(other.wait().success(), "{}", other.output());
    flight.assert_nothing_left();
}

/// A neighbour of which too little is heard: one of two detectors is stopped.
#[test]
fn what_led_to_a_lost_track_is_written() {
    let scratch = Scratch::new("rec-lost");
    let out = scratch.path("lost.mcap");
    // A track that two frames in a row do not measure is lost.
    let blind = ["stages.detection.replicas=2", "fusion.coast_s=0.05", "fusion.align=false"];
    let set: Vec<&str> = SMALL_FLIGHT.iter().copied().chain(blind).collect();
    let mut flight = Flight::with_poses("rec-lost", &[], &set);
    let mut recorder = recorder(&mut flight, &[text(&out), "--trigger", "lost"]);
    let name = flight.instance.name().to_owned();
    // Some frames then have no record of the neighbour's region.
    succeeds(&["stop", "detection.1", "--instance", &name]);
    recorder.wait_for("what came before is in");
    recorder.signal(Signal::INT);
    assert!(recorder.wait().success(), "{}", recorder.output());
    let files = std::fs::read_dir(out.parent().expect("a folder")).expect("it is there");
    let file = files.map(|entry| entry.expect("it can be read").path());
    let file = file.into_iter().find(|path| text(path).contains("lost-20")).expect("it is written");
    let (tracks, _) = read(&file, "flockeye/track");
    let is_lost = |message: &ContractMessage| {
        let mut tracks = message.items.chunks_exact(size_of::<Track>());
        tracks.any(|track| {
            bytemuck::pod_read_unaligned::<Track>(track).state == TrackState::Lost.code()
        })
    };
    let [before @ .., last] = tracks.as_slice() else { panic!("no tracks in {file:?}") };
    assert!(is_lost(last) && !before.iter().any(is_lost), "it ends where a track is lost");
    flight.end_by(Signal::INT);
}

#[test]
fn what_cannot_be_recorded_leaves_nothing() {
    let scratch = Scratch::new("rec-nobody");
    let out = scratch.path("flight.mcap");
    let (is_well, said) = run(&["record", text(&out), "--instance", "nobody-here"]);
    assert!(!is_well && said.contains("no pipeline 'nobody-here' runs here"), "{said}");
    assert!(!out.exists());
    let text_file = scratch.path("notes.txt");
    std::fs::write(&text_file, "no recording").expect("it can be written");
    let (is_well, said) = run(&["record", "--recover", text(&text_file), text(&out)]);
    assert!(!is_well && said.contains("is no MCAP file") && said.contains("Cure:"), "{said}");
    assert!(!out.exists());
    let (is_well, said) = run(&["record", text(&out), "--frames", "some"]);
    assert!(!is_well && said.contains("is not none, views, camera, or"), "{said}");
}

/// With `recording.folder` each flight is recorded from its first frame on, and a recorder that is
/// killed begins another file.
#[test]
fn a_flight_is_recorded_by_configuration() {
    let scratch = Scratch::new("rec-set");
    let folder = scratch.path("recordings");
    let setting = format!("recording.folder={}", folder.display());
    let (is_well, said) = run(&["check", "--set", &setting]);
    assert!(
        is_well && said.contains(&format!("recorder: everything, to {}", folder.display())),
        "{said}"
    );
    assert!(!folder.exists());
    let set = small_flight(&[setting.as_str()]);
    let mut flight = Flight::with_poses("rec-set", &[], &set);
    let recordings = || -> Vec<PathBuf> {
        let entries = std::fs::read_dir(&folder).expect("it was made");
        let mut paths: Vec<_> = entries.map(|entry| entry.expect("it is there").path()).collect();
        paths.sort();
        paths
    };
    let [first] = recordings().try_into().expect("one file");
    assert!(text(&first).contains(flight.instance.name()), "{first:?}");
    let start = Instant::now();
    while read_any(&first) == 0 {
        assert!(start.elapsed() < WATCHDOG, "nothing is written:\n{}", flight.output());
        std::thread::sleep(Duration::from_millis(50));
    }
    let [pid] = recorders::running(&flight.instance).try_into().expect("one records");
    // Ctrl-C in a terminal reaches the launcher's group, and the recorder must outlive the stages.
    assert_eq!(getpgid(Some(pid)).expect("it runs"), pid);
    kill_process(pid, Signal::KILL).expect("it runs");
    flight.wait_for("the recorder is started again");
    let start = Instant::now();
    while recordings().len() < 2 || read_any(&recordings()[1]) == 0 {
        assert!(start.elapsed() < WATCHDOG, "no second file:\n{}", flight.output());
        std::thread::sleep(Duration::from_millis(100));
    }
    flight.signal(Signal::INT);
    assert!(flight.wait().success(), "{}", flight.output());
    assert!(flight.output().contains("messages are in 1 files"), "{}", flight.output());
    // The first began before the first frame, and was cut off; the second is whole.
    let (frames, ending) = read(&first, "flockeye/frame");
    assert_eq!(ending, Ending::Cut);
    let frame: flockeye_contract::FrameHeader = bytemuck::pod_read_unaligned(&frames[0].header);
    assert_eq!(frame.stamp.sequence, 0);
    let (frames, ending) = read(&recordings()[1], "flockeye/frame");
    assert_eq!(ending, Ending::Whole);
    assert!(!frames.is_empty(), "the dead recorder's place among the readers of frames is free");
    flight.assert_nothing_left();
}

/// The present number of `frame_end` messages in a file; 0 while its beginning is not whole.
fn read_any(path: &Path) -> usize {
    RecordingReader::open(path).map_or(0, |_| read(path, "flockeye/frame_end").0.len())
}
