//! From a view to its markers.

use std::collections::HashSet;

use flockeye_dictionary::Dictionary;
use flockeye_geometry::Ray;
use flockeye_geometry::mask::Mask;
use flockeye_geometry::view::{View, ViewPixel};
use flockeye_imaging::edges::{
    Grain, Lighting, MarkerPrint, RefinedCorners, approach_corners, refine_corners,
};
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::LinearLight;
use flockeye_imaging::square::mean_side_px;

use crate::candidates::{Candidates, Finder};
use crate::drawn::SAMPLE_CELLS;
use crate::parameters::{DetectError, DetectorParameters, check_thresholds};
use crate::quad::{Quad, centre, rotated, with_parallelogram_corner};
use crate::reader::{Decoded, Explained, MarkerReader};
use crate::reading::Reading;
use crate::shape::is_square;
use crate::windows::Threshold;

/// Images with a shorter side are not searched, pixels: they hold no marker with its quiet zone.
const MIN_IMAGE_PX: usize = 16;

/// Standard deviation of a corner whose edges could not be fitted, pixels. Something covers them
/// then, and outlines are off by one to three pixels.
const UNREFINED_PX: f64 = 2.0;

// Limits of detection; docs/results/constants.md#limits-of-detection has the detections and false
// detections with other values.

/// Largest residual of the fitted print, as a share of its contrast. Print differs from its blurred
/// image by a few hundredths, texture by more.
const MAX_MISFIT: f64 = 0.15;

/// Largest blur of a marker, cells. Texture that reads as a marker is smooth; wider blurs must pass
/// [`BLURRED`].
const MAX_BLUR_CELLS: f64 = 0.75;

/// Largest blur of a marker that passes [`BLURRED`], cells. Small markers at long range are blurred
/// by 0.8 to 1. Without it a smooth patch of a real panorama reads as a marker.
const MAX_BLUR_CELLS_AT_RANGE: f64 = 1.1;

/// Limits for markers that are blurred by more than [`MAX_BLUR_CELLS`], or whose corners are
/// uncertain: least log-likelihood ratio, and largest residual. 7,100 squares that are blurred as
/// much and are no markers were read, of a hall, panoramas and a simulated world. None had a ratio
/// above 8 to the next marker. One of more views of the panoramas passes
/// (docs/results/constants.md#shape-of-squares).
const BLURRED: (f32, f64) = (12.0, 0.06);

/// Least log-likelihood ratio of the marker to the next likely one, and to a square without a
/// marker.
const MIN_LOG_LIKELIHOOD_RATIO: f32 = 10.0;

/// Least step from the border out to the quiet zone, on each side, as a share of that from black
/// print to white paper.
const MIN_QUIET_ZONE: f32 = 0.2;

/// Share of the least log-likelihood ratio from which a reading is worth a fit. Where corners are
/// only approximate, cells are sampled off their middles.
const WORTH_FITTING: f32 = 0.5;

/// Multiple of the least log-likelihood ratio from which a marker is accepted without fitted edges.
const UNREFINED_RATIO: f32 = 2.0;

/// Least contrast of a marker's cells, as a share of that between its quiet zone and its border.
/// The cells of empty squares that read as a marker by their noise had at most 0.13 on photographs,
/// those of 4,041 markers at least 0.59.
const MIN_CELL_CONTRAST: f32 = 0.28;

/// Largest distance between the corners of a refined marker and those of another outline of it:
/// pixels, and a share of the marker's side.
const SAME_CORNER: (f64, f64) = (2.0, 0.05);

/// Largest distance between the centres of a square and a marker already found, at which the square
/// is on the marker, as a share of the marker's side.
const SAME_PLACE_SHARE: f64 = 0.3;

/// Least size ratio between a marker and another one printed inside it: with its margin the inner
/// one must fit among the cells.
const NESTED_SIDE_RATIO: f64 = 2.5;

/// A marker in a view.
#[derive(Debug, Clone, PartialEq)]
pub struct MarkerInView {
    /// Its id in the dictionary.
    pub id: u32,
    /// Its corners in ArUco's order: clockwise from the printed top left.
    pub corners_in_view: [ViewPixel; 4],
    /// Rays to the corners, in the camera frame.
    pub rays_in_camera: [Ray; 4],
    /// Standard deviation of each ray across itself, radians.
    pub deviations_rad: [f64; 4],
    /// Whether the corners are those of the fitted print, rather than of the outline.
    pub is_refined: bool,
    /// Normalized correlation of its cells with those of the marker: 1 is perfect.
    pub correlation: f32,
}

