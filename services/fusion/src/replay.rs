//! Gives the core of fusion what it got in a recorded flight, and compares what it gives with what it gave.
//!
//! In a lossless flow nothing that fusion says may depend on who is faster, so the order of the recording is as good
//! as the one in which fusion heard it. What the clock says enters latencies alone: these are computed with the time
//! of sending that the recorded message implies.

use std::collections::VecDeque;
use std::path::Path;

use anyhow::{Context, bail, ensure};
use bytemuck::{AnyBitPattern, pod_read_unaligned};
use flockeye_config::{Flow, Pipeline, Resolved};
use flockeye_contract::{
    DetectedMarker, DetectionHeader, Detections, FrameEnd, FrameEnds, FrameOrder, PlanHeader,
    Plans, Rotation, Rotations, StageName, Topic, Track, TrackHeader, Tracks, ViewHeader, Views,
};
use flockeye_recording::channel::VIEW_IMAGES;
use flockeye_recording::images::decode_image;
use flockeye_recording::message::{decode, first_difference};
use flockeye_recording::{ContractMessage, Ending, Reader, RecordedMessage, TopicLayout, layouts};

use crate::background_runner::BackgroundRunner;
use crate::core::{Core, Event, Outputs};
use crate::frame_assembly::Record;
use crate::output::Writer;
use crate::pictures::Pixels;
use crate::settings::{Configured, configured};

/// The pixels of a recorded view.
#[derive(Debug)]
pub struct RecordedPixels(Vec<u8>);

impl Pixels for RecordedPixels {
    fn pixels(&self) -> &[u8] {
        &self.0
    }
}

/// What a replay has shown.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Replayed {
    /// Frames that ended.
    pub frames: u64,
    /// Messages that were compared.
    pub messages: u64,
    /// The first difference; `None`: the same bytes.
    pub difference: Option<String>,
}

/// Replays a recording of a lossless flight with its views (`flockeye record --frames views`).
///
/// # Errors
/// It is no such recording, it lacks something, or its configuration cannot be worked with any more.
pub fn replay(path: &Path) -> anyhow::Result<Replayed> {
    let mut reader = Reader::open(path)?;
    let resolved = configuration(&reader)?;
    ensure!(
        resolved.pipeline.flow == Flow::Lossless,
        "{}: in flow latest, what fusion says depends on when it heard what, which is not recorded. Cure: \
         record a lossless flight (--flow lossless)",
        path.display()
    );
    let mut replay = Replay::new(&resolved)?;
    replay.work(0)?;
    while let Some(message) = reader.next_message()? {
        replay.on(&message)?;
        if replay.replayed.difference.is_some() {
            return Ok(replay.replayed);
        }
    }
    if reader.ending() == Some(Ending::Whole) {
        replay.needs_no_pixels()?;
    }
    ensure!(
        replay.replayed.messages > 0,
        "{} has no message of fusion. Cure: record for longer",
        path.display()
    );
    if reader.ending() == Some(Ending::Whole) {
        replay.note_what_is_left();
    }
    Ok(replay.replayed)
}

/// `flockeye-fusion replay FILE`: says what a replay shows. Whether it gave the same.
///
/// # Errors
/// As [`replay`].
pub fn report(path: &Path) -> anyhow::Result<bool> {
    let Replayed { frames, messages, difference } = replay(path)?;
    match &difference {
        None => println!("{messages} messages of {frames} frames are the same, byte by byte"),
        Some(difference) => println!("after {messages} messages of {frames} frames: {difference}"),
    }
    Ok(difference.is_none())
}

/// The configuration of a recorded pipeline.
fn configuration(reader: &Reader) -> anyhow::Result<Resolved> {
    let name = "pipeline.json";
    let attachments = &reader.about().attachments;
    let found = attachments.iter().find(|(attached, _, _)| attached == name);
    let (_, _, json) = found.with_context(|| format!("the recording has no {name}"))?;
    let read = || -> serde_json::Result<Pipeline> {
        let mut written: serde_json::Map<String, serde_json::Value> = serde_json::from_slice(json)?;
        // What follows from the rest is worked out anew.
        written.remove("resolved");
        serde_json::from_value(serde_json::Value::Object(written))
    };
    let pipeline = read().with_context(|| format!("{name} of the recording"))?;
    Resolved::of(pipeline).context("the recorded configuration cannot be worked with any more")
}

