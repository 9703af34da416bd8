//! From a view to its markers.

use flockeye_dictionary::Dictionary;
use flockeye_geometry::Ray;
use flockeye_geometry::mask::Mask;
use flockeye_geometry::view::{View, ViewPixel};
use flockeye_imaging::edges::{
    Effort, Grain, MarkerPrint, RefinedCorners, approach_corners, refine_corners,
};
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::LinearLight;
use flockeye_imaging::square::mean_side_px;
use nalgebra::Vector2;

use crate::DetectError;
use crate::candidates::{Candidates, Finder, Quad};
use crate::reading::{Decoded, Likeness, Reader, Reading};

/// Images with a shorter side hold no marker, pixels.
const MIN_IMAGE_PX: usize = 16;

/// Standard deviation of a corner whose edges could not be fitted, pixels: something covers them, and
/// outlines are off by a pixel or three there.
const UNREFINED_PX: f64 = 2.0;

/// A pixel is dark if it is darker than its surroundings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Threshold {
    /// Side of the square of surroundings whose mean counts, pixels; odd. From 15 on it is one of
    /// blocks: smaller by a tenth at most, and up to a fourteenth of it off.
    pub window_px: usize,
    /// By how much it must be darker, code values; 1 or more.
    pub darker_by: u8,
}

/// Doubtful markers in one view.
pub const MAX_DOUBTFUL: usize = 4;

/// Correlation with an expected marker from which on a square is offered as doubtful: the best of
/// some forty markers has about 0.5 with random cells.
const MIN_GUESS: f32 = 0.65;

/// Print deviates from its blurred image by a few hundredths of its contrast, texture by more.
const MAX_MISFIT: f64 = 0.15;

/// Texture that reads as a marker is smooth: what is blurred by more cells than this must read and fit
/// as texture never does.
const MAX_BLUR_CELLS: f64 = 0.75;

/// What is blurred by more cells is no marker. Small ones far away are blurred by 0.8 to 1.
const MAX_BLUR_CELLS_AT_ALL: f64 = 1.1;

/// Least agreement and certainty, and the largest misfit, of such a one. In a hall, in panoramas and in a
/// simulated world, 7100 squares blurred by 0.75 to 1.1 cells that are no markers read as one with a
/// certainty of 8 at most; of 197 that are, 167 pass.
const FAINT: (f32, f32, f64) = (0.93, 11.0, 0.06);

/// What is looked for, and what is believed.
///
/// The defaults were chosen on renderings and on real panoramas without markers, where what passes
/// for a marker by its cells alone has a certainty of up to 13 (its edges then tell).
#[derive(Debug, Clone, PartialEq)]
pub struct DetectorParameters {
    /// Markers with shorter sides are not looked for, pixels.
    pub min_side_px: f64,
    /// Local thresholds that squares are looked for with: each one finds some that the others lose
    /// (where a marker's shadow side joins what is dark beside it, say), and costs another pass.
    pub thresholds: Vec<Threshold>,
    /// How far an outline may deviate from a quadrilateral, as a share of its length.
    pub polygon_accuracy: f64,
    /// How far an outline may deviate from one that has three of a square's corners, pixels.
    pub corner_accuracy_px: f64,
    /// Correlation of the cells with those of the marker, blurred, from which on it is believed.
    pub min_agreement: f32,
    /// Logarithm of the likelihood ratio to the next id from which on it is believed.
    pub min_certainty: f32,
    /// How far the quiet zone must outshine the border, on each side, as a share of the contrast.
    pub min_quiet_zone: f32,
    /// What is fitted to find a marker's corners.
    pub effort: Effort,
}

impl Default for DetectorParameters {
    fn default() -> Self {
        Self {
            min_side_px: 11.0,
            thresholds: vec![
                // Small markers; and large or bright ones, whose corners touch something dark.
                Threshold { window_px: 11, darker_by: 4 },
                Threshold { window_px: 61, darker_by: 10 },
            ],
            polygon_accuracy: 0.05,
            corner_accuracy_px: 2.0,
            min_agreement: 0.85,
            min_certainty: 10.0,
            min_quiet_zone: 0.2,
            effort: Effort::default(),
        }
    }
}

/// A marker in a view.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// Its id in the dictionary.
    pub id: u32,
    /// Its corners in ArUco's order: clockwise from the printed top left.
    pub corners_in_view: [ViewPixel; 4],
    /// The rays that see them, in the camera frame.
    pub rays_in_camera: [Ray; 4],
    /// Standard deviation of each ray across itself, radians.
    pub deviations_rad: [f64; 4],
    /// Whether the corners are those of the fitted print (or only of the outline).
    pub is_refined: bool,
    /// Correlation of its cells with those of the marker: 1 is perfect.
    pub agreement: f32,
    /// Whether it is only a square that is probably this marker: good to start from, and to be
    /// confirmed by something else.
    pub is_doubtful: bool,
}

