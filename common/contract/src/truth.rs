//! `truth`: ground truth of a simulated source.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::{ContractError, FrameStamp, Pose, Text};

/// Header of `truth`. Payload: a [`BodyTruth`] for each body, seen or not.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/TruthHeader")]
#[repr(C)]
pub struct TruthHeader {
    /// The frame.
    pub stamp: FrameStamp,
    /// Orientation of the camera in the world, unit quaternion x y z w; all zero where it is not
    /// known.
    pub world_from_camera: [f64; 4],
    /// The observer's own yaw in the world, radians.
    pub observer_yaw: f64,
    /// Length of the exposure, seconds.
    pub exposure_s: f64,
}

/// True pose of a body, and its visibility in the frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/BodyTruth")]
#[repr(C)]
pub struct BodyTruth {
    /// Pose of the body's markers in the camera frame.
    pub camera_from_markers: Pose,
    /// Pose of the target drone in the observer drone's frame, mounts applied.
    pub observer_from_target: Pose,
    /// Side of its best visible marker on the sphere image, pixels.
    pub best_side_px: f64,
    /// Length of its motion blur on the sphere image, pixels.
    pub blur_px: f64,
    /// The body's name.
    pub name: Text<32>,
    /// Index of the body in the configuration.
    pub target: u32,
    /// Markers of which at least half is visible.
    pub markers_visible_50: u32,
    /// Markers of which at least 90 % is visible.
    pub markers_visible_90: u32,
    /// 1 if a whole marker is visible at less than 65 degrees of incidence.
    pub localisable: u32,
}

impl TruthHeader {
    /// Refuses invalid truth.
    pub fn check(&self, bodies: &[BodyTruth]) -> Result<(), ContractError> {
        bodies.iter().try_for_each(|body| {
            body.camera_from_markers.check()?;
            body.observer_from_target.check()
        })
    }
}