struct Replay {
    core: Core<RecordedPixels>,
    writer: Writer,
    background: Option<BackgroundRunner>,
    awaits_rotations: bool,
    layouts: Vec<TopicLayout>,
    /// The header of a view whose pixels come next, and its number.
    view: Option<(u32, ViewHeader)>,
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
    fn of(layouts: &[TopicLayout], service: &str) -> anyhow::Result<Self> {
        let layout = layouts.iter().find(|layout| layout.service == service);
        let layout = layout.context("a topic is not in the contract")?.clone();
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
    fn new(resolved: &Resolved) -> anyhow::Result<Self> {
        let pipeline = &resolved.pipeline;
        let Configured { core, writer, aligner, has_background } = configured(resolved, 0)?;
        let layouts = layouts();
        Ok(Self {
            core,
            writer,
            background: has_background.then(|| BackgroundRunner::inline(aligner)),
            awaits_rotations: pipeline.runs(StageName::Egomotion),
            view: None,
            lanes: (0..pipeline.detection_workers()).map(|_| VecDeque::new()).collect(),
            early: Vec::new(),
            ends: VecDeque::new(),
            newest_rotation: None,
            tracks: Compared::of(&layouts, Tracks::NAME)?,
            plans: Compared::of(&layouts, Plans::NAME)?,
            layouts,
            replayed: Replayed { frames: 0, messages: 0, difference: None },
        })
    }

    /// Takes a message of the recording.
    fn on(&mut self, message: &RecordedMessage) -> anyhow::Result<()> {
        let topic = message.channel.topic.as_str();
        if topic == VIEW_IMAGES {
            return self.on_pixels(message);
        }
        let is_of = |layout: &&TopicLayout| layout.channel() == topic;
        let Some(layout) = self.layouts.iter().find(is_of) else { return Ok(()) };
        let found = decode(layout, &message.bytes)?;
        // Only differences of these times count.
        let now_ns = i64::try_from(message.utc_ns).unwrap_or(i64::MAX);
        match layout.service {
            "flockeye/view" => {
                self.needs_no_pixels()?;
                self.view = Some((message.sequence, header(&found)));
            }
            "flockeye/detection" => {
                let size = size_of::<DetectedMarker>();
                let markers = found.items.chunks_exact(size).map(pod_read_unaligned).collect();
                let markers: Vec<DetectedMarker> = markers;
                let header: DetectionHeader = header(&found);
                refuse_if_wrong::<Detections>(&header, &markers)?;
                self.early.push(Record { header, markers });
            }
            "flockeye/rotation" => {
                let rotation: Rotation = header(&found);
                refuse_if_wrong::<Rotations>(&rotation, &[])?;
                self.newest_rotation = self.newest_rotation.max(Some(rotation.stamp.order()));
                self.core.on(Event::Rotation(rotation), now_ns);
            }
            "flockeye/frame_end" => {
                let end: FrameEnd = header(&found);
                refuse_if_wrong::<FrameEnds>(&end, &[])?;
                self.ends.push_back(end);
            }
            "flockeye/track" => {
                let header: TrackHeader = header(&found);
                ensure!(
                    header.generation == 0,
                    "fusion was replaced during the recording. Cure: record a flight without"
                );
                self.tracks.recorded.push_back(found);
            }
            "flockeye/plan" => {
                let header: PlanHeader = header(&found);
                if self.plans.recorded.is_empty() && self.replayed.messages == 0 {
                    self.begin(&header)?;
                }
                self.plans.recorded.push_back(found);
            }
            _ => return Ok(()),
        }
        self.work(now_ns)
    }

    /// Refuses a recording in which the last view has no pixels.
    fn needs_no_pixels(&self) -> anyhow::Result<()> {
        ensure!(
            self.view.is_none(),
            "a view without its pixels. Cure: record with them (recording.frames: views, or --frames views)"
        );
        Ok(())
    }

    /// A recording that begins later lacks what fusion knew by then.
    fn begin(&mut self, first: &PlanHeader) -> anyhow::Result<()> {
        ensure!(
            first.plan_id == 1,
            "the recording begins with plan {}: what fusion knew before is not in it. Cure: record from the \
             first frame on (recording.folder in pipeline.yaml)",
            first.plan_id
        );
        Ok(())
    }

    fn on_pixels(&mut self, message: &RecordedMessage) -> anyhow::Result<()> {
        let Some((sequence, header)) = self.view.take() else {
            bail!("pixels of a view without its header");
        };
        ensure!(sequence == message.sequence, "pixels of a view without its header");
        let pixels = decode_image(VIEW_IMAGES, &message.bytes)?.pixels.to_vec();
        refuse_if_wrong::<Views>(&header, &pixels)?;
        if let Some(lane) = self.lanes.get_mut(header.worker as usize) {
            lane.push_back((header, RecordedPixels(pixels)));
        }
        let now_ns = i64::try_from(message.utc_ns).unwrap_or(i64::MAX);
        self.work(now_ns)
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

/// Refuses what no port would let in: a recording may have been changed.
fn refuse_if_wrong<T: Topic>(header: &T::Header, items: &[T::Item]) -> anyhow::Result<()> {
    T::check(header, items).with_context(|| {
        format!("a recorded message of {} breaks the contract. Cure: record anew", T::NAME)
    })
}

fn header<H: AnyBitPattern>(message: &ContractMessage) -> H {
    // `decode` gives as many bytes as the type has.
    pod_read_unaligned(&message.header)
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
