//! Playback of a pipeline from start to end.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use flockeye_config::Flow;
use flockeye_runtime::clock::monotonic_ns;
use gstreamer as gst;
use gstreamer::prelude::*;
use gstreamer_app as gst_app;
use gstreamer_video as gst_video;

use crate::decoder::Threading;
use crate::explain::Failure;
use crate::holding::{DecoderFault, DecoderWatch};
use crate::input::Input;
use crate::mailbox::MailboxContent;
use crate::packet_tap::PacketTap;
use crate::parameters::SourceParameters;
use crate::picture::{PictureStamp, SourcePicture, range_of};
use crate::pipeline::{DecodedFrame, Frames, build};
use crate::{CaptureError, decoder};

/// Event of a pipeline.
#[derive(Debug)]
pub(crate) enum PlaybackEvent {
    Picture(SourcePicture),
    Idle,
    /// Frames have an avoidable latency, for this reason.
    Late(String),
    /// The decoder is too slow: frames wait this long before it. `faster` is a faster threading.
    Behind {
        by: Duration,
        faster: Option<Threading>,
    },
    /// End of the playback: at the stream's end, or because of a fault.
    Over {
        fault: Option<String>,
    },
}

/// Source of a frame's exposure time.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Timing {
    /// Lossless flow: exposure is stream time.
    Stream,
    /// Stream time stamps on the machine's clock; see [`crate::pipeline`].
    Paced,
    /// Arrival of the data, for a camera with implausible time stamps.
    Arrival,
    /// Time stamps of a camera's driver on the machine's clock.
    Driver,
}

/// Playback of a pipeline from start to end. Dropping it stops it.
#[derive(Debug)]
pub(crate) struct Playback {
    input: Input,
    pub(crate) pipeline: gst::Pipeline,
    sink: gst_app::AppSink,
    frames: Arc<Frames>,
    decoders: Arc<DecoderWatch>,
    pub(crate) packets: Arc<Mutex<PacketTap>>,
    threading: Threading,
    /// Whether the number of threads is configured, and must not be changed.
    is_threading_fixed: bool,
    /// Number of frames that the decoder holds back.
    held: usize,
    timing: Timing,
    expected: (u32, u32),
    latency: Duration,
    stall: Option<Duration>,
    playing: bool,
    heard: Instant,
    /// Number of frames handed out.
    pub(crate) handed_out: u64,
    declared: Option<Duration>,
    reached: Duration,
}

/// Maximum number of frames decoded ahead for a paced recording: 0.1 s at 30 frames/s, 11 MB each
/// at 3840x1920.
const AHEAD: u32 = 4;

/// Timeout for the first frame of a recording.
const OPENING: Duration = Duration::from_secs(10);

/// Maximum time from a plausible time stamp of a camera's driver to the arrival, nanoseconds.
const OLDEST_STAMP_NS: i64 = 1_000_000_000;
/// Maximum time from the arrival to a plausible time stamp of a camera's driver, nanoseconds.
const NEWEST_STAMP_NS: i64 = 5_000_000;

impl Playback {
    /// Opens a recording and decodes its first frame, so that errors are found here. It is played
    /// from the first [`Self::next`] on.
    pub(crate) fn recording(input: Input, params: &SourceParameters) -> Result<Self, CaptureError> {
        Self::fed(input, params, |_, _| Ok(()))
    }

