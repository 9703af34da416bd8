//! Views cut from frames by a back end, and places searched in them.

use flockeye_contract::FrameHeader;
use flockeye_convert::projection_of;
use flockeye_geometry::camera::Camera;
use flockeye_imaging::proposals::{Proposal, Proposer};
use flockeye_imaging::sphere::{Cut, SphereImage};

use crate::core::CutOrder;
use crate::proposals::ProposalSearch;
use crate::rectifier::{FrameKey, Rectifier as _};
use crate::standby::Standby;

/// Cuts views of one camera's frames.
pub struct Cutter {
    rectifier: Standby,
    proposer: Proposer,
    camera: Camera,
}

impl Cutter {
    /// Cuts with `rectifier`.
    pub fn new(rectifier: Standby, camera: Camera) -> Self {
        Self { rectifier, proposer: Proposer::default(), camera }
    }

    /// Lets a frame that waits be uploaded while another is being cut.
    ///
    /// # Errors
    /// A frame that is not the configured camera's, or that the back end has no room for.
    pub fn prepare(&mut self, header: &FrameHeader, pixels: &[u8]) -> anyhow::Result<()> {
        let sphere = self.sphere_of(header, pixels)?;
        Ok(self.rectifier.prepare(key(header), &sphere)?)
    }

    /// Lets the back end make cuts of a frame ahead.
    ///
    /// # Errors
    /// As [`Cutter::prepare`], or a view that the back end has no room for.
    pub fn announce(
        &mut self,
        header: &FrameHeader,
        pixels: &[u8],
        cuts: &[Cut],
    ) -> anyhow::Result<()> {
        let sphere = self.sphere_of(header, pixels)?;
        Ok(self.rectifier.order(key(header), &sphere, cuts)?)
    }

    /// Searches a frame for places that look like a body.
    ///
    /// # Errors
    /// As [`Cutter::prepare`].
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
    ///
    /// # Errors
    /// As [`Cutter::announce`]; a view that shows nothing.
    pub fn cut(
        &mut self,
        header: &FrameHeader,
        pixels: &[u8],
        order: &CutOrder,
        out: &mut [u8],
    ) -> anyhow::Result<()> {
        let sphere = self.sphere_of(header, pixels)?;
        if !order.ahead.is_empty() {
            self.rectifier.order(key(header), &sphere, &order.ahead)?;
        }
        Ok(self.rectifier.cut(key(header), &sphere, &order.cut, out)?)
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

fn key(header: &FrameHeader) -> FrameKey {
    let (source_generation, epoch, sequence) = header.stamp.order();
    FrameKey { source_generation, epoch, sequence }
}
