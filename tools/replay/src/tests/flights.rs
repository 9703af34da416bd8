//! Flights of fusion for tests, driven as in its stage, and their recordings.

#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, reason = "of the flights")]

use std::sync::OnceLock;

use flockeye_config::{Pipeline, Resolved};
use flockeye_contract::{DetectionHeader, FrameOrder, Rotation, RotationSource};
use flockeye_fusion::{
    AccountEntry, BackgroundRunner, Core, Event, Journal, Record, Writer, configured,
};

use crate::fixtures::{INTERVAL_S, pose, region_end, region_record, region_view, shown, stamp};
use crate::recorded::{FlightMessage, RecordedPixels, contract_message};

/// Time from the exposure of a frame to its messages, nanoseconds.
const DELAY_NS: i64 = 20_000_000;

/// Recorded messages, each with its time of recording, nanoseconds.
pub(crate) type Recording = Vec<(FlightMessage, u64)>;

pub(crate) fn resolved() -> Resolved {
    Resolved::of(Pipeline::parse("", &[], "a test").unwrap()).unwrap()
}

/// Fusion in flight, driven as in its stage, and its recording.
pub(crate) struct Flown {
    core: Core<RecordedPixels>,
    writer: Writer,
    background: BackgroundRunner,
    now_ns: i64,
    recording: Recording,
}

impl Flown {
    fn begin() -> Self {
        let (mut core, writer, aligner) = configured(&resolved(), 0).unwrap();
        core.keep_account(0);
        let mut journal = Journal::new(0, false);
        journal.listen(true);
        let mut flown = Self {
            core: core.journaled(journal),
            writer,
            background: BackgroundRunner::inline(aligner.unwrap()),
            now_ns: stamp(0).exposure_ns,
            recording: Recording::new(),
        };
        flown.work();
        flown
    }

    fn record(&mut self, message: FlightMessage) {
        self.recording.push((message, self.now_ns as u64));
    }

    fn hear(&mut self, event: Event<RecordedPixels>) {
        self.now_ns += 1_000;
        self.record(match &event {
            Event::View(header, pixels) => FlightMessage::View(*header, pixels.clone()),
            Event::Searched(record) => FlightMessage::Searched(record.clone()),
            Event::FrameEnd(end) => FlightMessage::FrameEnd(*end),
            Event::Rotation(rotation) => FlightMessage::Rotation(*rotation),
            Event::Background(_) => panic!("it is not recorded"),
        });
        assert_eq!(self.core.on(event, self.now_ns), None);
    }

    /// Runs steps until fusion is idle.
    fn work(&mut self) {
        loop {
            self.now_ns += 1_000;
            let mut outputs = self.core.step(self.now_ns);
            let is_idle = outputs.is_idle;
            self.now_ns += 1_000;
            self.core.say(&outputs, self.now_ns);
            for message in &outputs.tracks {
                let (header, tracks) =
                    self.writer.tracks(message, self.core.tracker(), self.now_ns);
                let bytes = contract_message(&header, &tracks);
                self.record(FlightMessage::Tracks(header, tracks, bytes));
            }
            if let Some((next, after)) = &outputs.plan {
                let (header, views) = self.writer.plan(next, *after, self.now_ns);
                let bytes = contract_message(&header, &views);
                self.record(FlightMessage::Plan(header, views, bytes));
            }
            if let Some(job) = outputs.job.take() {
                self.background.run(job).unwrap();
            }
            if let Some((header, entries)) = self.core.journal().unwrap().take(is_idle) {
                self.record(FlightMessage::Journal(header, entries));
            }
            if is_idle {
                return;
            }
        }
    }

    fn background_is_over(&mut self) {
        let answer = self.background.answer().unwrap().expect("a pass was asked for");
        self.now_ns += 1_000;
        self.core.on(Event::Background(answer), self.now_ns);
        self.work();
    }

    fn region(&mut self, sequence: u64, pixels: Vec<u8>) {
        self.now_ns = stamp(sequence).exposure_ns + DELAY_NS;
        self.hear(Event::View(region_view(sequence, 0), RecordedPixels::from(pixels)));
    }

    /// Alpha stands still; its region is cut, searched, and the frame ends.
    fn frame(&mut self, sequence: u64) {
        self.region(sequence, shown().1.clone());
        self.work();
        self.hear(Event::Searched(region_record(sequence, 0, &pose(0.9))));
        self.work();
        self.end(sequence);
    }

    fn end(&mut self, sequence: u64) {
        self.hear(Event::FrameEnd(region_end(sequence, 0, 1)));
        self.work();
    }
}

/// The camera has turned by this angle about its vertical axis, radians.
fn rotation(sequence: u64, turn: f64) -> Rotation {
    let spread =
        |variance: f64| std::array::from_fn(|place| if place % 4 == 0 { variance } else { 0.0 });
    Rotation {
        stamp: stamp(sequence),
        earlier_exposure_ns: stamp(sequence - 1).exposure_ns,
        later_from_earlier: [0.0, 0.0, (turn / 2.0).sin(), (turn / 2.0).cos()],
        covariance: spread(1e-8),
        rate_covariance: spread(1e-6),
        ahead_ns: stamp(sequence).exposure_ns,
        ahead_from_later: [0.0, 0.0, 0.0, 1.0],
        rate_in_camera: [0.0, 0.0, turn / INTERVAL_S],
        source: RotationSource::Picture.code(),
        ..Rotation::default()
    }
}

/// Alpha is found and followed.
pub(crate) fn flown() -> Recording {
    static FLOWN: OnceLock<Recording> = OnceLock::new();
    FLOWN.get_or_init(|| followed().recording).clone()
}

fn followed() -> Flown {
    let mut flown = Flown::begin();
    (0..3).for_each(|sequence| flown.frame(sequence));
    flown.hear(Event::Rotation(rotation(3, 0.02)));
    (3..5).for_each(|sequence| flown.frame(sequence));
    flown
}

/// Alpha is followed, but not seen in frame 5. A background pass searches for it, and its answer
/// comes during frame 6.
pub(crate) fn flown_on() -> Recording {
    continued().recording
}

fn continued() -> Flown {
    let mut flown = followed();
    flown.region(5, vec![128; shown().1.len()]);
    flown.work();
    let header = DetectionHeader { stamp: stamp(5), ..DetectionHeader::default() };
    flown.hear(Event::Searched(Record { header, markers: Vec::new() }));
    flown.work();
    flown.end(5);
    flown.region(6, shown().1.clone());
    flown.work();
    flown.background_is_over();
    flown.hear(Event::Searched(region_record(6, 0, &pose(0.9))));
    flown.work();
    flown.end(6);
    flown
}

/// The same flight, with the decisions about alpha.
pub(crate) fn flown_on_with_account() -> (Recording, Vec<(FrameOrder, AccountEntry)>) {
    let mut flown = continued();
    let account = flown.core.take_account();
    (flown.recording, account)
}