    /// Opens a recording whose pictures are fed in; `begin` starts the feeding.
    pub(crate) fn fed(
        input: Input,
        params: &SourceParameters,
        begin: impl FnOnce(&gst::Pipeline, &gst_app::AppSink) -> Result<(), CaptureError>,
    ) -> Result<Self, CaptureError> {
        let timing = if params.flow == Flow::Lossless { Timing::Stream } else { Timing::Paced };
        let threading = Threading::of(&input, params);
        let mut playback = Self::build(input, params, timing, threading)?;
        begin(&playback.pipeline, &playback.sink)?;
        let started = playback.pipeline.set_state(gst::State::Paused);
        let live = matches!(started, Ok(gst::StateChangeSuccess::NoPreroll));
        let patience = if started.is_ok() { OPENING } else { Duration::ZERO };
        if !live {
            let ready = playback
                .frames
                .wait_ready(patience)
                .map_err(|failure| playback.unopened(&failure))?;
            let Some(caps) = playback
                .sink
                .sink_pads()
                .first()
                .and_then(gst::Pad::current_caps)
                .filter(|_| ready)
            else {
                return Err(playback
                    .unopened(&Failure::of_ours("it holds no video frame that can be decoded")));
            };
            playback.examine(&caps)?;
            playback.declared =
                playback.pipeline.query_duration::<gst::ClockTime>().map(Duration::from);
        }
        Ok(playback)
    }

    /// Starts a camera. [`Self::next`] reports a failure of the start. `threading` is for its
    /// decoder; `None`: as configured.
    pub(crate) fn camera(
        input: Input,
        params: &SourceParameters,
        threading: Option<Threading>,
    ) -> Result<Self, CaptureError> {
        let threading = threading.unwrap_or_else(|| Threading::of(&input, params));
        let mut playback = Self::build(input, params, Timing::Arrival, threading)?;
        playback.stall = Some(params.stall);
        let started = playback.pipeline.set_state(gst::State::Paused);
        let live = matches!(started, Ok(gst::StateChangeSuccess::NoPreroll));
        playback.timing = match &playback.input {
            _ if params.flow == Flow::Lossless => Timing::Stream,
            Input::V4l2(_) => Timing::Driver,
            Input::Theta => Timing::Arrival,
            // Second case: the Theta's driver does not announce a live source.
            Input::Description(_) if live || playback.input.is_camera() => Timing::Arrival,
            Input::Description(_) | Input::File(_) | Input::Flight(..) => Timing::Paced,
        };
        playback.play();
        Ok(playback)
    }

    fn build(
        input: Input,
        params: &SourceParameters,
        timing: Timing,
        threading: Threading,
    ) -> Result<Self, CaptureError> {
        let expected = (params.width, params.height);
        let room = if params.flow == Flow::Lossless { 2 } else { 1 };
        let frames = Arc::new(Frames::new(room, params.flow));
        let packets = PacketTap::new(Arc::clone(&params.packets));
        // Only files can be decoded ahead.
        let ahead = match (&input, timing) {
            (Input::File(_) | Input::Flight(..), Timing::Paced) => AHEAD,
            _ => 0,
        };
        let (pipeline, sink, decoders) =
            build(&input, expected, threading, ahead, &packets, &frames)?;
        Ok(Self {
            input,
            pipeline,
            sink,
            frames,
            decoders,
            packets,
            threading,
            is_threading_fixed: params.decoder_threads > 0,
            held: 0,
            timing,
            expected,
            latency: params.latency,
            stall: None,
            playing: false,
            heard: Instant::now(),
            handed_out: 0,
            declared: None,
            reached: Duration::ZERO,
        })
    }

    fn unopened(&self, failure: &Failure) -> CaptureError {
        match &self.input {
            Input::File(path) | Input::Flight(path, _) => failure.for_file(path),
            Input::Description(text) => {
                CaptureError::Description { description: text.clone(), reason: failure.text() }
            }
            input @ (Input::V4l2(_) | Input::Theta) => {
                CaptureError::GStreamer(failure.for_running(input))
            }
        }
    }

    fn play(&mut self) {
        self.sink.set_sync(self.timing == Timing::Paced);
        self.playing = true;
        self.heard = Instant::now();
        if self.pipeline.set_state(gst::State::Playing).is_err() {
            self.frames.fail(Failure::of_ours("it does not start"));
        }
    }

