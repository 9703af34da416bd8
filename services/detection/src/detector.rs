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

use crate::candidates::{Candidates, Finder, Square};
use crate::drawn::SAMPLE_CELLS;
use crate::parameters::{DetectError, DetectorParameters, check_thresholds};
use crate::quad::{Quad, centre, rotated, with_parallelogram_corner};
use crate::reader::MarkerReader;
use crate::reading::Reading;
use crate::shape::is_square;
use crate::windows::Threshold;

/// Images with a shorter side are not searched, pixels: they hold no marker with its quiet zone.
const MIN_IMAGE_PX: usize = 16;

/// Standard deviation of a corner whose edges could not be fitted, pixels. Something covers them
/// then, and outlines are off by one to three pixels.
const UNREFINED_PX: f64 = 2.0;

/// Assumed deviation of such a square from print, as a share of its contrast.
/// docs/results/constants.md#limits-of-detection has the detections with other values.
const UNREFINED_MISFIT: f64 = 0.1;

/// Least log odds of a marker, for a square to be one. docs/results/constants.md#limits-of-detection
/// has the detections and false detections with other values.
const MIN_LOG_ODDS: f64 = 4.5;

/// Log odds of an outline's reading from which a fit of its corners is worth its time. Where corners
/// are only approximate, cells are sampled off their middles.
const WORTH_FITTING: f64 = 2.0;

/// Least step from the border out to the quiet zone, on each side, as a share of that from black
/// print to white paper.
const MIN_QUIET_ZONE: f32 = 0.2;

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
    /// Log odds that the square is this marker, rather than another one or none. 0 if it was found
    /// by OpenCV, which states none.
    pub log_odds: f64,
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
        for square in whole.iter().chain(&completed) {
            let quad = &square.corners;
            if is_hidden(self.mask.as_ref(), view, quad)
                || found.iter().any(|marker| is_outline_of(marker, quad))
                || !read.insert(quad.map(|corner| [corner.0.x.to_bits(), corner.0.y.to_bits()]))
            {
                continue;
            }
            found.extend(self.read(image, view, light, square));
        }
        let order = |a: &MarkerInView, b: &MarkerInView| {
            let likelier = b.log_odds.total_cmp(&a.log_odds);
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
        square: &Square,
    ) -> Option<MarkerInView> {
        let near = approach_corners(image, light, &square.corners, self.dictionary.bits() + 2)?;
        if mean_side_px(&near) < self.parameters.min_side_px {
            return None;
        }
        let decoded = self.reader.compare(&self.reading(image, light, &near)?)?.best()?;
        if decoded.log_odds(UNREFINED_MISFIT) < WORTH_FITTING {
            return None;
        }
        let print = self.dictionary.print(decoded.id)?;
        let outline = rotated(&near, decoded.first_corner);
        let (corners, lighting) = self.with_hidden_corner(image, light, &outline, print)?;
        let accepted = |corners: &Quad, sigmas_px: [f64; 4], misfit: f64| {
            // Such corners are known nowhere. False for a NaN.
            if !sigmas_px.iter().all(|sigma_px| *sigma_px < mean_side_px(corners)) {
                return None;
            }
            let log_odds = self.log_odds(image, light, corners, decoded.id, print, misfit)?
                - self.misplacement(corners, &sigmas_px);
            let found = found_at(view, decoded.id, *corners, sigmas_px);
            (log_odds >= MIN_LOG_ODDS).then_some(MarkerInView { log_odds, ..found })
        };
        let fit = |guess: &Quad| {
            let (grain, fit) = (self.grain, self.parameters.corner_fit);
            refine_corners(image, light, guess, print, grain, lighting, fit)
        };
        let accepted_fit = |refined: RefinedCorners| {
            let RefinedCorners { corners_in_view, sigmas_px, residual_sigma, .. } = refined;
            let found = accepted(&corners_in_view, sigmas_px, residual_sigma)?;
            Some(MarkerInView { is_refined: true, ..found })
        };
        let refined = fit(&corners);
        let is_fitted = refined.is_some();
        let by_fit = refined.and_then(accepted_fit);
        // Where a shadow or something else spoils the fit, the reading of the outline may be enough.
        // The corner that is hidden may lie elsewhere.
        let found = by_fit.or_else(|| {
            let sigma_px = square.accuracy_px.max(UNREFINED_PX);
            let guesses = (0..4).filter(|_| !is_fitted);
            let mut guesses = guesses.map(|k| with_parallelogram_corner(&corners, k));
            let by_outline = accepted(&corners, [sigma_px; 4], UNREFINED_MISFIT)?;
            let by_guess = guesses.find_map(|guess| fit(&guess)).and_then(accepted_fit);
            by_guess.or(Some(by_outline))
        })?;
        is_square(&found.rays_in_camera, &found.deviations_rad).then_some(found)
    }

    /// Log odds that the square with these corners is this marker, by its cells. `None` if it reads
    /// as another one. `misfit`: see [`Decoded::log_odds`](crate::reader::Decoded::log_odds).
    fn log_odds(
        &self,
        image: &LumaImage<'_>,
        light: &LinearLight,
        corners: &Quad,
        id: u32,
        print: &MarkerPrint,
        misfit: f64,
    ) -> Option<f64> {
        let reading = self.reading(image, light, corners)?;
        let decoded = self.reader.compare(&reading)?.best()?;
        let is_same = (decoded.id, decoded.first_corner) == (id, 0);
        is_same.then(|| decoded.with(&self.reader.explain(&reading, print)).log_odds(misfit))
    }

    /// Log odds that a reading loses by the uncertainty of its corners.
    ///
    /// While each sample stays in its own cell, corners need not be known better. Beyond that a fit
    /// could choose among several readings for each corner, and the best of many resembles a marker
    /// by chance. docs/results/constants.md#limits-of-detection has what this finds and refuses.
    fn misplacement(&self, corners: &Quad, sigmas_px: &[f64; 4]) -> f64 {
        let own_px = (0.5 - SAMPLE_CELLS) * self.cell_px(corners);
        sigmas_px.iter().map(|sigma_px| (sigma_px / own_px).max(1.0).ln()).sum()
    }

    /// The corners of an outline, and the light in which the print reads best. If the print reads
    /// better so, one corner is replaced by that of a parallelogram, because an outline follows the
    /// object that hides a corner.
    fn with_hidden_corner(
        &self,
        image: &LumaImage<'_>,
        light: &LinearLight,
        outline: &Quad,
        print: &MarkerPrint,
    ) -> Option<(Quad, Lighting)> {
        let read = |corners: Quad| {
            let reading = self.reading(image, light, &corners)?;
            Some((corners, self.reader.explain(&reading, print)))
        };
        let mut best = read(*outline)?;
        for completed in (0..4).filter_map(|k| read(with_parallelogram_corner(outline, k))) {
            if completed.1.correlation() > best.1.correlation() {
                best = completed;
            }
        }
        Some((best.0, best.1.lighting()))
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

    /// The mean side of a cell.
    fn cell_px(&self, corners: &Quad) -> f64 {
        mean_side_px(corners) / (self.dictionary.bits() + 2) as f64
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
            deviations_px[k] * radians_per_pixel(view, corners_in_view[k])
        }),
        is_refined: false,
        log_odds: 0.0,
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
