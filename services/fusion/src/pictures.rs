//! Held views as pictures that alignment can read.

use flockeye_contract::ViewHeader;
use flockeye_convert::{RadianceCache, image_of, purpose_of, view_of};
use flockeye_geometry::search::Purpose;
use flockeye_imaging::align::Picture;

use crate::aligner::BestView;
use crate::frame::views::HeldViews;
use crate::measure::BestViews;
use crate::parallax::Parallax;
use crate::tracker::CameraState;

/// Converts code values to radiance, and corrects rays.
#[derive(Debug)]
pub(crate) struct PictureReader {
    lights: RadianceCache,
    pixels_per_radian: f64,
    parallax: Option<Parallax>,
}

impl PictureReader {
    /// Creates the converter for a sphere image of this resolution; `parallax` for a camera whose
    /// lenses lie off its centre.
    pub(crate) fn new(
        lights: RadianceCache,
        pixels_per_radian: f64,
        parallax: Option<Parallax>,
    ) -> Self {
        Self { lights, pixels_per_radian, parallax }
    }

    /// The best views of a frame's targets.
    pub(crate) fn best_views<'c, P: AsRef<[u8]>>(
        &'c mut self,
        held: &'c HeldViews<P>,
        camera: &CameraState,
    ) -> BestViews<'c> {
        let views = held
            .best
            .iter()
            .map(|(target, (_, header, pixels))| (*target, header, (**pixels).as_ref()));
        self.read_all(views, camera).into_iter().collect()
    }

    /// Pictures of places.
    pub(crate) fn places<'c>(
        &'c mut self,
        views: impl Iterator<Item = (&'c ViewHeader, &'c Vec<u8>)>,
        camera: &CameraState,
    ) -> Vec<BestView<'c>> {
        let views = views.map(|(header, pixels)| ((), header, &pixels[..]));
        self.read_all(views, camera).into_iter().map(|((), view)| view).collect()
    }

    /// Pictures of a frame's unanswered regions of interest, with their targets' numbers.
    pub(crate) fn regions<'c, P: AsRef<[u8]>>(
        &'c mut self,
        held: &'c HeldViews<P>,
        views: &[u32],
        camera: &CameraState,
    ) -> Vec<(usize, BestView<'c>)> {
        let views = views.iter().filter_map(|index| {
            let (header, pixels) = held.unanswered.get(index)?;
            let Some(Purpose::Roi(target)) = purpose_of(header) else { return None };
            Some((target, header, (**pixels).as_ref()))
        });
        self.read_all(views, camera)
    }

    /// Reads views with their pixels. A view that cannot be read is left out; detection reports the
    /// reason.
    fn read_all<'c, K>(
        &'c mut self,
        views: impl Iterator<Item = (K, &'c ViewHeader, &'c [u8])>,
        camera: &CameraState,
    ) -> Vec<(K, BestView<'c>)> {
        let views: Vec<_> = views.collect();
        for (_, header, _) in &views {
            // A transfer curve that is refused here is refused again when the view is read.
            let _ = self.lights.of(header);
        }
        let (reader, views) = (&*self, views.into_iter());
        views
            .filter_map(|(key, header, pixels)| Some((key, reader.read(header, pixels, camera)?)))
            .collect()
    }

    fn read<'c>(
        &'c self,
        header: &ViewHeader,
        pixels: &'c [u8],
        camera: &CameraState,
    ) -> Option<BestView<'c>> {
        let picture = Picture {
            response_sigma: camera.response.sigma(header.transfer, header.gamma),
            stitch: camera.stitching.as_ref().map(|stitching| stitching.of_view(Some(header))),
            ..Picture::still(
                image_of(header, pixels).ok()?,
                view_of(header),
                self.lights.known(header)?,
                self.pixels_per_radian,
            )
        };
        let parallax = self.parallax.as_ref();
        let rays_m = parallax.map_or(f64::INFINITY, |parallax| parallax.distance_m(Some(header)));
        Some(BestView { picture, view_index: header.view_index, rays_m })
    }
}
