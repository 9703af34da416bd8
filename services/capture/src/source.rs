//! Common interface of all sources: a series of events.

use std::time::{Duration, Instant};

use flockeye_config::Flow;
use flockeye_contract::VideoCodec;
use flockeye_runtime::backoff::Backoff;
use flockeye_runtime::lock::lock;
use gstreamer as gst;

use crate::decoder::{self, Threading};
use crate::file;
use crate::folder::Folder;
use crate::input::Input;
use crate::packet_tap::Packet;
use crate::playback::{Playback, PlaybackEvent};
use crate::recorded_flight::Flight;
use crate::{CaptureError, EndReason, Event, SourceParameters, SourceSpec};

/// A camera, a video file, a folder of images or a recorded flight, as a source of luma planes.
#[derive(Debug)]
pub struct FrameSource {
    spec: SourceSpec,
    params: SourceParameters,
    state: SourceState,
    backoff: Backoff,
    /// Threading of a camera's decoder after it was found too slow.
    threading: Option<Threading>,
    has_said_late: bool,
    has_said_behind: bool,
}

#[derive(Debug)]
enum SourceState {
    Recording(Playback),
    Folder(Folder),
    Flight(Box<Flight>),
    Camera(Input, Playback),
    /// A lost camera, and the time of the next attempt.
    Lost(Input, Instant),
    Ended(EndReason),
}

impl FrameSource {
    /// Opens a source. A recording's first frame is decoded here, so that errors are found here. It
    /// is played from the first [`Self::next`] on. A camera is started; a missing camera is
    /// [`Event::Lost`], because it may be connected later.
    pub fn open(spec: SourceSpec, params: SourceParameters) -> Result<Self, CaptureError> {
        gst::init().map_err(|error| CaptureError::GStreamer(error.to_string()))?;
        for (name, value) in [("camera.width", params.width), ("camera.height", params.height)] {
            if value == 0 {
                return Err(CaptureError::Parameter {
                    name,
                    value: "0".to_owned(),
                    cure: "set it to the size of the frames",
                });
            }
        }
        let state = start(&spec, &params)?;
        let backoff = Backoff::new(params.reopen_min, params.reopen_max);
        Ok(Self {
            spec,
            params,
            state,
            backoff,
            threading: None,
            has_said_late: false,
            has_said_behind: false,
        })
    }

    /// Waits for an event, for at most `timeout`. A repeated opening, or decoding of an image of a
    /// folder, may take longer.
    ///
    /// An error is final: the source cannot be used with this configuration.
    pub fn next(&mut self, timeout: Duration) -> Result<Event, CaptureError> {
        match &mut self.state {
            SourceState::Recording(playback) => Ok(match playback.next(timeout)? {
                PlaybackEvent::Picture(picture) => Event::Frame(picture),
                // Frames of a recording are decoded ahead, so these events have no effect.
                PlaybackEvent::Idle | PlaybackEvent::Late(_) | PlaybackEvent::Behind { .. } => {
                    Event::Idle
                }
                PlaybackEvent::Over { fault } => {
                    let decoded = playback.handed_out;
                    let reason = match fault {
                        Some(reason) => EndReason::Truncated { decoded, reason },
                        None => EndReason::Complete { frames: decoded, skipped: 0 },
                    };
                    self.loop_or_end(Event::End(reason))?
                }
            }),
            SourceState::Folder(folder) => {
                let event = folder.next(timeout);
                self.loop_or_end(event)
            }
            SourceState::Flight(flight) => {
                let event = flight.next(timeout)?;
                self.loop_or_end(event)
            }
            SourceState::Camera(input, playback) => Ok(match playback.next(timeout)? {
                PlaybackEvent::Picture(picture) => {
                    self.backoff.reset();
                    Event::Frame(picture)
                }
                PlaybackEvent::Idle => Event::Idle,
                PlaybackEvent::Late(what) => said_once(&mut self.has_said_late, what),
                PlaybackEvent::Behind { by, faster: Some(faster) } => {
                    let reason = format!(
                        "{}: its frames wait {:.0} ms before the decoder, which now decodes several at \
                         a time",
                        input.name(),
                        by.as_secs_f64() * 1e3
                    );
                    self.threading = Some(faster);
                    self.state = SourceState::Lost(input.clone(), Instant::now());
                    Event::Lost { reason, retry_in: Duration::ZERO }
                }
                PlaybackEvent::Behind { by, faster: None } => {
                    let what = format!(
                        "{}: its frames wait {:.0} ms before the decoder, ever longer. Cure: \
                         source.decoder_threads: 0, a hardware decoder, or smaller frames",
                        input.name(),
                        by.as_secs_f64() * 1e3
                    );
                    said_once(&mut self.has_said_behind, what)
                }
                PlaybackEvent::Over { fault } => {
                    let reason =
                        fault.unwrap_or_else(|| format!("{}: its stream has ended", input.name()));
                    let retry_in = self.backoff.after_failure();
                    self.state = SourceState::Lost(input.clone(), Instant::now() + retry_in);
                    Event::Lost { reason, retry_in }
                }
            }),
            SourceState::Lost(input, until) => {
                let now = Instant::now();
                if now < *until {
                    std::thread::sleep(timeout.min(*until - now));
                    return Ok(Event::Idle);
                }
                let input = input.clone();
                let playback = Playback::camera(input.clone(), &self.params, self.threading)?;
                self.state = SourceState::Camera(input, playback);
                self.next(timeout)
            }
            SourceState::Ended(reason) => Ok(Event::End(reason.clone())),
        }
    }

