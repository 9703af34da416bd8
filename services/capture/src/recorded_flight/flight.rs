//! Playback of a recorded flight: its coded pictures are decoded, and each gets its recorded stamp.
//!
//! A thread reads the recording and feeds the decoder. Each epoch of the recording has its own
//! decoder.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use flockeye_config::Flow;
use flockeye_contract::{FrameHeader, VideoCodec};
use flockeye_runtime::lock::lock;
use gstreamer as gst;
use gstreamer::prelude::*;
use gstreamer_app as gst_app;

use super::tape::{Damage, FlightTape};
use crate::arrivals::on_each_buffer;
use crate::event::EndReason;
use crate::input::{FEED, Input};
use crate::parameters::SourceParameters;
use crate::picture::{FlightFrame, TapeSample};
use crate::playback::{Playback, PlaybackEvent};
use crate::{CaptureError, Event, decoder};

/// A recorded flight during playback.
pub(crate) struct Flight {
    path: PathBuf,
    params: SourceParameters,
    playing: Option<EpochPlayback>,
    /// The next epoch, which begins after all damage is reported.
    next_epoch: Option<FlightTape>,
    /// Reason of an early end, if so.
    fault: Option<String>,
    /// Unusable pictures that are not reported yet.
    damaged: VecDeque<Damage>,
    handed_out: u64,
    skipped: u64,
    /// Number of pictures of this epoch, with those replaced by a newer one.
    count: u64,
    /// Number of consecutive frames without a sample.
    blind: u32,
}

/// Number of consecutive frames without an inertial sample that causes a warning.
const MOST_BLIND: u32 = 30;

impl std::fmt::Debug for Flight {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Flight").field("path", &self.path).finish_non_exhaustive()
    }
}

struct EpochPlayback {
    // First field: its drop unblocks the thread that feeds it.
    playback: Playback,
    feeder: JoinHandle<FlightTape>,
    table: Arc<Mutex<Table>>,
}

/// Data of the pictures that are in the decoder.
#[derive(Debug, Default)]
struct Table {
    /// Pictures by their time stamps in the decoder.
    pictures: BTreeMap<gst::ClockTime, PendingPicture>,
    samples: VecDeque<TapeSample>,
    damaged: VecDeque<Damage>,
}

#[derive(Debug)]
struct PendingPicture {
    /// `None`: the picture was decoded in flight, but not published.
    header: Option<FrameHeader>,
    /// Difference from its time stamp to its exposure.
    later_ns: i64,
    /// Time after its exposure up to which samples belong to it.
    reach_ns: i64,
    was_decoded: bool,
}

impl Table {
    /// Takes a picture that has come out. Returns its data, and the number of decoded pictures
    /// before it that were replaced.
    fn take(&mut self, pts: gst::ClockTime) -> Option<(PendingPicture, u64)> {
        let later = self.pictures.split_off(&pts);
        let earlier = std::mem::replace(&mut self.pictures, later);
        let mut replaced = 0;
        for fed in earlier.into_values() {
            match (&fed.header, fed.was_decoded) {
                (None, _) => {}
                (Some(_), true) => replaced += 1,
                (Some(header), false) => self.damaged.push_back(undecoded(header)),
            }
        }
        Some((self.pictures.remove(&pts)?, replaced))
    }

    /// Notes the end: all other undecoded pictures are damaged.
    fn end(&mut self) {
        for fed in std::mem::take(&mut self.pictures).into_values() {
            if let (Some(header), false) = (&fed.header, fed.was_decoded) {
                self.damaged.push_back(undecoded(header));
            }
        }
    }

    /// Takes the samples up to a time.
    fn samples_until(&mut self, until_ns: i64) -> Vec<TapeSample> {
        let count = self.samples.iter().take_while(|(_, next)| next.at_ns <= until_ns).count();
        self.samples.drain(..count).collect()
    }
}

fn undecoded(header: &FrameHeader) -> Damage {
    (format!("frame {}", header.stamp.sequence), "its picture cannot be decoded".to_owned())
}

