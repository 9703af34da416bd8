//! `frame_end` and `track`: the results of a frame.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::error::{check_finite, check_unit};
use crate::{ContractError, FrameStamp, MeasuredBy, StopReason, Text, TrackState};

/// Header of `frame_end`: rectification has finished a frame. No payload.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/FrameEnd")]
#[repr(C)]
pub struct FrameEnd {
    /// The frame.
    pub stamp: FrameStamp,
    /// The executed plan; 0 where rectification swept on its own.
    pub plan_id: u64,
    /// Start of the work on the frame, CLOCK_MONOTONIC, nanoseconds. A latency field.
    pub taken_ns: i64,
    /// Publication of its last view, CLOCK_MONOTONIC, nanoseconds. A latency field.
    pub ended_ns: i64,
    /// Number of published views; their indices are 0 to this number less one.
    pub views_issued: u32,
    /// Number of views of the plan that were not published.
    pub views_abandoned: u32,
    /// A [`StopReason`].
    pub reason: u32,
    /// Rises each time rectification's process is replaced.
    pub generation: u32,
}

impl FrameEnd {
    /// Refuses an unknown reason.
    pub fn check(&self) -> Result<(), ContractError> {
        StopReason::try_from(self.reason)?;
        Ok(())
    }
}

/// A rigid transform `a_from_b`: p_a = R(orientation) p_b + position.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/Pose")]
#[repr(C)]
pub struct Pose {
    /// Metres.
    pub position: [f64; 3],
    /// Unit quaternion x y z w.
    pub orientation: [f64; 4],
}

impl Default for Pose {
    fn default() -> Self {
        Self { position: [0.0; 3], orientation: [0.0, 0.0, 0.0, 1.0] }
    }
}

impl Pose {
    /// Refuses positions that are not finite and orientations that are no rotations.
    pub fn check(&self) -> Result<(), ContractError> {
        check_finite("position", &self.position)?;
        check_unit(&self.orientation)
    }
}

/// Header of `track`. Payload: the [`Track`]s that this message updates.
///
/// A frame may produce several messages: each neighbour's pose is published as soon as it is known.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/TrackHeader")]
#[repr(C)]
pub struct TrackHeader {
    /// Newest frame in these tracks.
    pub stamp: FrameStamp,
    /// Rises each time fusion's process is replaced.
    pub generation: u32,
    /// 1 in the message that ends the frame (it may have no track), 0 in earlier ones.
    pub is_last: u32,
}

/// Latency of each stage for the data of a track, nanoseconds; -1 where it is unknown.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/StageLatency")]
#[repr(C)]
pub struct StageLatency {
    /// Exposure to frame published; -1 in a lossless run.
    pub capture_ns: i64,
    /// Frame published to view published.
    pub rectification_ns: i64,
    /// View published to detection published; -1 where the pose did not wait for it.
    pub detection_ns: i64,
    /// Detection published (view published, where it was not waited for) to track published.
    pub fusion_ns: i64,
    /// Exposure (in a lossless run: frame published) to track published.
    pub total_ns: i64,
}

