//! An active frame of rectification.

use std::collections::BTreeSet;

use flockeye_contract::{FrameOrder, PlannedView, ViewHeader};
use flockeye_convert::xyzw;
use flockeye_geometry::camera::Camera;
use flockeye_geometry::view::View;
use flockeye_imaging::sphere::{Cut, Interpolation};
use nalgebra::Vector3;

use super::events::CutOrder;
use crate::job::FrameJob;

/// A frame whose views are being cut, or that waits for the answers to them.
#[derive(Debug)]
pub(crate) struct ActiveFrame<F> {
    /// Owner of the pixels.
    pub(crate) pixels: F,
    /// Views of the frame, and their state.
    pub(crate) job: FrameJob,
    /// Indices of the views announced to the back end.
    announced: BTreeSet<u32>,
}

impl<F> ActiveFrame<F> {
    /// A frame before its first cut.
    pub(crate) fn new(job: FrameJob, pixels: F) -> Self {
        Self { pixels, job, announced: BTreeSet::new() }
    }

    /// Key of the frame in the order of frames.
    pub(crate) fn order(&self) -> FrameOrder {
        self.job.frame.stamp.order()
    }

    /// Marks `views` as announced. Returns the cuts of the views that were not announced before.
    pub(crate) fn announce(
        &mut self,
        views: impl IntoIterator<Item = u32>,
        camera: &Camera,
    ) -> Vec<Cut> {
        let mut cuts = Vec::new();
        for index in views {
            if self.announced.insert(index)
                && let Some((view, planned)) = self.job.view(index)
            {
                cuts.push(cut_of(view, &planned, camera));
            }
        }
        cuts
    }

    /// The order to cut a view, without a worker. `None` for a view that is not in the plan.
    pub(crate) fn cut_order(&mut self, view_index: u32, camera: &Camera) -> Option<CutOrder> {
        let (view, planned) = self.job.view(view_index)?;
        let ahead = match self.announced.contains(&view_index) {
            true => Vec::new(),
            false => {
                let rest: Vec<u32> = self.job.from(view_index).collect();
                self.announce(rest, camera)
            }
        };
        let frame = &self.job.frame;
        let header = ViewHeader {
            stamp: frame.stamp,
            plan_id: self.job.plan_id,
            taken_ns: self.job.taken_ns,
            camera_from_view: xyzw(&view.camera_from_view),
            focal_px: view.focal_px,
            predicted_camera_from_markers: planned.predicted_camera_from_markers,
            readout_ns: frame.readout_ns,
            view_index,
            size_px: view.size_px,
            stride: view.size_px,
            kind: planned.kind,
            tile: planned.tile,
            target: planned.target,
            has_prediction: planned.has_prediction,
            transfer: frame.transfer,
            gamma: frame.gamma,
            range: frame.range,
            search: planned.search,
            ..ViewHeader::default()
        };
        Some(CutOrder { header, cut: cut_of(view, &planned, camera), ahead })
    }
}

/// The cut of a planned view: exact at its neighbour's predicted distance, or at the camera's
/// assumed distance. Its interpolation depends on the magnification.
fn cut_of(view: View, planned: &PlannedView, camera: &Camera) -> Cut {
    let distance_m = match planned.has_prediction {
        0 => camera.distance_m(),
        _ => Vector3::from(planned.predicted_camera_from_markers.position).norm(),
    };
    Cut { view, distance_m, interpolation: Interpolation::suited_to(&view, camera) }
}
