//! Views cut from frames by a back end, as messages.

use flockeye_contract::{FrameHeader, FrameStamp, PlannedView, ViewHeader};
use flockeye_convert::{projection_of, xyzw};
use flockeye_geometry::camera::Camera;
use flockeye_geometry::view::View;
use flockeye_imaging::sphere::{Cut, Interpolation, SphereImage};
use nalgebra::Vector3;

use crate::core::{CutOrder, Held};
use crate::job::Job;
use crate::proposing::Proposing;
use crate::rectifier::{FrameKey, Rectifier as _};
use crate::standby::Standby;

/// Cuts views of one camera's frames.
pub struct Cutter {
    rectifier: Standby,
    camera: Camera,
}

impl Cutter {
    /// Cuts with `rectifier`.
    pub fn new(rectifier: Standby, camera: Camera) -> Self {
        Self { rectifier, camera }
    }

    /// Lets a frame that waits be uploaded while another is being cut.
    ///
    /// # Errors
    /// A frame that is not the configured camera's, or that the back end cannot hold.
    pub fn prepare(&mut self, header: &FrameHeader, pixels: &[u8]) -> anyhow::Result<()> {
        let sphere = self.sphere_of(header, pixels)?;
        Ok(self.rectifier.prepare(key(&header.stamp), &sphere)?)
    }

    /// Finds places for the proposals that a frame's plan asks for.
    ///
    /// # Errors
    /// As [`Cutter::prepare`].
    pub fn propose<F>(
        &self,
        held: &mut Held<F>,
        pixels: impl Fn(&F) -> &[u8],
        proposing: &mut Proposing,
    ) -> anyhow::Result<()> {
        let views = held.job.proposal_indices().len();
        if views > 0 {
            let sphere = self.sphere_of(&held.job.frame, pixels(&held.pixels))?;
            held.job.place_proposals(proposing.views(&sphere, views));
        }
        Ok(())
    }

    /// Tells the back end of views of a frame that will be cut.
    ///
    /// # Errors
    /// As [`Cutter::prepare`], or a view that the back end cannot hold.
    pub fn order<F>(
        &mut self,
        held: &mut Held<F>,
        pixels: impl Fn(&F) -> &[u8],
        views: &[u32],
    ) -> anyhow::Result<()> {
        let Held { pixels: hold, job, ordered, .. } = held;
        let sphere = self.sphere_of(&job.frame, pixels(hold))?;
        let cuts: Vec<Cut> = views
            .iter()
            .filter(|index| !ordered.contains(index))
            .filter_map(|&index| job.view(index))
            .map(|(view, planned)| cut_of(view, &planned, &self.camera))
            .collect();
        self.rectifier.order(key(&job.frame.stamp), &sphere, &cuts)?;
        ordered.extend(views);
        Ok(())
    }

    /// Cuts a view into `out`, rows of `size_px` bytes without gaps.
    ///
    /// # Errors
    /// As [`Cutter::order`]; a view that shows nothing.
    pub fn cut<F>(
        &mut self,
        held: &mut Held<F>,
        pixels: impl Fn(&F) -> &[u8],
        order: CutOrder,
        out: &mut [u8],
    ) -> anyhow::Result<()> {
        let index = order.view_index;
        if !held.ordered.contains(&index) {
            let rest: Vec<u32> = held.job.from(index).collect();
            self.order(held, &pixels, &rest)?;
        }
        let job = &held.job;
        let Some((view, planned)) = job.view(index) else {
            anyhow::bail!("view {index} is not in the plan");
        };
        let sphere = self.sphere_of(&job.frame, pixels(&held.pixels))?;
        let cut = cut_of(view, &planned, &self.camera);
        Ok(self.rectifier.cut(key(&job.frame.stamp), &sphere, &cut, out)?)
    }

    /// The frame's pixels as the configured camera sees them.
    fn sphere_of<'m>(
        &self,
        header: &FrameHeader,
        pixels: &'m [u8],
    ) -> anyhow::Result<SphereImage<'m>> {
        let (width, height) = (self.camera.width(), self.camera.height());
        let (sent, expected) = (header.projection, projection_of(&self.camera).code());
        anyhow::ensure!(
            sent == expected,
            "its projection has code {sent}, the configured one {expected}. Cure: set \
             camera.projection to what the source sends"
        );
        anyhow::ensure!(
            (header.width, header.height) == (width, height),
            "it has {}x{} pixels, the configuration says {width}x{height}. Cure: set camera.width \
             and camera.height to what the source sends",
            header.width,
            header.height
        );
        Ok(SphereImage::new(pixels, header.stride as usize, self.camera)?)
    }
}

/// The header of a view that was cut, published at `issued_ns` by generation `generation` of this stage.
/// `None` for a view that is not in the plan.
pub fn view_header(
    job: &Job,
    order: CutOrder,
    generation: u32,
    issued_ns: i64,
) -> Option<ViewHeader> {
    let (view, planned) = job.view(order.view_index)?;
    let frame = &job.frame;
    Some(ViewHeader {
        stamp: frame.stamp,
        plan_id: job.plan_id,
        taken_ns: job.taken_ns,
        issued_ns,
        camera_from_view: xyzw(&view.camera_from_view),
        focal_px: view.focal_px,
        predicted_camera_from_markers: planned.predicted_camera_from_markers,
        readout_ns: frame.readout_ns,
        generation,
        view_index: order.view_index,
        attempt: order.attempt,
        worker: order.worker as u32,
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
    })
}

fn key(stamp: &FrameStamp) -> FrameKey {
    let (source_generation, epoch, sequence) = stamp.order();
    FrameKey { source_generation, epoch, sequence }
}

/// How a planned view is cut: right for the distance at which its neighbour is expected (without one, the
/// camera's assumed distance), and interpolated as its magnification asks for.
fn cut_of(view: View, planned: &PlannedView, camera: &Camera) -> Cut {
    let distance_m = match planned.has_prediction {
        0 => camera.distance_m(),
        _ => Vector3::from(planned.predicted_camera_from_markers.position).norm(),
    };
    Cut { view, distance_m, interpolation: Interpolation::suited_to(&view, camera) }
}