impl Flight {
    /// Opens a recording and decodes its first picture.
    pub(crate) fn open(path: &Path, params: &SourceParameters) -> Result<Self, CaptureError> {
        let tape = FlightTape::open(path, params.samples, params.latency)?;
        let mut flight = Self {
            path: path.to_owned(),
            params: params.clone(),
            playing: None,
            next_epoch: None,
            fault: None,
            damaged: VecDeque::new(),
            handed_out: 0,
            skipped: 0,
            count: 0,
            blind: 0,
        };
        flight.begin(tape)?;
        Ok(flight)
    }

    fn begin(&mut self, tape: FlightTape) -> Result<(), CaptureError> {
        let table = Arc::new(Mutex::new(Table::default()));
        let input = Input::Flight(self.path.clone(), tape.codec());
        let mut feeder = None;
        let playback = Playback::fed(input, &self.params, |pipeline, sink| {
            let missing = || CaptureError::GStreamer("appsrc is not as it should be".to_owned());
            let feed = pipeline.by_name(FEED).and_then(|feed| feed.downcast().ok());
            let feed: gst_app::AppSrc = feed.ok_or_else(missing)?;
            let pad = sink.static_pad("sink").ok_or_else(missing)?;
            let decoded = Arc::clone(&table);
            on_each_buffer(&pad, move |pts| {
                if let Some(fed) = lock(&decoded).pictures.get_mut(&pts) {
                    fed.was_decoded = true;
                }
            });
            let shared_table = Arc::clone(&table);
            let thread = std::thread::Builder::new().name("flight".to_owned());
            let begun = thread.spawn(move || feed_epoch(tape, &feed, &shared_table));
            feeder = Some(begun.map_err(|error| CaptureError::GStreamer(error.to_string()))?);
            Ok(())
        })?;
        let missing = || CaptureError::GStreamer("nobody feeds it".to_owned());
        let feeder = feeder.ok_or_else(missing)?;
        self.count = 0;
        self.playing = Some(EpochPlayback { playback, feeder, table });
        Ok(())
    }

    /// Waits for an event, for at most `timeout`.
    pub(crate) fn next(&mut self, timeout: Duration) -> Result<Event, CaptureError> {
        if let Some((what, why)) = self.damaged.pop_front() {
            self.skipped += 1;
            return Ok(Event::Skipped { what: format!("{}: {what}", self.path.display()), why });
        }
        let Some(EpochPlayback { playback, table, .. }) = &mut self.playing else {
            if let Some(tape) = self.next_epoch.take() {
                self.begin(tape)?;
                return Ok(Event::NewEpoch);
            }
            let (frames, skipped) = (self.handed_out, self.skipped);
            return Ok(Event::End(match self.fault.take() {
                Some(reason) => EndReason::Truncated { decoded: frames, reason },
                None => EndReason::Complete { frames, skipped },
            }));
        };
        match playback.next(timeout)? {
            PlaybackEvent::Picture(mut picture) => {
                let mut table = lock(table);
                let taken = picture.stamp.pts.and_then(|pts| table.take(pts));
                self.damaged.append(&mut table.damaged);
                let Some((
                    PendingPicture { header: Some(header), later_ns, reach_ns, .. },
                    replaced,
                )) = taken
                else {
                    return Ok(Event::Idle);
                };
                let until_ns = header.stamp.exposure_ns.saturating_add(reach_ns);
                let samples = table.samples_until(until_ns);
                drop(table);
                let sequence = self.count + replaced;
                self.count = sequence + 1;
                self.handed_out += 1;
                let exposure_ns = match self.params.flow {
                    Flow::Latest => picture.exposure_monotonic_ns().saturating_add(later_ns),
                    Flow::Lossless => header.stamp.stream_ns,
                };
                self.blind = if samples.is_empty() { self.blind.saturating_add(1) } else { 0 };
                if self.params.samples && self.blind == MOST_BLIND {
                    tracing::warn!(
                        "{}: {MOST_BLIND} frames without a sample of an inertial sensor. Cure: inertial.source: none, \
                         if it was recorded without",
                        self.path.display()
                    );
                }
                let recorded = FlightFrame { header, samples, sequence, exposure_ns };
                picture.recorded = Some(Box::new(recorded));
                Ok(Event::Frame(picture))
            }
            PlaybackEvent::Idle | PlaybackEvent::Late(_) | PlaybackEvent::Behind { .. } => {
                Ok(Event::Idle)
            }
            PlaybackEvent::Over { fault } => {
                self.end_epoch(fault);
                self.next(timeout)
            }
        }
    }

