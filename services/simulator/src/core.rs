//! The core of the simulator: the order in which frames are drawn and published, and their
//! messages. It has no port, no clock and no thread; [`World`] draws the pictures.
//!
//! [`Core::step`] returns the next action. [`Core::on`] takes the outcome of the wait for a drawn
//! frame.

use flockeye_config::{Flow, InertialSource, Resolved};
use flockeye_contract::{BodyTruth, FrameHeader, FrameStamp, ImuHeader, ImuSample, TruthHeader};
use flockeye_convert::frame_header;
use flockeye_geometry::body::{Bodies, Body};
use nalgebra::Isometry3;

use crate::ahead::{DrawOutcome, DrawnFrame};
use crate::inertial::InertialSensor;
use crate::messages::truth_message;
use crate::{FrameTruth, World};

/// Time from the copy of a frame into shared memory to its publication, nanoseconds: several times
/// the duration of a copy.
const COPY_AHEAD_NS: i64 = 10_000_000;

#[derive(Debug)]
pub(crate) enum Action {
    /// Draw this frame and publish it at once.
    Draw(u64),
    /// Wait for the next frame that is drawn ahead of its time.
    Await,
    /// Copy a frame, and publish it when it is due.
    HandOver(Box<DrawnFrame>),
    /// Drop a frame and return its memory: the next frame is due already.
    LeaveOut(Box<DrawnFrame>),
    /// Do nothing until this time, CLOCK_MONOTONIC, nanoseconds.
    WaitUntil(i64),
    /// End: the last frame is sent.
    Finish,
}

/// The messages of a frame in the order of sending: a receiver of the frame has the others already.
#[derive(Debug, Clone, PartialEq)]
pub struct PictureMessages {
    /// Samples of the inertial sensor up to the end of the exposure; `None` without a sensor.
    pub inertial: Option<(ImuHeader, Vec<ImuSample>)>,
    /// The poses of the camera and of all bodies.
    pub truth: (TruthHeader, Vec<BodyTruth>),
    /// What belongs to the luma plane.
    pub frame: FrameHeader,
}

/// State of the simulator between frames.
pub(crate) struct Core {
    pace: FramePace,
    /// Header fields that are equal in all frames.
    common: FrameHeader,
    bodies: Vec<Body>,
    observer_from_camera: Isometry3<f64>,
    sensor: Option<InertialSensor>,
    pub(crate) last_frame: u64,
    /// Whether the sensor has given its first samples.
    has_joined: bool,
}

/// The time at which frames are drawn.
enum FramePace {
    /// On request, in a lossless run.
    OnDemand { next_frame: u64 },
    /// Ahead of their time, in flight.
    Ahead { waiting: Option<Box<DrawnFrame>>, is_over: bool },
}

impl Core {
    /// The core for a configuration, in generation `generation` of this stage. The bodies `flying`
    /// are those in `world`.
    pub(crate) fn new(
        resolved: &Resolved,
        world: &World,
        flying: Option<&Bodies>,
        generation: u32,
    ) -> Self {
        let pipeline = &resolved.pipeline;
        let settings = &pipeline.simulator;
        let sensor = match pipeline.inertial.parsed_source() {
            Ok(InertialSource::Simulated) => {
                let seed = world.parameters().seed;
                Some(InertialSensor::new(world.motion.clone(), &settings.inertial, seed))
            }
            _ => None,
        };
        Self {
            pace: match pipeline.flow() {
                Flow::Lossless => FramePace::OnDemand { next_frame: 0 },
                Flow::Latest => FramePace::Ahead { waiting: None, is_over: false },
            },
            common: FrameHeader {
                stamp: FrameStamp { source_generation: generation, ..FrameStamp::default() },
                ..frame_header(&resolved.camera, resolved.transfer, pipeline.camera.readout_ms)
            },
            bodies: flying.into_iter().flat_map(Bodies::iter).cloned().collect(),
            observer_from_camera: resolved.observer_from_camera,
            sensor,
            last_frame: settings.frames.checked_sub(1).unwrap_or(u64::MAX),
            has_joined: false,
        }
    }

    pub(crate) fn has_sensor(&self) -> bool {
        self.sensor.is_some()
    }

    /// Width and height of a frame, pixels.
    pub(crate) fn size_px(&self) -> (u32, u32) {
        (self.common.width, self.common.height)
    }

    /// Takes the outcome of [`Action::Await`]. Returns the number of frames that were dropped at
    /// the end.
    pub(crate) fn on(&mut self, delivery: DrawOutcome) -> u64 {
        let FramePace::Ahead { waiting, is_over } = &mut self.pace else { return 0 };
        match delivery {
            DrawOutcome::Frame(drawn) => *waiting = Some(drawn),
            DrawOutcome::NotYet => {}
            DrawOutcome::Over { skipped } => {
                *is_over = true;
                return skipped;
            }
        }
        0
    }

    /// The next action at `now_ns`, CLOCK_MONOTONIC.
    pub(crate) fn step(&mut self, now_ns: i64) -> Action {
        match &mut self.pace {
            FramePace::OnDemand { next_frame } => {
                let frame = *next_frame;
                if frame > self.last_frame {
                    return Action::Finish;
                }
                *next_frame = frame + 1;
                Action::Draw(frame)
            }
            FramePace::Ahead { waiting, is_over } => {
                let Some(drawn) = waiting.take() else {
                    return if *is_over { Action::Finish } else { Action::Await };
                };
                let early_ns = drawn.times.handover_ns.saturating_sub(COPY_AHEAD_NS);
                if now_ns < early_ns {
                    *waiting = Some(drawn);
                    return Action::WaitUntil(early_ns);
                }
                match drawn.times.next_ns <= now_ns {
                    true => Action::LeaveOut(drawn),
                    false => Action::HandOver(drawn),
                }
            }
        }
    }

    /// The messages of a frame that is published at `now_ns`. The middle of its exposure is
    /// `exposure_ns`; `None` in a lossless run, which uses stream time.
    pub(crate) fn messages(
        &mut self,
        truth: &FrameTruth,
        exposure_ns: Option<i64>,
        now_ns: i64,
    ) -> PictureMessages {
        let stream_ns = (truth.time_s * 1e9).round() as i64;
        let stamp = FrameStamp {
            sequence: truth.frame,
            exposure_ns: exposure_ns.unwrap_or(stream_ns),
            stream_ns,
            published_ns: now_ns,
            ..self.common.stamp
        };
        let exposure_time_ns = (truth.exposure_s * 1e9).round() as u64;
        PictureMessages {
            inertial: self.samples(stamp, truth, now_ns),
            truth: truth_message(stamp, truth, &self.bodies, &self.observer_from_camera),
            frame: FrameHeader { stamp, exposure_time_ns, ..self.common },
        }
    }

    /// The samples up to the end of the exposure, when the picture is available.
    fn samples(
        &mut self,
        stamp: FrameStamp,
        truth: &FrameTruth,
        now_ns: i64,
    ) -> Option<(ImuHeader, Vec<ImuSample>)> {
        let sensor = self.sensor.as_mut()?;
        if !std::mem::replace(&mut self.has_joined, true) {
            sensor.join(truth.time_s);
        }
        let zero_ns = stamp.exposure_ns - stamp.stream_ns;
        let samples = sensor.until(truth.time_s + truth.exposure_s / 2.0, zero_ns);
        let generation = stamp.source_generation;
        Some((ImuHeader { sent_ns: now_ns, epoch: 0, generation }, samples))
    }
}

#[cfg(test)]
mod tests;
