//! Held views as pictures that alignment can read.

use flockeye_contract::ViewHeader;
use flockeye_convert::{RadianceCache, image_of, purpose_of, view_of};
use flockeye_geometry::search::Purpose;
use flockeye_imaging::align::Picture;

use crate::aligner::BestView;
use crate::frame::views::HeldViews;
use crate::measure::{BestViews, Region};
use crate::parallax::Parallax;

/// A hold on the pixels of a view.
pub trait Pixels {
    /// The pixels, row by row.
    fn pixels(&self) -> &[u8];
}

impl Pixels for Vec<u8> {
    fn pixels(&self) -> &[u8] {
        self
    }
}

/// What turns code values into radiance and rays into the right ones.
#[derive(Debug)]
pub struct PictureReader {
    lights: RadianceCache,
    pixels_per_radian: f64,
    parallax: Option<Parallax>,
}

impl PictureReader {
    /// For a sphere image of this resolution; `parallax` for a camera whose lenses lie off its
    /// centre.
    pub fn new(lights: RadianceCache, pixels_per_radian: f64, parallax: Option<Parallax>) -> Self {
        Self { lights, pixels_per_radian, parallax }
    }

    /// The best views of a frame's targets. A view that cannot be read is left out; detection
    /// reports why.
    pub fn best_views<'c, P: Pixels>(&'c mut self, held: &'c HeldViews<P>) -> BestViews<'c> {
        self.learn_curves(held.best().map(|(_, _, header, _)| header));
        let reader = &*self;
        held.best()
            .filter_map(|(target, quality, header, pixels)| {
                let agreeing = quality.agreeing;
                Some((target, BestView { agreeing, ..reader.read(header, pixels)? }))
            })
            .collect()
    }

    /// What views of places show. A view that cannot be read is left out; detection reports why.
    pub fn places<'c, P: Pixels>(
        &'c mut self,
        views: &[(&ViewHeader, &'c P)],
    ) -> Vec<BestView<'c>> {
        self.learn_curves(views.iter().map(|(header, _)| *header));
        let reader = &*self;
        views.iter().filter_map(|(header, pixels)| reader.read(header, *pixels)).collect()
    }

    /// Pictures of a frame's unanswered regions of interest. A view that cannot be read is left
    /// out; detection reports why.
    pub fn regions<'c, P: Pixels>(
        &'c mut self,
        held: &'c HeldViews<P>,
        views: &[u32],
    ) -> Vec<Region<'c>> {
        let unanswered = || views.iter().filter_map(|&index| held.unanswered(index));
        self.learn_curves(unanswered().map(|(header, _)| header));
        let reader = &*self;
        unanswered()
            .filter_map(|(header, pixels)| {
                let Some(Purpose::Roi(target)) = purpose_of(header) else { return None };
                Some(Region { target, view: reader.read(header, pixels)? })
            })
            .collect()
    }

    /// Makes the transfer curves known that headers state. A curve that is refused here is refused
    /// again in [`Self::read`].
    fn learn_curves<'h>(&mut self, headers: impl Iterator<Item = &'h ViewHeader>) {
        for header in headers {
            let _ = self.lights.of(header);
        }
    }

    fn read<'c, P: Pixels>(&'c self, header: &ViewHeader, pixels: &'c P) -> Option<BestView<'c>> {
        let picture = Picture::still(
            image_of(header, pixels.pixels()).ok()?,
            view_of(header),
            self.lights.known(header)?,
            self.pixels_per_radian,
        );
        let parallax = self.parallax.as_ref();
        let rays_m = parallax.map_or(f64::INFINITY, |parallax| parallax.distance_m(Some(header)));
        Some(BestView { picture, view_index: header.view_index, agreeing: 0, rays_m })
    }
}