    /// Returns the event. At the end of a recording with frames, starts it again if looping is
    /// configured.
    fn loop_or_end(&mut self, event: Event) -> Result<Event, CaptureError> {
        let Event::End(reason) = event else { return Ok(event) };
        let (EndReason::Complete { frames, .. } | EndReason::Truncated { decoded: frames, .. }) =
            reason;
        if self.params.looping && frames > 0 {
            self.state = start(&self.spec, &self.params)?;
            return Ok(Event::Looped { after: reason });
        }
        self.state = SourceState::Ended(reason.clone());
        Ok(Event::End(reason))
    }

    /// A description for people: source, size, rate, format and decoder. For a camera it is
    /// complete after the first frame.
    pub fn describe(&self) -> String {
        match &self.state {
            SourceState::Recording(playback) | SourceState::Camera(_, playback) => {
                playback.describe()
            }
            SourceState::Folder(folder) => folder.describe(),
            SourceState::Flight(flight) => flight.describe(),
            SourceState::Lost(input, _) => format!("{}: lost", input.name()),
            SourceState::Ended(reason) => format!("{}: {reason}", self.spec),
        }
    }

    /// Takes the coded pictures since the last call, if they are requested
    /// ([`SourceParameters::packets`]).
    pub fn take_packets(&self) -> Vec<Packet> {
        match &self.state {
            SourceState::Recording(playback) | SourceState::Camera(_, playback) => {
                lock(&playback.packets).take()
            }
            _ => Vec::new(),
        }
    }

    /// Codec of the pictures; `None` while it is unknown.
    pub fn codec(&self) -> Option<VideoCodec> {
        match &self.state {
            SourceState::Recording(playback) | SourceState::Camera(_, playback) => {
                lock(&playback.packets).codec()
            }
            SourceState::Folder(_) | SourceState::Flight(_) => Some(VideoCodec::None),
            SourceState::Lost(..) | SourceState::Ended(_) => None,
        }
    }

    /// Whether the pictures come from a video decoder. Known from the first picture on.
    pub fn decodes_video(&self) -> bool {
        match &self.state {
            SourceState::Recording(playback) | SourceState::Camera(_, playback) => {
                decoder::takes_video(&playback.pipeline)
            }
            SourceState::Flight(flight) => flight.decodes_video(),
            SourceState::Folder(_) | SourceState::Lost(..) | SourceState::Ended(_) => false,
        }
    }

    /// Whether the source is a camera, which has no end and may be lost.
    pub fn is_camera(&self) -> bool {
        matches!(self.state, SourceState::Camera(..) | SourceState::Lost(..))
    }
}

/// An event with the reason of late frames, at the first call only.
fn said_once(has_said: &mut bool, what: String) -> Event {
    match std::mem::replace(has_said, true) {
        false => Event::Late { what },
        true => Event::Idle,
    }
}

fn start(spec: &SourceSpec, params: &SourceParameters) -> Result<SourceState, CaptureError> {
    let recording = |input: Input| Ok(SourceState::Recording(Playback::recording(input, params)?));
    let camera = |input: Input| {
        Ok(SourceState::Camera(input.clone(), Playback::camera(input, params, None)?))
    };
    match spec {
        SourceSpec::File(path) => {
            file::check(path)?;
            recording(Input::File(path.clone()))
        }
        SourceSpec::Flight(path) => Ok(SourceState::Flight(Box::new(Flight::open(path, params)?))),
        SourceSpec::Folder(path) => Ok(SourceState::Folder(Folder::open(path, params)?)),
        SourceSpec::V4l2(device) => camera(Input::V4l2(device.clone())),
        SourceSpec::Theta => camera(Input::Theta),
        SourceSpec::Description(text) => match params.flow {
            Flow::Latest => camera(Input::Description(text.clone())),
            Flow::Lossless => recording(Input::Description(text.clone())),
        },
    }
}
