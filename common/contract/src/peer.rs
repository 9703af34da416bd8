//! `peer` and `swarm`: reports of other drones, and fused poses of the whole swarm.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::error::check_finite;
use crate::{ContractError, MeasuredBy, Pose, SwarmWay, Text, TrackState};

/// Header of `peer`. Payload: the [`PeerSighting`]s of one report.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/PeerHeader")]
#[repr(C)]
pub struct PeerHeader {
    /// Arrival of the report, CLOCK_MONOTONIC of this machine, nanoseconds.
    pub arrived_ns: i64,
    /// Rises each time the gateway's process is replaced.
    pub generation: u32,
    /// Keeps the size a multiple of 8; zero.
    pub reserved: u32,
}

/// Pose of one target that a peer reported, after all checks.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/PeerSighting")]
#[repr(C)]
pub struct PeerSighting {
    /// Filtered pose of the target in the frame of the reporting drone.
    pub observer_from_target: Pose,
    /// Its covariance, 6x6 row-major: position (m), then rotation vector (rad), both in the
    /// observer's frame.
    pub covariance: [f64; 36],
    /// Inverse: pose of the observer in the frame of its target. If this drone is the target, it is
    /// the pose of the peer in this drone's frame.
    pub target_from_observer: Pose,
    /// Its covariance, in the target's frame.
    pub inverse_covariance: [f64; 36],
    /// Velocity of the target relative to the observer, along the observer's axes, m/s.
    pub linear_velocity: [f64; 3],
    /// Angular velocity of the target along the observer's axes, rad/s.
    pub angular_velocity: [f64; 3],
    /// Mid-exposure on this machine's CLOCK_MONOTONIC, by the estimate of the peer's clock,
    /// nanoseconds.
    pub exposure_ns: i64,
    /// Standard deviation of that, nanoseconds.
    pub exposure_deviation_ns: i64,
    /// Number of the frame in its epoch, by the observer's count.
    pub frame: u64,
    /// Name of the observer.
    pub observer: Text<32>,
    /// Name of the target.
    pub target: Text<32>,
    /// Epoch of the source, by the observer's count.
    pub epoch: u32,
    /// A [`TrackState`].
    pub state: u32,
    /// A [`MeasuredBy`].
    pub measured_by: u32,
    /// 1 if the target is this drone.
    pub is_own: u32,
}

/// Header of `swarm`. Payload: a [`SwarmPose`] for each drone whose pose is known.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/SwarmHeader")]
#[repr(C)]
pub struct SwarmHeader {
    /// Time of the poses, CLOCK_MONOTONIC, nanoseconds.
    pub at_ns: i64,
    /// Sending time, CLOCK_MONOTONIC, nanoseconds. A latency field.
    pub sent_ns: i64,
    /// Rises each time the gateway's process is replaced.
    pub generation: u32,
    /// Number of observers that are left out because their reports contradict the others'.
    pub left_out: u32,
}

/// Pose of a drone, fused from the sightings of this drone and its peers.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/SwarmPose")]
#[repr(C)]
pub struct SwarmPose {
    /// Pose of the drone in this drone's frame.
    pub own_from_drone: Pose,
    /// Its covariance, 6x6 row-major: position (m), then rotation vector (rad), both in this
    /// drone's frame.
    pub covariance: [f64; 36],
    /// Time of the newest exposure among its sightings, CLOCK_MONOTONIC, nanoseconds.
    pub seen_ns: i64,
    /// Name of the drone.
    pub name: Text<32>,
    /// Name of the drone before it on the chain with the smallest covariance, where it is
    /// `chained`; else empty.
    pub through: Text<32>,
    /// A [`SwarmWay`].
    pub way: u32,
    /// Number of pairs of drones whose sightings it is computed from.
    pub pairs: u32,
}

#[expect(clippy::derivable_impls, reason = "arrays of 36 elements have no default")]
impl Default for PeerSighting {
    fn default() -> Self {
        Self {
            observer_from_target: Pose::default(),
            target_from_observer: Pose::default(),
            ..Self::zeroed()
        }
    }
}

#[expect(clippy::derivable_impls, reason = "arrays of 36 elements have no default")]
impl Default for SwarmPose {
    fn default() -> Self {
        Self { own_from_drone: Pose::default(), ..Self::zeroed() }
    }
}

impl PeerSighting {
    /// Refuses unknown codes and invalid poses.
    pub fn check(&self) -> Result<(), ContractError> {
        TrackState::try_from(self.state)?;
        MeasuredBy::try_from(self.measured_by)?;
        self.observer_from_target.check()?;
        self.target_from_observer.check()?;
        check_finite("covariance", &self.covariance)?;
        check_finite("inverse covariance", &self.inverse_covariance)?;
        check_finite("velocity", &self.linear_velocity)?;
        check_finite("velocity", &self.angular_velocity)
    }
}

impl SwarmPose {
    /// Refuses unknown codes and invalid poses.
    pub fn check(&self) -> Result<(), ContractError> {
        SwarmWay::try_from(self.way)?;
        self.own_from_drone.check()?;
        check_finite("covariance", &self.covariance)
    }
}