/// Finds the markers of one dictionary.
pub struct Detector {
    dictionary: Dictionary,
    reader: Reader,
    parameters: DetectorParameters,
    mask: Option<Mask>,
    /// Ids that a doubtful square may be taken for.
    expected: Vec<u32>,
    grain: Grain,
    finder: Finder,
}

impl Detector {
    /// A detector for the dictionary of this name (one of [`flockeye_dictionary::PREDEFINED`], or a file's path).
    ///
    /// # Errors
    /// An unknown dictionary, a broken file, or a parameter outside its range.
    pub fn new(dictionary: &str, parameters: DetectorParameters) -> Result<Self, DetectError> {
        check(&parameters)?;
        let dictionary = Dictionary::load(dictionary)?;
        let reader = Reader::new(&dictionary);
        Ok(Self {
            dictionary,
            reader,
            parameters,
            mask: None,
            expected: Vec::new(),
            grain: Grain::Pixels,
            finder: Finder::default(),
        })
    }

    /// Offers squares that do not decode as doubtful markers, if they look like one of these.
    pub fn with_expected(self, ids: impl IntoIterator<Item = u32>) -> Self {
        let known = ids.into_iter().filter(|&id| self.dictionary.print(id).is_some());
        Self { expected: known.collect(), ..self }
    }

    /// Leaves out squares on what `mask` hides.
    pub fn with_mask(self, mask: Mask) -> Self {
        Self { mask: Some(mask), ..self }
    }

    /// The dictionary.
    pub fn dictionary(&self) -> &Dictionary {
        &self.dictionary
    }

    /// Looks for squares with other thresholds from now on.
    ///
    /// # Errors
    /// As [`Detector::new`]: none at all, or windows that are none.
    pub fn set_thresholds(&mut self, thresholds: Vec<Threshold>) -> Result<(), DetectError> {
        let parameters = DetectorParameters { thresholds, ..self.parameters.clone() };
        check(&parameters)?;
        self.parameters = parameters;
        Ok(())
    }

    /// From now on images are views cut from others, with so many pixels for each of theirs along
    /// either axis.
    pub fn set_magnification(&mut self, magnification: f64) {
        self.grain = Grain::Resampled { magnification };
        self.parameters.corner_accuracy_px = 1.0 + magnification.max(1.0);
    }

    /// Every marker in `image`, which shows what `view` says; by rising id, each id once. Behind
    /// them at most [`MAX_DOUBTFUL`] doubtful ones of other ids, the best first.
    pub fn detect(
        &mut self,
        image: &LumaImage<'_>,
        view: &View,
        light: &LinearLight,
    ) -> Vec<Found> {
        if image.width().min(image.height()) < MIN_IMAGE_PX {
            return Vec::new();
        }
        let Candidates { whole, completed } = self.finder.find(image, &self.parameters);
        let mut found: Vec<Found> = Vec::new();
        let mut doubtful: Vec<Found> = Vec::new();
        for quad in whole.iter().chain(&completed) {
            if self.is_hidden(view, quad) || found.iter().any(|marker| is_outline_of(marker, quad))
            {
                continue;
            }
            match self.read(image, view, light, quad) {
                Some(marker) if marker.is_doubtful => doubtful.push(marker),
                Some(marker) => found.push(marker),
                None => {}
            }
        }
        // One square may have several outlines; nobody prints an id twice.
        found.sort_by(|a, b| a.id.cmp(&b.id).then(b.agreement.total_cmp(&a.agreement)));
        found.dedup_by_key(|marker| marker.id);
        add_doubtful(&mut found, doubtful);
        found
    }

    /// Whether a quadrilateral's middle lies on the own airframe, or where no lens sees.
    fn is_hidden(&self, view: &View, quad: &Quad) -> bool {
        let Some(mask) = &self.mask else { return false };
        mask.hides(&view.ray(ViewPixel(middle(quad))))
    }

    /// The marker in a quadrilateral, if there is one to be believed, or else the one that it looks
    /// most like, if it looks like any.
    fn read(
        &self,
        image: &LumaImage<'_>,
        view: &View,
        light: &LinearLight,
        quad: &Quad,
    ) -> Option<Found> {
        let near = approach_corners(image, light, quad, self.dictionary.bits() + 2)?;
        if mean_side_px(&near) < self.parameters.min_side_px {
            return None;
        }
        let likeness = self.reader.compare(&self.reading(image, light, &near)?)?;
        self.marker(image, view, light, &near, &likeness)
            .or_else(|| self.doubtful(view, &near, &likeness))
    }