    /// Waits for an event, for at most `timeout`.
    pub(crate) fn next(&mut self, timeout: Duration) -> Result<PlaybackEvent, CaptureError> {
        if !self.playing {
            self.play();
        }
        if let Some(noticed) = self.decoders.take().filter(|_| self.is_timed_by_arrival()) {
            return Ok(self.late(noticed));
        }
        Ok(match self.frames.take(timeout) {
            MailboxContent::Item(decoded) => PlaybackEvent::Picture(self.picture(decoded)?),
            MailboxContent::Ended => PlaybackEvent::Over { fault: self.shortage() },
            MailboxContent::Failed(failure) => {
                PlaybackEvent::Over { fault: Some(failure.for_running(&self.input)) }
            }
            MailboxContent::TimedOut => match self.stall {
                Some(stall) if self.heard.elapsed() >= stall => PlaybackEvent::Over {
                    fault: Some(format!(
                        "{}: no frame for {:.1} s. Cure: check the cable and the power",
                        self.input.name(),
                        stall.as_secs_f64()
                    )),
                },
                _ => PlaybackEvent::Idle,
            },
        })
    }

    /// Whether frames held in the decoder increase latency: other inputs are decoded ahead.
    fn is_timed_by_arrival(&self) -> bool {
        matches!(self.timing, Timing::Arrival | Timing::Driver)
    }

    fn late(&mut self, noticed: DecoderFault) -> PlaybackEvent {
        match noticed {
            DecoderFault::IsBehind(by) => {
                let processors = std::thread::available_parallelism()
                    .map_or(1, |count| u32::try_from(count.get()).unwrap_or(u32::MAX));
                let faster = self.threading.faster(processors);
                PlaybackEvent::Behind { by, faster: faster.filter(|_| !self.is_threading_fixed) }
            }
            DecoderFault::Holds { frames, delay, reordered } => {
                self.held = frames;
                let by_threads = match self.threading {
                    Threading::Frames(threads) => threads.saturating_sub(1) as usize,
                    Threading::Slices | Threading::Chosen(_) => 0,
                };
                PlaybackEvent::Late(format!(
                    "{}: {} holds {frames} frame{} back, which makes each {:.0} ms older: {}",
                    self.input.name(),
                    decoder::chosen(&self.pipeline).join(", "),
                    if frames == 1 { "" } else { "s" },
                    delay.as_secs_f64() * 1e3,
                    why_held(frames, by_threads, reordered, self.is_threading_fixed)
                ))
            }
        }
    }

    fn picture(&mut self, decoded: DecodedFrame) -> Result<SourcePicture, CaptureError> {
        self.heard = Instant::now();
        self.reached = self.reached.max(decoded.stream_end);
        let sequence = decoded.sequence;
        let unreadable =
            |reason: String| CaptureError::Frame { what: self.input.name(), sequence, reason };
        let caps = decoded
            .sample
            .caps()
            .ok_or_else(|| unreadable("it says nothing of its format".to_owned()))?;
        let info = self.examine(caps)?;
        let buffer =
            decoded.sample.buffer_owned().ok_or_else(|| unreadable("it is empty".to_owned()))?;
        let exposure_ns = self.exposure_ns(&decoded);
        let (stream_time, pts) = (decoded.stream_time, decoded.pts);
        let stamp = PictureStamp { sequence, stream_time, exposure_ns, pts };
        let picture = SourcePicture::map(buffer, &info, stamp)
            .map_err(|reason| CaptureError::Frame { what: self.input.name(), sequence, reason })?;
        self.handed_out += 1;
        Ok(picture)
    }

    fn exposure_ns(&mut self, decoded: &DecodedFrame) -> i64 {
        let latency_ns = self.latency.as_nanos() as i64;
        match self.timing {
            Timing::Stream => decoded.stream_time.as_nanos() as i64,
            Timing::Paced => decoded.due_ns.unwrap_or_else(monotonic_ns),
            Timing::Arrival => decoded.arrival_ns - latency_ns,
            Timing::Driver => {
                let arrival_ns = decoded.arrival_ns;
                let believable = arrival_ns - OLDEST_STAMP_NS..=arrival_ns + NEWEST_STAMP_NS;
                match decoded.due_ns.filter(|due_ns| believable.contains(due_ns)) {
                    Some(due_ns) => due_ns - latency_ns,
                    None => {
                        // Permanent change: alternating clocks would be worse than the coarser one.
                        self.timing = Timing::Arrival;
                        arrival_ns - latency_ns
                    }
                }
            }
        }
    }

