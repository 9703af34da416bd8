//! `plan`: views that fusion requests from rectification.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::error::{check_count, check_unit};
use crate::frame::{MAX_SIDE_PX, check_curve};
use crate::{
    ContractError, FrameStamp, NONE, Pose, Range, Search, SearchMode, StopRule, Transfer, ViewKind,
};

/// Header of a plan. Payload: its [`PlannedView`]s, in the order of cutting.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/PlanHeader")]
#[repr(C)]
pub struct PlanHeader {
    /// The frame after which this plan was made. In a lossless run the plan is the source's
    /// credit for the frame after it. All zero in the first plan of a fusion process.
    pub after: FrameStamp,
    /// Rises with each plan of one fusion process, from 1.
    pub plan_id: u64,
    /// Time of planning, CLOCK_MONOTONIC, nanoseconds. A latency field.
    pub made_ns: i64,
    /// 1 in a plan made after a frame, 0 in the first one, which only opens the flow.
    pub has_after: u32,
    /// Rises each time fusion's process is replaced.
    pub generation: u32,
    /// A [`StopRule`].
    pub stop_rule: u32,
    /// A [`SearchMode`].
    pub mode: u32,
    /// Number of views to cut in a lossless run with the rule `deadline`.
    pub view_budget: u32,
    /// Exponent of the camera's response, where fusion has learned that the frames' own one is wrong:
    /// the views then have transfer `gamma` with it. Otherwise 0.
    pub gamma: f32,
}

/// One view that a plan requests.
///
/// A region of interest follows its neighbour. Rectification turns it by `rate_in_camera` from
/// `reference_ns` to the frame's exposure.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/PlannedView")]
#[repr(C)]
pub struct PlannedView {
    /// Rotation from the view's frame (x right, y down, z forward) to the camera's, x y z w.
    pub camera_from_view: [f64; 4],
    /// Rate of that rotation: rotation vector per second, in the camera frame, radians/s.
    pub rate_in_camera: [f64; 3],
    /// Exposure time at which `camera_from_view` holds, on the clock of the stamp.
    pub reference_ns: i64,
    /// Focal length, pixels.
    pub focal_px: f64,
    /// Predicted pose of the body's markers in the camera frame at `reference_ns`, where
    /// `has_prediction` is 1.
    pub predicted_camera_from_markers: Pose,
    /// Pixels along a side: views are square.
    pub size_px: u32,
    /// A [`ViewKind`].
    pub kind: u32,
    /// Index of the tile, counted from 0 in its own kind; [`NONE`] in a region of interest.
    pub tile: u32,
    /// Index of the target's body in the configuration, or [`NONE`].
    pub target: u32,
    /// 1 if `predicted_camera_from_markers` holds.
    pub has_prediction: u32,
    /// A [`Search`], copied into the view.
    pub search: u32,
}

/// Maximum number of views in a plan; larger plans are refused.
pub const MAX_PLANNED_VIEWS: usize = 256;

/// Maximum side of a view, pixels; larger views are refused.
pub const MAX_VIEW_PX: u32 = 4_096;

impl PlanHeader {
    /// Refuses unknown codes and views that cannot be cut.
    pub fn check(&self, views: &[PlannedView]) -> Result<(), ContractError> {
        StopRule::try_from(self.stop_rule)?;
        SearchMode::try_from(self.mode)?;
        if self.gamma != 0.0 {
            check_curve(Transfer::Gamma.code(), self.gamma, Range::Full.code())?;
        }
        check_count("views in a plan", views.len(), MAX_PLANNED_VIEWS)?;
        views.iter().try_for_each(PlannedView::check)
    }
}

impl PlannedView {
    /// Whether the view is a proposal, whose direction rectification finds.
    pub fn is_proposal(&self) -> bool {
        self.kind == ViewKind::Proposal.code()
    }

    /// Whether the view is a tile of the sphere at either resolution, and not a small view.
    pub fn is_tile(&self) -> bool {
        [ViewKind::Partition.code(), ViewKind::HighResolution.code()].contains(&self.kind)
    }

    fn check(&self) -> Result<(), ContractError> {
        let kind = ViewKind::try_from(self.kind)?;
        Search::try_from(self.search)?;
        check_view_geometry(&self.camera_from_view, self.focal_px, self.size_px)?;
        if !self.rate_in_camera.iter().all(|rate| rate.is_finite() && rate.abs() < 1e3) {
            return Err(ContractError::NotFinite { what: "view rate" });
        }
        if kind == ViewKind::Roi && self.target == NONE {
            return Err(ContractError::Missing { what: "target of a region of interest" });
        }
        if self.has_prediction != 0 {
            self.predicted_camera_from_markers.check()?;
        }
        Ok(())
    }
}

/// Refuses invalid rotations, sizes and focal lengths.
pub(crate) fn check_view_geometry(
    camera_from_view: &[f64; 4],
    focal_px: f64,
    size_px: u32,
) -> Result<(), ContractError> {
    check_unit(camera_from_view)?;
    if size_px == 0 || size_px > MAX_VIEW_PX {
        return Err(ContractError::Size { width: size_px, height: size_px, max: MAX_VIEW_PX });
    }
    if !(focal_px.is_finite() && focal_px >= 1.0 && focal_px <= f64::from(MAX_SIDE_PX) * 16.0) {
        return Err(ContractError::Focal { focal_px });
    }
    Ok(())
}