/// Finds the markers of one dictionary.
pub struct Detector {
    dictionary: Dictionary,
    reader: MarkerReader,
    parameters: DetectorParameters,
    mask: Option<Mask>,
    grain: Grain,
    finder: Finder,
}

impl Detector {
    /// A detector for the dictionary of this name (one of [`flockeye_dictionary::PREDEFINED`], or a
    /// file's path).
    ///
    /// # Errors
    /// An unknown dictionary, a broken file, or a parameter outside its range.
    pub fn new(dictionary: &str, parameters: DetectorParameters) -> Result<Self, DetectError> {
        parameters.check()?;
        let dictionary = Dictionary::load(dictionary)?;
        let reader = MarkerReader::new(&dictionary);
        Ok(Self {
            dictionary,
            reader,
            parameters,
            mask: None,
            grain: Grain::Pixels,
            finder: Finder::default(),
        })
    }

    /// Leaves out squares on what `mask` hides.
    pub fn with_mask(self, mask: Mask) -> Self {
        Self { mask: Some(mask), ..self }
    }

    /// The dictionary.
    pub fn dictionary(&self) -> &Dictionary {
        &self.dictionary
    }

    /// Sets the thresholds for the next images.
    ///
    /// # Errors
    /// No thresholds, or one that is invalid for every image. The previous ones stay then.
    pub fn set_thresholds(
        &mut self,
        thresholds: impl Iterator<Item = Threshold> + Clone,
    ) -> Result<(), DetectError> {
        check_thresholds(thresholds.clone())?;
        self.parameters.thresholds.clear();
        self.parameters.thresholds.extend(thresholds);
        Ok(())
    }

    /// Sets how many pixels the next images have for each pixel of the sphere's image, along either
    /// axis.
    pub fn set_magnification(&mut self, magnification: f64) {
        self.grain = Grain::Resampled { magnification };
        self.parameters.corner_accuracy_px = 1.0 + magnification.max(1.0);
    }

    /// Finds every marker in `image`, the picture of `view`, by rising id. One id may be at several
    /// places.
    pub fn detect(
        &mut self,
        image: &LumaImage<'_>,
        view: &View,
        light: &LinearLight,
    ) -> Vec<MarkerInView> {
        if image.width().min(image.height()) < MIN_IMAGE_PX {
            return Vec::new();
        }
        let Candidates { whole, completed } = self.finder.find(image, &self.parameters);
        let mut found: Vec<MarkerInView> = Vec::new();
        // Several thresholds may give the same square; it would be read with the same result.
        let mut read = HashSet::new();
        for quad in whole.iter().chain(&completed) {
            if is_hidden(self.mask.as_ref(), view, quad)
                || found.iter().any(|marker| is_outline_of(marker, quad))
                || !read.insert(quad.map(|corner| [corner.0.x.to_bits(), corner.0.y.to_bits()]))
            {
                continue;
            }
            found.extend(self.read(image, view, light, quad));
        }
        let order = |a: &MarkerInView, b: &MarkerInView| {
            let likelier = b.correlation.total_cmp(&a.correlation);
            b.is_refined.cmp(&a.is_refined).then(likelier).then(a.id.cmp(&b.id))
        };
        found.sort_by(order);
        keep_best_of_each_place(&mut found);
        found.sort_by_key(|marker| marker.id);
        found
    }