    /// Checks that frames have the configured size.
    fn examine(&self, caps: &gst::CapsRef) -> Result<gst_video::VideoInfo, CaptureError> {
        let info = gst_video::VideoInfo::from_caps(caps).map_err(|error| CaptureError::Frame {
            what: self.input.name(),
            sequence: self.handed_out,
            reason: error.to_string(),
        })?;
        let found = (info.width(), info.height());
        if found != self.expected {
            return Err(CaptureError::Size {
                what: self.input.name(),
                expected: self.expected,
                found,
            });
        }
        Ok(info)
    }

    /// Text about missing video, if the frames end before the declared duration.
    fn shortage(&self) -> Option<String> {
        let declared = self.declared?;
        // The declared duration is that of the longest stream, which may not be the video.
        let tolerance = if decoder::streams(&self.pipeline) > 1 { 1.0 } else { 0.1 };
        (self.reached.as_secs_f64() + tolerance < declared.as_secs_f64()).then(|| {
            format!(
                "{} declares {:.2} s of video, its frames end at {:.2} s: the file was cut short",
                self.input.name(),
                declared.as_secs_f64(),
                self.reached.as_secs_f64()
            )
        })
    }

    pub(crate) fn describe(&self) -> String {
        let name = self.input.name();
        let caps = self.sink.sink_pads().first().and_then(gst::Pad::current_caps);
        let Some(info) = caps.and_then(|caps| gst_video::VideoInfo::from_caps(&caps).ok()) else {
            return format!(
                "{name}: {}x{} expected, no frame yet",
                self.expected.0, self.expected.1
            );
        };
        let rate = match f64::from(info.fps().numer()) / f64::from(info.fps().denom().max(1)) {
            rate if rate > 0.0 => format!(", {rate:.2} frames/s"),
            _ => String::new(),
        };
        let decoders = match decoder::chosen(&self.pipeline) {
            names if names.is_empty() => "not coded".to_owned(),
            names => format!("decoded by {}", names.join(", ")),
        };
        let held = match self.held {
            0 => String::new(),
            held => format!(", {held} frames late"),
        };
        let range = format!("{:?}", range_of(&info)).to_lowercase();
        format!(
            "{name}: {}x{}{rate}, {} ({range} range), {decoders}{held}",
            info.width(),
            info.height(),
            info.name()
        )
    }
}

impl Drop for Playback {
    fn drop(&mut self) {
        // Close the mailbox first: the state change waits for the decoder's thread.
        self.frames.close();
        if self.pipeline.set_state(gst::State::Null).is_err() {
            tracing::warn!(source = self.input.name(), "the source does not stop cleanly");
        }
    }
}

/// Reason and cure for held frames. `by_threads` of them are due to frame threads.
fn why_held(frames: usize, by_threads: usize, reordered: bool, is_fixed: bool) -> String {
    let mut reasons = Vec::new();
    if by_threads > 0 {
        reasons.push(format!(
            "{} frames are decoded at a time{}",
            by_threads + 1,
            match is_fixed {
                true => ". Cure: source.decoder_threads: 0, or 1",
                false => ", because one thread does not keep up. Cure: a hardware decoder",
            }
        ));
    }
    if frames > by_threads && reordered {
        reasons.push(
            "the stream has frames that rest on later ones (B-frames). Cure: switch them off in the \
             camera's encoder"
                .to_owned(),
        );
    } else if frames > by_threads {
        reasons.push(
            "it waits for frames to be reordered, and none are. Cure: an encoder that says so (baseline \
             profile, or max_num_reorder_frames 0), or another decoder"
                .to_owned(),
        );
    }
    reasons.join("; ")
}
