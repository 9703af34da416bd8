//! Proposals of neighbours: places of the whole sphere that look like a body with markers.
//!
//! It is a fast search of the whole picture. Proposals are cut and read like any other view. Tiles
//! find the bodies that it misses. `docs/FUSION.md` has the sources of its constants.
//!
//! 1. The picture is reduced to the resolution of the search ([`Detail`]), in bands of latitude
//!    (`bands`).
//! 2. Runs of pixels that are darker than their surroundings ([`dark`]) are joined to regions
//!    ([`regions`]).
//! 3. Regions as large as a marker, with a brighter surround on each side, are squares
//!    ([`squares`]).
//! 4. Squares at distances like those of a body make a proposal ([`clusters`]).

mod bands;
mod clusters;
mod dark;
mod proposal;
mod regions;
mod squares;
#[cfg(test)]
mod tests;

use flockeye_geometry::camera::CameraModel;

use crate::image::LumaImage;
use crate::sphere::SphereImage;
use bands::bands;
use dark::DarkRuns;
pub use proposal::{MarkerSizes, Proposal};
use regions::Regions;
use squares::{DarkSquare, square};

/// Least difference of a marker's pixels from the mean of their surroundings, code values.
const DARKER_BY: u8 = 5;

/// Resolution of the search.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Detail {
    /// About 1920 columns: a marker of 12 px at 3840 columns has 6 px.
    #[default]
    Quick,
    /// 3840 columns: markers of 7 px are found too. It takes four times as long.
    Thorough,
}

impl Detail {
    fn columns(self) -> usize {
        match self {
            Self::Quick => 1920,
            Self::Thorough => 3840,
        }
    }
}

/// Finds places that look like bodies; reuses its memory for the next picture.
#[derive(Debug, Default)]
pub struct Proposer {
    rows: [Vec<u8>; 2],
    /// Pixels of one band.
    grey: Vec<u8>,
    dark: DarkRuns,
    regions: Regions,
    squares: Vec<DarkSquare>,
}

impl Proposer {
    /// Places of `image` that look like bodies with markers of these sizes: the best first, at most
    /// `most`. None in a picture that is not equirectangular.
    pub fn propose(
        &mut self,
        image: &SphereImage<'_>,
        sizes: &MarkerSizes,
        detail: Detail,
        most: usize,
    ) -> Vec<Proposal> {
        if !matches!(image.camera().model(), CameraModel::Equirectangular { .. }) {
            return Vec::new();
        }
        self.find(image, sizes, detail);
        clusters::cluster(&mut self.squares, sizes, most)
    }

    fn find(&mut self, image: &SphereImage<'_>, sizes: &MarkerSizes, detail: Detail) {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            // SAFETY: the line above has checked that the processor has AVX2.
            unsafe { self.find_avx2(image, sizes, detail) };
            return;
        }
        self.find_squares(image, sizes, detail);
    }

    /// The portable code, compiled for registers of twice as many pixels.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn find_avx2(&mut self, image: &SphereImage<'_>, sizes: &MarkerSizes, detail: Detail) {
        self.find_squares(image, sizes, detail);
    }

    #[inline(always)]
    fn find_squares(&mut self, image: &SphereImage<'_>, sizes: &MarkerSizes, detail: Detail) {
        self.squares.clear();
        let camera = image.camera();
        let (width, height) = (camera.width() as usize, camera.height() as usize);
        for band in bands(width, height, detail.columns()) {
            let width = band.reduce(image, &mut self.rows, &mut self.grey);
            let height = self.grey.len() / width;
            // Bands have pixels, and rows without gaps, so nothing is refused here.
            let Ok(grey) = LumaImage::new(&self.grey, width, height, width) else { continue };
            self.regions.clear();
            self.dark.runs(&grey, DARKER_BY, |row, runs| self.regions.add(row, runs));
            self.squares.extend(
                self.regions.iter().filter_map(|region| square(region, image, &band, &grey, sizes)),
            );
        }
    }
}