    /// The marker in a quadrilateral, if one is accepted.
    fn read(
        &self,
        image: &LumaImage<'_>,
        view: &View,
        light: &LinearLight,
        quad: &Quad,
    ) -> Option<MarkerInView> {
        let near = approach_corners(image, light, quad, self.dictionary.bits() + 2)?;
        if mean_side_px(&near) < self.parameters.min_side_px {
            return None;
        }
        let decoded = self.reader.compare(&self.reading(image, light, &near)?)?.best()?;
        let is_worth_fitting =
            decoded.log_likelihood_ratio() >= WORTH_FITTING * MIN_LOG_LIKELIHOOD_RATIO;
        if !is_worth_fitting {
            return None;
        }
        let print = self.dictionary.print(decoded.id)?;
        let outline = rotated(&near, decoded.first_corner);
        let (corners, reading, explained) =
            self.with_hidden_corner(image, light, &outline, print)?;
        let (decoded, lighting) = (decoded.with(&explained), explained.lighting());
        // A reading alone may be enough, without fitted edges.
        let by_outline = decoded.log_likelihood_ratio()
            >= UNREFINED_RATIO * MIN_LOG_LIKELIHOOD_RATIO
            && self.has_cells(&reading, print);
        let mut refined = self.refined(image, light, &corners, print, lighting);
        if refined.is_none() && by_outline {
            refined = (0..4)
                .map(|k| with_parallelogram_corner(&corners, k))
                .find_map(|guess| self.refined(image, light, &guess, print, lighting));
        }
        // The square must read as the same marker with its final corners.
        let fitted = refined.and_then(|refined| {
            let reading = self.reading(image, light, &refined.corners_in_view)?;
            let confirmed = self.reader.compare(&reading)?.best()?;
            let is_same = (confirmed.id, confirmed.first_corner) == (decoded.id, 0);
            let confirmed = confirmed.with(&self.reader.explain(&reading, print));
            let is_accepted = is_same
                && self.looks_printed(&refined, &confirmed)
                && self.has_cells(&reading, print);
            is_accepted.then(|| MarkerInView {
                is_refined: true,
                correlation: confirmed.correlation,
                ..found_at(view, decoded.id, refined.corners_in_view, refined.sigmas_px)
            })
        });
        // Where nothing could be fitted the outline's corners stay. In even light a refused fit
        // means that the square is no print. In uneven light a shadow may have spoiled the fit.
        let keeps_outline = by_outline && (refined.is_none() || lighting == Lighting::Uneven);
        fitted
            .or_else(|| {
                keeps_outline.then(|| MarkerInView {
                    correlation: decoded.correlation,
                    ..found_at(view, decoded.id, corners, [UNREFINED_PX; 4])
                })
            })
            .filter(|marker| is_square(&marker.rays_in_camera, &marker.deviations_rad))
    }

    /// The corners of an outline, with their reading. If the print reads better so, one corner is
    /// replaced by that of a parallelogram, because an outline follows the object that hides a
    /// corner.
    fn with_hidden_corner(
        &self,
        image: &LumaImage<'_>,
        light: &LinearLight,
        outline: &Quad,
        print: &MarkerPrint,
    ) -> Option<(Quad, Reading, Explained)> {
        let read = |corners: Quad| {
            let reading = self.reading(image, light, &corners)?;
            let explained = self.reader.explain(&reading, print);
            Some((corners, reading, explained))
        };
        let mut best = read(*outline)?;
        for completed in (0..4).filter_map(|k| read(with_parallelogram_corner(outline, k))) {
            if completed.2.correlation() > best.2.correlation() {
                best = completed;
            }
        }
        Some(best)
    }

    /// The cells of a square that has a quiet zone.
    fn reading(
        &self,
        image: &LumaImage<'_>,
        light: &LinearLight,
        corners: &Quad,
    ) -> Option<Reading> {
        let magnification = match self.grain {
            Grain::Pixels => 1.0,
            Grain::Resampled { magnification } => magnification,
        };
        Reading::new(image, light, corners, self.dictionary.bits(), magnification)
            .filter(|reading| reading.quiet_zone >= MIN_QUIET_ZONE)
    }

    fn refined(
        &self,
        image: &LumaImage<'_>,
        light: &LinearLight,
        guess: &Quad,
        print: &MarkerPrint,
        lighting: Lighting,
    ) -> Option<RefinedCorners> {
        refine_corners(image, light, guess, print, self.grain, lighting, self.parameters.corner_fit)
    }

    /// Whether fitted corners are precise enough for each sample to lie in its own cell. Otherwise
    /// the reading contains less information on the print. Texture that reads as a marker often has
    /// imprecise corners.
    fn samples_own_cells(&self, refined: &RefinedCorners) -> bool {
        let sigma_px =
            (refined.sigmas_px.map(|sigma| sigma * sigma).iter().sum::<f64>() / 4.0).sqrt();
        sigma_px <= (0.5 - SAMPLE_CELLS) * self.cell_px(&refined.corners_in_view)
    }