/// State of a neighbour after one frame.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/Track")]
#[repr(C)]
pub struct Track {
    /// Filtered pose of the target drone in the observer drone's frame.
    pub observer_from_target: Pose,
    /// Its covariance, 6x6 row-major: position (m), then rotation vector (rad), both in the
    /// observer's frame. Where `is_ambiguous` is 1, it covers the rival too.
    pub covariance: [f64; 36],
    /// Velocity of the target relative to the observer, along the observer's axes, m/s. Where the
    /// observer's own rotation is known (`rotation`), it is subtracted. Then a neighbour that
    /// stands still has no velocity while the observer yaws. Otherwise it is the change of the
    /// position in the observer's frame.
    pub linear_velocity: [f64; 3],
    /// Angular velocity of the target along the observer's axes, rad/s. The observer's own rotation
    /// is subtracted as above.
    pub angular_velocity: [f64; 3],
    /// This frame's own measurement of the same pose, where `measured_by` is not `nothing`.
    pub measured_observer_from_target: Pose,
    /// Its covariance, as above.
    pub measured_covariance: [f64; 36],
    /// The filtered pose, predicted for `predicted_ns`, in the observer's frame at that time.
    pub predicted_observer_from_target: Pose,
    /// Its covariance, as above.
    pub predicted_covariance: [f64; 36],
    /// Another pose that the target may have instead of the filtered one, where `is_ambiguous` is 1:
    /// for example the mirror pose of a flat marker. If one of the two is true, the other is false.
    pub rival_observer_from_target: Pose,
    /// Its covariance, as above.
    pub rival_covariance: [f64; 36],
    /// Log odds of the filtered pose against the rival, at least 0. The rival's probability is
    /// 1 / (1 + e^lead).
    pub rival_lead: f64,
    /// Time for which `predicted_observer_from_target` holds, on the clock of the exposures: the
    /// sending time. In a lossless run, which is not in real time, it is the exposure.
    pub predicted_ns: i64,
    /// Time since the track began, nanoseconds.
    pub age_ns: i64,
    /// Time since it was last measured, nanoseconds.
    pub unseen_ns: i64,
    /// Latency of each stage.
    pub latency: StageLatency,
    /// The target's name, as configured.
    pub name: Text<32>,
    /// Index of the target's body in the configuration.
    pub target: u32,
    /// Rises each time a new track of this target begins.
    pub track_id: u32,
    /// A [`TrackState`].
    pub state: u32,
    /// A [`MeasuredBy`].
    pub measured_by: u32,
    /// Number of markers of the target decoded in this frame so far.
    pub markers: u32,
    /// 1 where the rival is possible. Nothing is published as measured then.
    pub is_ambiguous: u32,
}

#[expect(clippy::derivable_impls, reason = "arrays of 36 elements have no default")]
impl Default for Track {
    fn default() -> Self {
        Self {
            observer_from_target: Pose::default(),
            measured_observer_from_target: Pose::default(),
            predicted_observer_from_target: Pose::default(),
            rival_observer_from_target: Pose::default(),
            ..Self::zeroed()
        }
    }
}

/// Name of the state of a track whose rival is possible, for people.
pub const AMBIGUOUS: &str = "ambiguous";

impl Track {
    /// Name of the track's state, for people: [`AMBIGUOUS`] where the rival is possible.
    pub fn state_name(&self) -> &'static str {
        match TrackState::try_from(self.state) {
            Ok(_) if self.is_ambiguous != 0 => AMBIGUOUS,
            Ok(state) => state.name(),
            Err(_) => "unknown",
        }
    }

    /// Whether this frame gave a precise pose. A track that an imprecise pose has corrected is
    /// confirmed, too.
    pub fn is_measured(&self) -> bool {
        self.measured_by != MeasuredBy::Nothing.code()
    }

    /// Refuses unknown states and invalid poses.
    pub fn check(&self) -> Result<(), ContractError> {
        TrackState::try_from(self.state)?;
        self.observer_from_target.check()?;
        check_finite("covariance", &self.covariance)?;
        check_finite("velocity", &self.linear_velocity)?;
        check_finite("velocity", &self.angular_velocity)?;
        self.predicted_observer_from_target.check()?;
        check_finite("predicted covariance", &self.predicted_covariance)?;
        if self.is_ambiguous != 0 {
            self.rival_observer_from_target.check()?;
            check_finite("rival's covariance", &self.rival_covariance)?;
            check_finite("rival's lead", &[self.rival_lead])?;
        }
        if MeasuredBy::try_from(self.measured_by)? != MeasuredBy::Nothing {
            self.measured_observer_from_target.check()?;
            check_finite("measured covariance", &self.measured_covariance)?;
        }
        Ok(())
    }
}
