//! Gives the core of fusion what it got in a recorded flight, and compares what it gives with what it gave.
//!
//! In a lossless flow nothing that fusion says may depend on who is faster, so the order of the recording is as good
//! as the one in which fusion heard it. What the clock says enters latencies alone: these are computed with the time
//! of sending that the recorded message implies.

use std::collections::VecDeque;
use std::path::Path;

use anyhow::{bail, ensure};
use bytemuck::pod_read_unaligned;
use flockeye_config::{Flow, Resolved};
use flockeye_contract::{
    FrameEnd, FrameOrder, PlanHeader, Plans, StageName, Topic, Track, TrackHeader, Tracks,
    ViewHeader,
};
use flockeye_recording::message::first_difference;
use flockeye_recording::{ContractMessage, Ending, TopicLayout};

use crate::background_runner::BackgroundRunner;
use crate::core::{Core, Event, Outputs};
use crate::frame_assembly::Record;
use crate::output::Writer;
use crate::recorded::{Lost, Message, Recorded, RecordedPixels, header};
use crate::settings::{Configured, configured};

/// What a replay has shown.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Replayed {
    /// Frames that ended.
    pub frames: u64,
    /// Messages that were compared.
    pub messages: u64,
    /// The first difference; `None`: the same bytes.
    pub difference: Option<String>,
    /// What the recording lacks, or may lack. A difference may come from that.
    pub lost: Vec<Lost>,
}

/// Replays a recording of a lossless flight with its views (`flockeye record --frames views`).
///
/// # Errors
/// It is no such recording, it lacks something, or its configuration cannot be worked with any more.
pub fn replay(path: &Path) -> anyhow::Result<Replayed> {
    let mut recorded = Recorded::open(path)?;
    let resolved = recorded.configuration()?;
    ensure!(is_replayable(&resolved), "{}: {NOT_REPLAYABLE}", path.display());
    let mut replay = Replay::new(&resolved, &recorded)?;
    while let Some((message, utc_ns)) = recorded.next_message()? {
        // The rest says what is lost.
        if replay.difference().is_none() {
            replay.on(message, utc_ns)?;
        }
    }
    let is_whole = recorded.ending() == Some(Ending::Whole);
    if is_whole && replay.difference().is_none() {
        replay.needs_no_pixels()?;
        replay.note_what_is_left();
    }
    ensure!(
        replay.replayed.messages > 0,
        "{} has no message of fusion. Cure: record for longer",
        path.display()
    );
    Ok(Replayed { lost: recorded.lost(), ..replay.replayed })
}

/// Whether fusion can be replayed with a recording of this configuration.
pub fn is_replayable(resolved: &Resolved) -> bool {
    resolved.pipeline.flow == Flow::Lossless
}

/// Why fusion cannot be replayed with other recordings.
pub const NOT_REPLAYABLE: &str = "in flow latest, what fusion says depends on when it heard what, which is not recorded. Cure: \
     record a lossless flight (--flow lossless)";

/// `flockeye-fusion replay FILE`: says what a replay shows. Whether it gave the same.
///
/// # Errors
/// As [`replay`].
pub fn report(path: &Path) -> anyhow::Result<bool> {
    let Replayed { frames, messages, difference, lost } = replay(path)?;
    match &difference {
        None => println!("{messages} messages of {frames} frames are the same, byte by byte"),
        Some(difference) => println!("after {messages} messages of {frames} frames: {difference}"),
    }
    if !lost.is_empty() {
        println!("the recording lacks messages, from which a difference may come: {}", said(&lost));
    }
    Ok(difference.is_none())
}

/// What a recording lacks, as text.
pub fn said(lost: &[Lost]) -> String {
    let of_topic = |Lost { topic, messages }: &Lost| format!("{topic} {messages}");
    lost.iter().map(of_topic).collect::<Vec<_>>().join(", ")
}

/// The core of fusion with what it got.
pub struct Replay {
    core: Core<RecordedPixels>,
    writer: Writer,
    background: Option<BackgroundRunner>,
    awaits_rotations: bool,
    /// Whether the last view still lacks its pixels.
    lacks_pixels: bool,
    /// Views of each worker that were not taken yet.
    lanes: Vec<VecDeque<(ViewHeader, RecordedPixels)>>,
    /// Records that came before their views.
    early: Vec<Record>,
    ends: VecDeque<FrameEnd>,
    newest_rotation: Option<FrameOrder>,
    tracks: Compared,
    plans: Compared,
    replayed: Replayed,
}

/// What was recorded of a topic, and what is given.
struct Compared {
    layout: TopicLayout,
    recorded: VecDeque<ContractMessage>,
    given: VecDeque<ContractMessage>,
}