    fn end_epoch(&mut self, fault: Option<String>) {
        self.fault.clone_from(&fault);
        let Some(EpochPlayback { playback, feeder, table }) = self.playing.take() else { return };
        // The drop unblocks the thread that feeds it.
        drop(playback);
        let tape = feeder.join();
        let mut known = lock(&table);
        known.end();
        self.damaged.append(&mut known.damaged);
        let (None, Ok(mut tape)) = (fault, tape) else { return };
        loop {
            match tape.next() {
                Some(Ok(coded)) => {
                    tape.put_back = Some(coded);
                    self.next_epoch = Some(tape);
                    return;
                }
                Some(Err(damage)) => self.damaged.push_back(damage),
                None => {
                    self.fault = tape.fault;
                    return;
                }
            }
        }
    }

    /// Whether the pictures come from a video decoder.
    pub(crate) fn decodes_video(&self) -> bool {
        self.playing
            .as_ref()
            .is_some_and(|playing| decoder::takes_video(&playing.playback.pipeline))
    }

    pub(crate) fn describe(&self) -> String {
        match &self.playing {
            Some(playing) => playing.playback.describe(),
            None => self.path.display().to_string(),
        }
    }
}

/// Feeds the pictures of one epoch. Returns the recording, at the next epoch or at its end.
fn feed_epoch(mut tape: FlightTape, feed: &gst_app::AppSrc, table: &Mutex<Table>) -> FlightTape {
    let mut epoch = None;
    let mut first_ns = 0;
    // Exposure minus time stamp of the first published frame.
    let mut apart_ns = None;
    let mut newest_pts = None;
    loop {
        let next = tape.next();
        let mut known = lock(table);
        known.samples.extend(tape.take_samples());
        let coded = match next {
            Some(Ok(coded)) if *epoch.get_or_insert(coded.epoch) == coded.epoch => coded,
            Some(Ok(coded)) => {
                tape.put_back = Some(coded);
                break;
            }
            Some(Err(damage)) => {
                known.damaged.push_back(damage);
                continue;
            }
            None => break,
        };
        if newest_pts.is_none() {
            first_ns = coded.time_ns;
        }
        // Skip pictures with a presentation time before the first: they cannot be decoded.
        let pts = coded.time_ns.checked_sub(first_ns).and_then(|pts| u64::try_from(pts).ok());
        let Some(pts) = pts.map(gst::ClockTime::from_nseconds) else { continue };
        let is_jpeg = coded.codec == VideoCodec::None;
        if is_jpeg && newest_pts.is_some_and(|newest| pts <= newest) {
            let sequence = coded.header.map_or(0, |header| header.stamp.sequence);
            let why = "its exposure is not later than that of the one before".to_owned();
            known.damaged.push_back((format!("frame {sequence}"), why));
            continue;
        }
        newest_pts = newest_pts.max(Some(pts));
        let (mut later_ns, mut reach_ns) = (0, 0);
        if let Some(header) = &coded.header {
            let apart = header.stamp.exposure_ns.saturating_sub(coded.time_ns);
            later_ns = apart.saturating_sub(*apart_ns.get_or_insert(apart));
            reach_ns = tape.reach_ns(header);
        }
        let fed = PendingPicture { header: coded.header, later_ns, reach_ns, was_decoded: false };
        known.pictures.insert(pts, fed);
        drop(known);
        let mut buffer = gst::Buffer::from_slice(coded.bytes);
        if let Some(buffer) = buffer.get_mut() {
            buffer.set_pts(pts);
        }
        if feed.push_buffer(buffer).is_err() {
            // The decoder has ended.
            return tape;
        }
    }
    // An error means that the decoder has ended, which is harmless.
    feed.end_of_stream().ok();
    tape
}