    /// The marker in a square, if there is one to be believed.
    fn marker(
        &self,
        image: &LumaImage<'_>,
        view: &View,
        light: &LinearLight,
        near: &Quad,
        likeness: &Likeness,
    ) -> Option<Found> {
        let decoded = likeness.best()?;
        if !self.is_worth_fitting(&decoded) {
            return None;
        }
        let corners = turned(near, decoded.first_corner);
        let print = self.dictionary.print(decoded.id)?;
        let mut refined = self.refined(image, light, &corners, print);
        if refined.is_none() && self.is_beyond_doubt(&decoded) {
            refined = (0..4)
                .map(|k| with_corner_opposite(&corners, k))
                .find_map(|guess| self.refined(image, light, &guess, print));
        }
        let (corners_in_view, deviations_px) = match refined {
            Some(refined) => (refined.corners_in_view, refined.sigmas_px),
            None => (corners, [UNREFINED_PX; 4]),
        };
        // What reads well only where the corners were guessed is no marker.
        let confirmed =
            self.reader.compare(&self.reading(image, light, &corners_in_view)?)?.best()?;
        let is_same = (confirmed.id, confirmed.first_corner) == (decoded.id, 0);
        let is_believed = match refined {
            Some(refined) => self.is_marker(&confirmed) && self.looks_printed(&refined, &confirmed),
            None => self.is_beyond_doubt(&confirmed),
        };
        (is_same && is_believed).then(|| Found {
            is_refined: refined.is_some(),
            agreement: confirmed.agreement,
            ..seen(view, decoded.id, corners_in_view, deviations_px)
        })
    }

    /// The expected marker that a square looks most like.
    fn doubtful(&self, view: &View, near: &Quad, likeness: &Likeness) -> Option<Found> {
        let guessed = likeness.best_among(self.expected.iter().copied())?;
        (guessed.agreement >= MIN_GUESS).then(|| Found {
            agreement: guessed.agreement,
            is_doubtful: true,
            ..seen(view, guessed.id, turned(near, guessed.first_corner), [UNREFINED_PX; 4])
        })
    }

    /// The cells of a square that has a quiet zone.
    fn reading(
        &self,
        image: &LumaImage<'_>,
        light: &LinearLight,
        corners: &Quad,
    ) -> Option<Reading> {
        Reading::new(image, light, corners, self.dictionary.bits())
            .filter(|reading| reading.quiet_zone() >= self.parameters.min_quiet_zone)
    }

    fn refined(
        &self,
        image: &LumaImage<'_>,
        light: &LinearLight,
        guess: &Quad,
        print: &MarkerPrint,
    ) -> Option<RefinedCorners> {
        refine_corners(image, light, guess, print, self.grain, self.parameters.effort)
    }

    /// Where corners were guessed, cells are read beside their middles.
    fn is_worth_fitting(&self, decoded: &Decoded) -> bool {
        decoded.agreement >= 0.85 * self.parameters.min_agreement
            && decoded.certainty >= 0.5 * self.parameters.min_certainty
    }

    fn is_marker(&self, decoded: &Decoded) -> bool {
        decoded.agreement >= self.parameters.min_agreement
            && decoded.certainty >= self.parameters.min_certainty
    }

    /// Enough to believe a marker whose edges could not be fitted.
    fn is_beyond_doubt(&self, decoded: &Decoded) -> bool {
        decoded.agreement >= (1.0 + self.parameters.min_agreement) / 2.0
            && decoded.certainty >= 2.0 * self.parameters.min_certainty
    }

    /// Whether the fitted edges are those of print, and no smooth shading.
    fn looks_printed(&self, refined: &RefinedCorners, decoded: &Decoded) -> bool {
        let cell = mean_side_px(&refined.corners_in_view) / (self.dictionary.bits() + 2) as f64;
        let blur = (refined.blur_px[0] + refined.blur_px[1]) / 2.0 / cell;
        let (agreement, certainty, misfit) = FAINT;
        let is_told_though_faint = decoded.agreement >= agreement
            && decoded.certainty >= certainty
            && refined.residual_sigma <= misfit;
        refined.residual_sigma <= MAX_MISFIT
            && (blur <= MAX_BLUR_CELLS || (blur <= MAX_BLUR_CELLS_AT_ALL && is_told_though_faint))
    }
}