    /// The mean side of a cell.
    fn cell_px(&self, corners: &Quad) -> f64 {
        mean_side_px(corners) / (self.dictionary.bits() + 2) as f64
    }

    /// Whether a square with fitted corners is this marker, rather than smooth shading.
    fn looks_printed(&self, refined: &RefinedCorners, decoded: &Decoded) -> bool {
        let blur = (refined.blur_px[0] + refined.blur_px[1])
            / 2.0
            / self.cell_px(&refined.corners_in_view);
        let (ratio, misfit) = BLURRED;
        let passes_blurred =
            decoded.log_likelihood_ratio() >= ratio && refined.residual_sigma <= misfit;
        let is_clear = blur <= MAX_BLUR_CELLS && self.samples_own_cells(refined);
        decoded.log_likelihood_ratio() >= MIN_LOG_LIKELIHOOD_RATIO
            && refined.residual_sigma <= MAX_MISFIT
            && (is_clear || (blur <= MAX_BLUR_CELLS_AT_RANGE && passes_blurred))
    }

    /// Whether the cells have the contrast of print. See [`MIN_CELL_CONTRAST`].
    fn has_cells(&self, reading: &Reading, print: &MarkerPrint) -> bool {
        self.reader.cell_contrast(reading, print) >= MIN_CELL_CONTRAST
    }
}

/// Whether the centre of a quadrilateral lies on the own airframe, or where no lens sees.
pub(crate) fn is_hidden(mask: Option<&Mask>, view: &View, quad: &Quad) -> bool {
    mask.is_some_and(|mask| mask.hides(&view.ray(ViewPixel(centre(quad)))))
}

/// A marker that `view` shows at these corners.
pub(crate) fn found_at(
    view: &View,
    id: u32,
    corners_in_view: Quad,
    deviations_px: [f64; 4],
) -> MarkerInView {
    MarkerInView {
        id,
        corners_in_view,
        rays_in_camera: corners_in_view.map(|corner| view.ray(corner)),
        deviations_rad: std::array::from_fn(|k| {
            deviations_px[k].min(UNREFINED_PX) * radians_per_pixel(view, corners_in_view[k])
        }),
        is_refined: false,
        correlation: 0.0,
    }
}

/// Keeps the first of the markers at each place, because the others are outlines of the same square
/// or of a part of it. A marker printed inside another one has a place of its own: it is much
/// smaller.
fn keep_best_of_each_place(found: &mut Vec<MarkerInView>) {
    let mut kept: Vec<MarkerInView> = Vec::with_capacity(found.len());
    for marker in found.drain(..) {
        let is_there = |other: &MarkerInView| {
            let ratio =
                mean_side_px(&marker.corners_in_view) / mean_side_px(&other.corners_in_view);
            is_same_place(other, &marker) && ratio.max(1.0 / ratio) < NESTED_SIDE_RATIO
        };
        if !kept.iter().any(is_there) {
            kept.push(marker);
        }
    }
    *found = kept;
}

fn is_same_place(known: &MarkerInView, marker: &MarkerInView) -> bool {
    let apart = centre(&known.corners_in_view) - centre(&marker.corners_in_view);
    apart.norm() <= SAME_PLACE_SHARE * mean_side_px(&known.corners_in_view)
}

/// Whether a quadrilateral is another outline of a marker that was found already.
fn is_outline_of(marker: &MarkerInView, quad: &Quad) -> bool {
    let (pixels, share) = SAME_CORNER;
    let near = pixels + share * mean_side_px(&marker.corners_in_view);
    marker.is_refined
        && marker
            .corners_in_view
            .iter()
            .all(|corner| quad.iter().any(|other| (other.0 - corner.0).norm() < near))
}

/// Angle of a pixel at `at`, radians: the mean of those along and across the direction from the
/// middle.
fn radians_per_pixel(view: &View, at: ViewPixel) -> f64 {
    let (x, y) = (at.0.x - view.centre_px(), at.0.y - view.centre_px());
    let squared = x * x + y * y + view.focal_px * view.focal_px;
    let (radial, tangential) = (view.focal_px / squared, 1.0 / squared.sqrt());
    ((radial * radial + tangential * tangential) / 2.0).sqrt()
}
