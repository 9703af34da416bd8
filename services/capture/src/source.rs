//! A source: whatever it is, the same events come out of it.

use std::time::{Duration, Instant};

use flockeye_config::Flow;
use flockeye_contract::VideoCodec;
use flockeye_runtime::backoff::Backoff;
use gstreamer as gst;

use crate::decoder::{self, Threading};
use crate::file;
use crate::folder::Folder;
use crate::input::Input;
use crate::packet_tap::Packet;
use crate::playback::{Playback, PlaybackEvent};
use crate::recorded_flight::Flight;
use crate::{CaptureError, EndReason, Event, SourceParameters, SourceSpec};

/// A camera, a video file or a folder of images that hands out luma planes.
#[derive(Debug)]
pub struct FrameSource {
    spec: SourceSpec,
    params: SourceParameters,
    state: SourceState,
    backoff: Backoff,
    /// What a camera's decoder turned out to need.
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
    /// A camera that is lost, until it is time to open it again.
    Lost(Input, Instant),
    Ended(EndReason),
}

impl FrameSource {
    /// Opens a source. A recording's first frame is decoded here, so that everything that keeps it
    /// from being played is an error here; it begins to play at the first [`Self::next`]. A camera
    /// is started; one that is not there is [`Event::Lost`], for it may still come.
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

    /// Waits for at most `timeout` for something to happen. Opening a camera or a recording anew,
    /// and decoding an image of a folder, may take longer.
    ///
    /// An error is final: the source cannot be used as it is configured.
    pub fn next(&mut self, timeout: Duration) -> Result<Event, CaptureError> {
        match &mut self.state {
            SourceState::Recording(playback) => Ok(match playback.next(timeout)? {
                PlaybackEvent::Picture(picture) => Event::Frame(picture),
                // A recording's frames are decoded before they are due.
                PlaybackEvent::Idle | PlaybackEvent::Late(_) | PlaybackEvent::Behind { .. } => {
                    Event::Idle
                }
                PlaybackEvent::Over { fault } => {
                    let decoded = playback.handed_out;
                    let reason = match fault {
                        Some(reason) => EndReason::Truncated { decoded, reason },
                        None => EndReason::Complete { frames: decoded, skipped: 0 },
                    };
                    self.or_over(Event::End(reason))?
                }
            }),
            SourceState::Folder(folder) => {
                let event = folder.next(timeout);
                self.or_over(event)
            }
            SourceState::Flight(flight) => {
                let event = flight.next(timeout)?;
                self.or_over(event)
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

    /// Passes an event on. A recording that is over starts again where that is asked for, unless
    /// nothing came out of it.
    fn or_over(&mut self, event: Event) -> Result<Event, CaptureError> {
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

    /// A line for people: what is played, its size, rate and format, and which decoder was
    /// chosen. A camera's is complete once its first frame is there.
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

    /// The coded pictures that have come since the last time, if somebody wants them
    /// ([`SourceParameters::packets`]).
    pub fn take_packets(&self) -> Vec<Packet> {
        match &self.state {
            SourceState::Recording(playback) | SourceState::Camera(_, playback) => {
                playback.packets.take()
            }
            _ => Vec::new(),
        }
    }

    /// How its pictures are coded; `None` while that is not known.
    pub fn codec(&self) -> Option<VideoCodec> {
        match &self.state {
            SourceState::Recording(playback) | SourceState::Camera(_, playback) => {
                playback.packets.codec()
            }
            SourceState::Folder(_) | SourceState::Flight(_) => Some(VideoCodec::None),
            SourceState::Lost(..) | SourceState::Ended(_) => None,
        }
    }

    /// Whether its pictures come out of a decoder of video. It is known from the first one on.
    pub fn decodes_video(&self) -> bool {
        match &self.state {
            SourceState::Recording(playback) | SourceState::Camera(_, playback) => {
                decoder::takes_video(&playback.pipeline)
            }
            SourceState::Flight(flight) => flight.decodes_video(),
            SourceState::Folder(_) | SourceState::Lost(..) | SourceState::Ended(_) => false,
        }
    }

    /// Whether the source is a camera, which never ends and may be lost.
    pub fn is_camera(&self) -> bool {
        matches!(self.state, SourceState::Camera(..) | SourceState::Lost(..))
    }
}

/// What makes frames late, unless it has been said.
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
