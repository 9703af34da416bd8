//! One report on one target, typed.

use std::time::Duration;

use flockeye_contract::wire::{self, Degenerate, Sighting, TargetReport};
use flockeye_contract::{FrameStamp, MeasuredBy, Pose, Track, TrackState};
use flockeye_convert::{isometry, matrix6, symmetric6};
use flockeye_network::TimedSighting;
use nalgebra::Vector3;

use crate::uncertain_pose::UncertainPose;

/// One drone's sighting of another, from a report that passed all checks.
#[derive(Debug, Clone, PartialEq)]
pub struct PeerReport {
    /// Name of the drone with the camera.
    pub observer: String,
    /// Name of the drone in its picture.
    pub target: String,
    /// Epoch and number of the observer's camera frame.
    pub frame: (u32, u64),
    /// State of the track.
    pub state: TrackState,
    /// Method of this frame's measurement.
    pub measured_by: MeasuredBy,
    /// Filtered pose of the target in the observer's frame (x forward, y left, z up), and its
    /// covariance there.
    pub observer_from_target: UncertainPose,
    /// This frame's own measurement of that pose, where the report has one.
    pub measured: Option<UncertainPose>,
    /// Another pose that the target may have instead, where the track is ambiguous.
    /// `observer_from_target` has a covariance that covers both then.
    pub rival: Option<Rival>,
    /// Velocity relative to the observer, along its axes, m/s.
    pub velocity: Vector3<f64>,
    /// Angular velocity relative to the observer, along its axes, rad/s.
    pub rate: Vector3<f64>,
    /// Directions in which the pose is nearly unknown.
    pub degenerate: Option<Degenerate>,
    /// Mid-exposure on this machine's CLOCK_MONOTONIC, by the estimate of the observer's clock,
    /// nanoseconds.
    pub exposure_monotonic_ns: i64,
    /// Standard deviation of the exposure time, nanoseconds.
    pub exposure_deviation_ns: i64,
}

/// A pose that is possible beside the filtered one. If one of the two is true, the other is false.
#[derive(Debug, Clone, PartialEq)]
pub struct Rival {
    /// The pose, with its own covariance.
    pub observer_from_target: UncertainPose,
    /// Log odds of the filtered pose against this one, at least 0.
    pub lead: f64,
}

impl PeerReport {
    /// A report from the local topic `track` of a drone's own pipeline, with the exposure on
    /// CLOCK_MONOTONIC. `None` for a track with unknown codes.
    pub fn of_track(
        observer: &str,
        stamp: &FrameStamp,
        exposure_monotonic_ns: i64,
        track: &Track,
    ) -> Option<Self> {
        let uncertain = |pose: &Pose, covariance: &[f64; 36]| UncertainPose {
            a_from_b: isometry(pose),
            covariance: matrix6(covariance),
        };
        let measured_by = MeasuredBy::try_from(track.measured_by).ok()?;
        let measured = (measured_by != MeasuredBy::Nothing)
            .then(|| uncertain(&track.measured_observer_from_target, &track.measured_covariance));
        Some(Self {
            observer: observer.to_owned(),
            target: track.name.to_string(),
            frame: (stamp.epoch, stamp.sequence),
            state: TrackState::try_from(track.state).ok()?,
            measured_by,
            observer_from_target: uncertain(&track.observer_from_target, &track.covariance),
            measured,
            rival: (track.is_ambiguous != 0).then(|| Rival {
                observer_from_target: uncertain(
                    &track.rival_observer_from_target,
                    &track.rival_covariance,
                ),
                lead: track.rival_lead,
            }),
            velocity: track.linear_velocity.into(),
            rate: track.angular_velocity.into(),
            degenerate: None,
            exposure_monotonic_ns,
            exposure_deviation_ns: 0,
        })
    }

    /// Age of the pose, from the middle of the exposure to now.
    pub fn age(&self) -> Duration {
        let age_ns =
            flockeye_network::monotonic_now_ns().saturating_sub(self.exposure_monotonic_ns);
        Duration::from_nanos(u64::try_from(age_ns).unwrap_or(0))
    }

    /// The observer's pose in its target's frame: for a sighting of this drone, the peer's pose in
    /// this drone's frame.
    pub fn target_from_observer(&self) -> UncertainPose {
        self.observer_from_target.inverse()
    }
}

impl From<&TimedSighting> for PeerReport {
    fn from(heard: &TimedSighting) -> Self {
        let Sighting { observer, target, frame, epoch, .. } = &heard.report;
        let pose = |position, orientation, covariance: &[f64; 21]| UncertainPose {
            a_from_b: isometry(&Pose { position, orientation }),
            covariance: symmetric6(covariance),
        };
        let TargetReport { position, orientation, covariance, .. } = target;
        Self {
            observer: observer.clone(),
            target: target.name.clone(),
            frame: (*epoch, *frame),
            state: target.state,
            measured_by: target.measured_by,
            observer_from_target: pose(*position, *orientation, covariance),
            measured: target.measured.as_ref().map(|measured| {
                pose(measured.position, measured.orientation, &measured.covariance)
            }),
            rival: target.rival.as_ref().map(|rival| {
                let wire::Rival { position, orientation, covariance, lead } = rival;
                let observer_from_target = pose(*position, *orientation, covariance);
                Rival { observer_from_target, lead: *lead }
            }),
            velocity: target.linear_velocity.into(),
            rate: target.angular_velocity.into(),
            degenerate: target.degenerate,
            exposure_monotonic_ns: heard.exposure_monotonic_ns,
            exposure_deviation_ns: heard.exposure_deviation_ns,
        }
    }
}