/// A marker that `view` sees at these corners.
fn seen(view: &View, id: u32, corners_in_view: Quad, deviations_px: [f64; 4]) -> Found {
    Found {
        id,
        corners_in_view,
        rays_in_camera: corners_in_view.map(|corner| view.ray(corner)),
        deviations_rad: std::array::from_fn(|k| {
            deviations_px[k].min(UNREFINED_PX) * radians_per_pixel(view, corners_in_view[k])
        }),
        is_refined: false,
        agreement: 0.0,
        is_doubtful: false,
    }
}

/// Adds the best of the doubtful ones: each id once, none that was found for sure, none where
/// another marker is.
fn add_doubtful(found: &mut Vec<Found>, mut doubtful: Vec<Found>) {
    doubtful.sort_by(|a, b| b.agreement.total_cmp(&a.agreement).then(a.id.cmp(&b.id)));
    let most = found.len() + MAX_DOUBTFUL;
    for marker in doubtful {
        let is_new = found.iter().all(|known| {
            let apart = middle(&known.corners_in_view) - middle(&marker.corners_in_view);
            known.id != marker.id && apart.norm() > 0.3 * mean_side_px(&known.corners_in_view)
        });
        if is_new && found.len() < most {
            found.push(marker);
        }
    }
}

fn middle(corners: &Quad) -> Vector2<f64> {
    corners.iter().map(|corner| corner.0).sum::<Vector2<f64>>() / 4.0
}

/// Whether a quadrilateral is another outline of a marker that is known already.
fn is_outline_of(marker: &Found, quad: &Quad) -> bool {
    let near = 2.0 + 0.05 * mean_side_px(&marker.corners_in_view);
    marker.is_refined
        && marker
            .corners_in_view
            .iter()
            .all(|corner| quad.iter().any(|other| (other.0 - corner.0).norm() < near))
}

/// The corners with corner `k` where the other three, as a parallelogram, want it: outlines lose a
/// corner where something dark touches it.
fn with_corner_opposite(corners: &Quad, k: usize) -> Quad {
    let mut completed = *corners;
    let [before, after, opposite] = [3, 1, 2].map(|n| corners[(k + n) % 4].0);
    completed[k] = ViewPixel(before + after - opposite);
    completed
}

/// The corners, beginning with the one of this index.
fn turned(corners: &Quad, first: usize) -> Quad {
    std::array::from_fn(|k| corners[(k + first) % 4])
}

/// Angle that a pixel spans at `at`, mean of along and across the direction from the middle.
fn radians_per_pixel(view: &View, at: ViewPixel) -> f64 {
    let (x, y) = (at.0.x - view.centre_px(), at.0.y - view.centre_px());
    let squared = x * x + y * y + view.focal_px * view.focal_px;
    let (radial, tangential) = (view.focal_px / squared, 1.0 / squared.sqrt());
    ((radial * radial + tangential * tangential) / 2.0).sqrt()
}

fn check(parameters: &DetectorParameters) -> Result<(), DetectError> {
    if parameters.thresholds.is_empty() {
        let (name, allowed) = ("thresholds", "one or more");
        return Err(DetectError::Parameter { name, value: 0.0, allowed });
    }
    let window = |threshold: &Threshold| threshold.window_px;
    let wrong = parameters.thresholds.iter().map(window).find(|w| *w < 3 || w % 2 == 0);
    let rules = [
        ("min_side_px", parameters.min_side_px, parameters.min_side_px >= 8.0, "8 or more"),
        ("window_px", wrong.unwrap_or(3) as f64, wrong.is_none(), "odd, and 3 or more"),
        (
            "darker_by",
            0.0,
            parameters.thresholds.iter().all(|threshold| threshold.darker_by > 0),
            "1 or more",
        ),
        (
            "polygon_accuracy",
            parameters.polygon_accuracy,
            parameters.polygon_accuracy > 0.0 && parameters.polygon_accuracy < 0.2,
            "between 0 and 0.2",
        ),
        (
            "corner_accuracy_px",
            parameters.corner_accuracy_px,
            parameters.corner_accuracy_px > 0.0,
            "above 0",
        ),
        (
            "min_agreement",
            f64::from(parameters.min_agreement),
            (0.0..=1.0).contains(&parameters.min_agreement),
            "from 0 to 1",
        ),
    ];
    for (name, value, holds, allowed) in rules {
        if !holds || !value.is_finite() {
            return Err(DetectError::Parameter { name, value, allowed });
        }
    }
    Ok(())
}