impl Compared {
    fn of<T: Topic>(recorded: &Recorded) -> anyhow::Result<Self> {
        let layout = recorded.layout_of::<T>()?;
        Ok(Self { layout, recorded: VecDeque::new(), given: VecDeque::new() })
    }

    /// The next pair, if both are there.
    fn next_pair(&mut self) -> Option<(ContractMessage, ContractMessage)> {
        if self.recorded.is_empty() {
            return None;
        }
        let given = self.given.pop_front()?;
        Some((self.recorded.pop_front()?, given))
    }

    /// Where a message of this frame differs.
    fn difference(
        &self,
        frame: u64,
        recorded: &ContractMessage,
        given: &ContractMessage,
    ) -> Option<String> {
        let found = first_difference(&self.layout, recorded, given)?;
        let service = self.layout.service;
        Some(format!("{service} of frame {frame}, recorded and given: {found}"))
    }
}

impl Replay {
    /// Before the first message.
    ///
    /// # Errors
    /// The configuration cannot be worked with.
    pub fn new(resolved: &Resolved, recorded: &Recorded) -> anyhow::Result<Self> {
        let pipeline = &resolved.pipeline;
        let Configured { core, writer, aligner, has_background } = configured(resolved, 0)?;
        let mut replay = Self {
            core,
            writer,
            background: has_background.then(|| BackgroundRunner::inline(aligner)),
            awaits_rotations: pipeline.runs(StageName::Egomotion),
            lacks_pixels: false,
            lanes: (0..pipeline.detection_workers()).map(|_| VecDeque::new()).collect(),
            early: Vec::new(),
            ends: VecDeque::new(),
            newest_rotation: None,
            tracks: Compared::of::<Tracks>(recorded)?,
            plans: Compared::of::<Plans>(recorded)?,
            replayed: Replayed::default(),
        };
        replay.work(0)?;
        Ok(replay)
    }

    /// The core, which can be asked for an account.
    pub fn core(&mut self) -> &mut Core<RecordedPixels> {
        &mut self.core
    }

    /// The first difference so far.
    pub fn difference(&self) -> Option<&str> {
        self.replayed.difference.as_deref()
    }

    /// Takes a message of the recording.
    ///
    /// # Errors
    /// The recording lacks something, or fusion was replaced meanwhile.
    pub fn on(&mut self, message: Message, utc_ns: u64) -> anyhow::Result<()> {
        // Only differences of these times count.
        let now_ns = i64::try_from(utc_ns).unwrap_or(i64::MAX);
        match message {
            Message::Header(_) => {
                self.needs_no_pixels()?;
                self.lacks_pixels = true;
            }
            Message::View(header, pixels) => {
                self.lacks_pixels = false;
                if let Some(lane) = self.lanes.get_mut(header.worker as usize) {
                    lane.push_back((header, pixels));
                }
            }
            Message::Searched(record) => self.early.push(record),
            Message::Rotation(rotation) => {
                self.newest_rotation = self.newest_rotation.max(Some(rotation.stamp.order()));
                self.core.on(Event::Rotation(rotation), now_ns);
            }
            Message::FrameEnd(end) => self.ends.push_back(end),
            Message::Tracks(header, _, bytes) => {
                ensure!(
                    header.generation == 0,
                    "fusion was replaced during the recording. Cure: record a flight without"
                );
                self.tracks.recorded.push_back(bytes);
            }
            Message::Plan(header, _, bytes) => {
                if self.plans.recorded.is_empty() && self.replayed.messages == 0 {
                    begin(&header)?;
                }
                self.plans.recorded.push_back(bytes);
            }
            Message::Frame(_) | Message::Truth(..) => return Ok(()),
        }
        self.work(now_ns)
    }

    /// Refuses a recording in which the last view has no pixels.
    fn needs_no_pixels(&self) -> anyhow::Result<()> {
        if self.lacks_pixels {
            bail!(
                "a view without its pixels. Cure: record with them (recording.frames: views, or --frames views)"
            );
        }
        Ok(())
    }

