//! `view`: one square pinhole image cut from the sphere.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::error::check_count;
use crate::frame::{check_curve, check_image};
use crate::plan::{MAX_PLANNED_VIEWS, check_view_geometry};
use crate::{ContractError, FrameStamp, Pose, Search, ViewKind};

/// Header of a view. Payload: `stride * size_px` bytes of luma.
///
/// The view's frame is a pinhole camera's: x right, y down, z forward; its principal point is the
/// image's centre, ((size_px - 1)/2, (size_px - 1)/2).
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/ViewHeader")]
#[repr(C)]
pub struct ViewHeader {
    /// The frame it was cut from.
    pub stamp: FrameStamp,
    /// The plan that requested it; 0 where rectification swept on its own.
    pub plan_id: u64,
    /// Start of rectification's work on the frame, CLOCK_MONOTONIC, nanoseconds. A latency field.
    pub taken_ns: i64,
    /// Publication time of the view, CLOCK_MONOTONIC, nanoseconds. A latency field.
    pub issued_ns: i64,
    /// Rotation from the view's frame to the camera's at the frame's exposure, x y z w.
    pub camera_from_view: [f64; 4],
    /// Focal length, pixels.
    pub focal_px: f64,
    /// Predicted pose of the target's markers in the camera frame, where `has_prediction` is 1.
    pub predicted_camera_from_markers: Pose,
    /// Time between the first and the last row of the *frame*, nanoseconds; 0: global shutter.
    pub readout_ns: u64,
    /// Rises each time rectification's process is replaced.
    pub generation: u32,
    /// Index of this view in the plan, from 0; the detection record repeats it.
    pub view_index: u32,
    /// Rises each time the same view is cut again for another worker.
    pub attempt: u32,
    /// Number of the detection worker that must search it.
    pub worker: u32,
    /// Pixels along a side.
    pub size_px: u32,
    /// Bytes from one row to the next.
    pub stride: u32,
    /// A [`ViewKind`].
    pub kind: u32,
    /// Index of the tile, counted from 0 in its own kind; [`crate::NONE`] in a region of interest.
    pub tile: u32,
    /// Index of the target's body in the configuration, or [`crate::NONE`].
    pub target: u32,
    /// 1 if `predicted_camera_from_markers` holds.
    pub has_prediction: u32,
    /// A [`crate::Transfer`].
    pub transfer: u32,
    /// The exponent of [`crate::Transfer::Gamma`]; 0 otherwise.
    pub gamma: f32,
    /// A [`crate::Range`].
    pub range: u32,
    /// A [`Search`]: how it is searched for markers.
    pub search: u32,
}

impl ViewHeader {
    /// Refuses a header that does not describe `payload_bytes` bytes of pixels.
    pub fn check(&self, payload_bytes: usize) -> Result<(), ContractError> {
        check_image(self.size_px, self.size_px, self.stride)?;
        check_view_geometry(&self.camera_from_view, self.focal_px, self.size_px)?;
        check_curve(self.transfer, self.gamma, self.range)?;
        ViewKind::try_from(self.kind)?;
        Search::try_from(self.search)?;
        check_count("views in a frame", self.view_index as usize + 1, MAX_PLANNED_VIEWS)?;
        if self.has_prediction != 0 {
            self.predicted_camera_from_markers.check()?;
        }
        let needed = self.stride as usize * self.size_px as usize;
        if needed > payload_bytes {
            return Err(ContractError::PayloadTooShort { needed, found: payload_bytes });
        }
        Ok(())
    }
}
