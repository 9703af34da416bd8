//! Cuts of views by a back end, with the CPU as fallback, and proposal searches.

use flockeye_contract::FrameHeader;
use flockeye_convert::projection_of;
use flockeye_geometry::camera::Camera;
use flockeye_imaging::proposals::{Proposal, Proposer};
use flockeye_imaging::sphere::{Cut, SphereImage};
use flockeye_runtime::health::SharedCounters;

use crate::core::CutOrder;
use crate::cpu::CpuRectifier;
use crate::proposals::ProposalSearch;
use crate::rectifier::{Rectifier, RectifyError};

/// Cuts views of one camera's frames.
///
/// When the back end is lost, also within a frame, the CPU takes over the failed and all later
/// work. One warning reports this.
pub struct Cutter {
    pub(crate) active: Box<dyn Rectifier>,
    threads: usize,
    counters: SharedCounters,
    proposer: Proposer,
    camera: Camera,
}

impl Cutter {
    /// Cuts with `active`, and after its loss with up to `threads` CPU threads. The health detail
    /// in `counters` names the back end in use.
    pub fn new(
        active: Box<dyn Rectifier>,
        threads: usize,
        counters: SharedCounters,
        camera: Camera,
    ) -> Self {
        counters.set_detail(active.name());
        Self { active, threads, counters, proposer: Proposer::default(), camera }
    }

    /// Runs work on the back end, and again on the CPU if the back end is lost.
    pub(crate) fn attempt(
        &mut self,
        mut work: impl FnMut(&mut dyn Rectifier) -> Result<(), RectifyError>,
    ) -> Result<(), RectifyError> {
        match work(self.active.as_mut()) {
            Err(error) if error.is_lost() => {
                tracing::warn!(
                    "{error}; the processor takes over. Cure: look into the kernel's log for what the \
                     driver says; the device is tried again when this stage is started again"
                );
                self.active = Box::new(CpuRectifier::new(self.threads));
                self.counters.set_detail(self.active.name());
                work(self.active.as_mut())
            }
            other => other,
        }
    }

    /// Starts the upload of the waiting frame while another is being cut.
    ///
    /// # Errors
    /// A frame of another format than configured, or too large for the back end.
    pub fn prepare(&mut self, header: &FrameHeader, pixels: &[u8]) -> anyhow::Result<()> {
        let sphere = self.sphere_of(header, pixels)?;
        Ok(self.attempt(|active| active.prepare(header.stamp.order(), &sphere))?)
    }

    /// Announces cuts of a frame, so that the back end can make them ahead.
    pub fn announce(
        &mut self,
        header: &FrameHeader,
        pixels: &[u8],
        cuts: &[Cut],
    ) -> anyhow::Result<()> {
        let sphere = self.sphere_of(header, pixels)?;
        Ok(self.attempt(|active| active.order(header.stamp.order(), &sphere, cuts))?)
    }

    /// Searches a frame for places that resemble a body (proposals).
    pub fn look(
        &mut self,
        header: &FrameHeader,
        pixels: &[u8],
        search: &ProposalSearch,
    ) -> anyhow::Result<Vec<Proposal>> {
        let sphere = self.sphere_of(header, pixels)?;
        Ok(self.proposer.propose(&sphere, &search.sizes, search.detail, search.most))
    }

    /// Cuts a view into `out`, rows of `size_px` bytes without gaps.
    pub fn cut(
        &mut self,
        header: &FrameHeader,
        pixels: &[u8],
        order: &CutOrder,
        out: &mut [u8],
    ) -> anyhow::Result<()> {
        let (frame, sphere) = (header.stamp.order(), self.sphere_of(header, pixels)?);
        if !order.ahead.is_empty() {
            self.attempt(|active| active.order(frame, &sphere, &order.ahead))?;
        }
        Ok(self.attempt(|active| active.cut(frame, &sphere, &order.cut, out))?)
    }

    /// The frame's pixels as an image of the configured camera.
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

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use flockeye_contract::FrameOrder;
    use flockeye_geometry::view::View;
    use nalgebra::Vector3;

    const CAMERA: Camera = Camera::equirectangular(64, 32);

    fn cutter(active: Box<dyn Rectifier>) -> Cutter {
        Cutter::new(active, 1, SharedCounters::default(), CAMERA)
    }

    /// A device that is lost after it has cut so many views.
    struct Mortal(usize);

    impl Rectifier for Mortal {
        fn name(&self) -> String {
            "mortal".into()
        }

        fn cut(
            &mut self,
            _: FrameOrder,
            _: &SphereImage<'_>,
            _: &Cut,
            out: &mut [u8],
        ) -> Result<(), RectifyError> {
            let lost =
                || RectifyError::Lost { adapter: "mortal".into(), reason: "it is gone".into() };
            self.0 = self.0.checked_sub(1).ok_or_else(lost)?;
            out.fill(1);
            Ok(())
        }
    }

    #[test]
    fn the_processor_goes_on_in_the_middle_of_a_frame() {
        let mut cutter = cutter(Box::new(Mortal(2)));
        let pixels = [70; 64 * 32];
        let sphere = SphereImage::new(&pixels, 64, CAMERA).unwrap();
        let cut = Cut::bilinear(View::looking_at(&Vector3::x_axis(), 1.0, 4));
        let mut greys = Vec::new();
        for _ in 0..4 {
            let mut out = [0; 16];
            cutter
                .attempt(|active| active.cut(FrameOrder::default(), &sphere, &cut, &mut out))
                .unwrap();
            greys.push(out[0]);
        }
        assert_eq!(greys, [1, 1, 70, 70]);
        assert!(cutter.active.name().starts_with("cpu: 1 thread"));
    }

    #[test]
    fn what_is_no_loss_is_passed_on() {
        let mut cutter = cutter(Box::new(CpuRectifier::new(1)));
        let pixels = [70; 64 * 32];
        let sphere = SphereImage::new(&pixels, 64, CAMERA).unwrap();
        let cut = Cut::bilinear(View::looking_at(&Vector3::x_axis(), 1.0, 4));
        let work = |active: &mut dyn Rectifier| {
            active.cut(FrameOrder::default(), &sphere, &cut, &mut [0; 3])
        };
        let error = cutter.attempt(work).unwrap_err();
        assert!(matches!(error, RectifyError::Sphere(_)), "{error}");
    }
}