    /// Gives the core what it can have now, and lets it do all that there is to do.
    fn work(&mut self, now_ns: i64) -> anyhow::Result<()> {
        for record in std::mem::take(&mut self.early) {
            self.take_view_of(&record, now_ns);
            let is_early =
                !self.core.has_view_of(&record) && !self.core.has_ended(&record.header.stamp);
            match is_early {
                true => self.early.push(record),
                false => drop(self.core.on(Event::Searched(record), now_ns)),
            }
        }
        while let Some(end) = self.ends.front()
            && (!self.awaits_rotations || self.newest_rotation >= Some(end.stamp.order()))
            && let Some(end) = self.ends.pop_front()
        {
            self.core.on(Event::FrameEnd(end), now_ns);
        }
        loop {
            let answer = self.background.as_mut().map_or(Ok(None), BackgroundRunner::answer)?;
            let had_answer = answer.is_some();
            if let Some(answer) = answer {
                self.core.on(Event::Background(answer), now_ns);
            }
            let outputs = self.core.step(now_ns);
            let is_idle = outputs.is_idle && outputs.job.is_none() && !had_answer;
            self.note(outputs)?;
            if is_idle {
                break;
            }
        }
        self.compare();
        Ok(())
    }

    fn take_view_of(&mut self, record: &Record, now_ns: i64) {
        let Some(lane) = self.lanes.get_mut(record.header.worker as usize) else { return };
        while !self.core.has_view_of(record)
            && let Some((header, pixels)) = lane.pop_front()
        {
            self.core.on(Event::View(header, pixels), now_ns);
        }
    }

    /// Notes what the core gives, as messages.
    fn note(&mut self, outputs: Outputs) -> anyhow::Result<()> {
        for message in &outputs.tracks {
            self.replayed.frames += u64::from(message.is_last);
            let (header, tracks) = self.writer.tracks(message, self.core.tracker(), 0);
            self.tracks.given.push_back(contract_message(&header, &tracks));
        }
        if let Some((next, after)) = &outputs.plan {
            let (header, views) = self.writer.plan(next, *after, 0);
            self.plans.given.push_back(contract_message(&header, &views));
        }
        if let (Some(job), Some(runner)) = (outputs.job, &mut self.background) {
            runner.run(job)?;
        }
        Ok(())
    }

    fn compare(&mut self) {
        while self.replayed.difference.is_none()
            && let Some((recorded, mut given)) = self.tracks.next_pair()
        {
            send_when(&mut given, &recorded);
            let frame = header::<TrackHeader>(&recorded).stamp.sequence;
            self.replayed.messages += 1;
            self.replayed.difference = self.tracks.difference(frame, &recorded, &given);
        }
        while self.replayed.difference.is_none()
            && let Some((recorded, mut given)) = self.plans.next_pair()
        {
            let made_ns = header::<PlanHeader>(&recorded).made_ns;
            let header = PlanHeader { made_ns, ..header(&given) };
            given.header = bytemuck::bytes_of(&header).to_vec();
            self.replayed.messages += 1;
            let frame = header.after.sequence;
            self.replayed.difference = self.plans.difference(frame, &recorded, &given);
        }
    }

    /// What was recorded and is not given. The other way round it says nothing: a recording may end before its flight.
    fn note_what_is_left(&mut self) {
        for compared in [&self.tracks, &self.plans] {
            let recorded = compared.recorded.len();
            if recorded > 0 && self.replayed.difference.is_none() {
                let service = compared.layout.service;
                self.replayed.difference = Some(format!(
                    "{service}: {recorded} messages more were recorded than are given"
                ));
            }
        }
    }
}

/// A recording that begins later lacks what fusion knew by then.
fn begin(first: &PlanHeader) -> anyhow::Result<()> {
    ensure!(
        first.plan_id == 1,
        "the recording begins with plan {}: what fusion knew before is not in it. Cure: record from the \
         first frame on (recording.folder in pipeline.yaml)",
        first.plan_id
    );
    Ok(())
}

fn contract_message<H: bytemuck::Pod, I: bytemuck::Pod>(
    header: &H,
    items: &[I],
) -> ContractMessage {
    ContractMessage {
        header: bytemuck::bytes_of(header).to_vec(),
        items: bytemuck::cast_slice(items).to_vec(),
        payload_bytes: 0,
    }
}

/// Has tracks that were written for the time 0 be sent when the recorded ones were.
fn send_when(given: &mut ContractMessage, recorded: &ContractMessage) {
    let size = size_of::<Track>();
    let pairs = given.items.chunks_exact_mut(size).zip(recorded.items.chunks_exact(size));
    for (given, recorded) in pairs {
        let mut track: Track = pod_read_unaligned(given);
        let recorded: Track = pod_read_unaligned(recorded);
        let sent_ns = recorded.latency.total_ns.wrapping_sub(track.latency.total_ns);
        track.latency.total_ns = recorded.latency.total_ns;
        // -1: nothing led to it.
        if track.latency.fusion_ns != -1 {
            track.latency.fusion_ns = track.latency.fusion_ns.wrapping_add(sent_ns);
        }
        given.copy_from_slice(bytemuck::bytes_of(&track));
    }
}
