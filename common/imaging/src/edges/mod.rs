//! The corners of a marker, refined by its four edges and its print.
//!
//! OpenCV finds corners by a threshold or a gradient of *code values*. They lie inside the true
//! square by 0.2 to 0.85 px. Here each corner is the intersection of two lines. Each line is fitted
//! to the place where the radiance steps from the white quiet zone to the black border:
//!
//! 1. `approach` moves each side to the steepest fall of radiance.
//! 2. `profile` samples the radiance across each side, in many places along it but away from the
//!    corners, from within the quiet zone to a few cells deep.
//! 3. `model` fits the blurred print to all samples of all four sides. All sides share white and
//!    black. Each direction has its own blur, because motion blurs one more than the other. Each
//!    edge has its own position and slope. The marker was decoded, so the cells behind the edge are
//!    known. On small markers the border is hardly wider than the blur. There an edge fitted as if
//!    the border had no end would be some tenths of a pixel too far outside.
//! 4. `line` fits a line to the edge's position in each profile, without outliers such as a
//!    propeller or another edge. The scatter of the positions gives the covariance.
//!
//! Steps 2 to 4 are repeated two or three times, because the lines give better places for samples
//! and cells. The first time, `model` takes only a few steps.
//!
//! In uneven light, `level` normalises the profiles to one light before step 3
//! ([`Lighting::Uneven`]).
//!
//! 5. `whole` fits all cells of the print to the pixels, starting from these corners
//!    ([`CornerFit::WholePrint`]).

mod approach;
mod corners;
mod drawing;
mod grain;
mod level;
mod line;
mod model;
mod print;
mod profile;
mod side;
mod whole;

use flockeye_geometry::view::ViewPixel;

use crate::image::LumaImage;
use crate::light::LinearLight;
use crate::square::{SquareInView, mean_side_px};
pub use approach::approach_corners;
pub use corners::RefinedCorners;
use corners::{agree, is_near, without_whole};
pub use grain::Grain;
use line::EdgeLine;
pub use print::MarkerPrint;
use profile::Side;

/// Markers with shorter sides are not refined, pixels: their border is hardly wider than a pixel.
pub const MIN_SIDE_PX: f64 = 8.0;

/// Refines the corners of a black square on white, from a guess that is off by up to 1.5 px.
///
/// `guess_in_view` is in ArUco's order: clockwise from the printed top left. `None` where the
/// marker is smaller than [`MIN_SIDE_PX`], leaves the image, or has too little contrast. Also
/// `None` without four straight edges near the guess, or if it does not look like `print`.
pub fn refine_corners(
    image: &LumaImage<'_>,
    light: &LinearLight,
    guess_in_view: &[ViewPixel; 4],
    print: &MarkerPrint,
    grain: Grain,
    lighting: Lighting,
    corner_fit: CornerFit,
) -> Option<RefinedCorners> {
    let size = mean_side_px(guess_in_view);
    // False for a NaN.
    let is_large_enough = size >= MIN_SIDE_PX;
    if !is_large_enough {
        return None;
    }
    let edges = by_edges(image, light, guess_in_view, print, lighting)?;
    let whole = match corner_fit {
        CornerFit::WholePrint if lighting == Lighting::Even => {
            by_whole_print(image, light, &edges, print, grain).filter(|whole| {
                let is_near = is_near(&whole.corners_in_view, guess_in_view);
                is_near && agree(whole, &edges, print)
                    || are_edges_of(whole, image, light, print, lighting)
            })
        }
        _ => None,
    };
    Some(whole.unwrap_or_else(|| RefinedCorners {
        sigmas_px: edges.sigmas_px.map(|sigma_px| without_whole(sigma_px, &edges, print)),
        ..edges
    }))
}

/// The corners where the four edges near a guess cross.
fn by_edges(
    image: &LumaImage<'_>,
    light: &LinearLight,
    guess_in_view: &[ViewPixel; 4],
    print: &MarkerPrint,
    lighting: Lighting,
) -> Option<RefinedCorners> {
    SquareInView::new(guess_in_view)?;
    let mut corners = approach_corners(image, light, guess_in_view, print.cells())?;
    let mut before: Option<model::EdgeFit> = None;
    let mut refined: Option<RefinedCorners> = None;
    for _ in 0..3 {
        let blur = before.as_ref().map_or([profile::FIRST_BLUR_PX; 2], |fit| fit.blur);
        let side = |k: usize| Side::sample(image, light, &corners, print, k, blur);
        let mut sides = [side(0)?, side(1)?, side(2)?, side(3)?];
        let border = sides.iter().map(Side::border).fold(f64::INFINITY, f64::min);
        let is_wide = border >= LEVEL_BLURS * blur[0].max(blur[1]) && !level::is_clipped(&sides);
        if lighting == Lighting::Uneven || is_wide {
            level::level(&mut sides, blur);
        }
        let fit = model::fit(&sides, before.as_ref())?;
        let lines = fit_lines(&sides, &fit)?;
        let crossed = cross(&sides, &lines)?;
        let moved = (0..4).map(|k| (crossed[k].0.0 - corners[k].0).norm()).fold(0.0, f64::max);
        corners = crossed.map(|corner| corner.0);
        refined = Some(RefinedCorners {
            corners_in_view: corners,
            sigmas_px: crossed.map(|corner| corner.1),
            blur_px: fit.blur,
            white: fit.white,
            black: fit.black,
            residual_sigma: fit.noise / (fit.white - fit.black),
        });
        // The first fit is coarse.
        if before.is_some() && moved < CONVERGED_PX {
            break;
        }
        before = Some(fit);
    }
    refined.filter(|refined| is_near(&refined.corners_in_view, guess_in_view))
}

/// Whether edges fitted from the whole print's corners return to these corners. Where an object
/// hides a corner, the edges from the outline may have followed that object.
fn are_edges_of(
    whole: &RefinedCorners,
    image: &LumaImage<'_>,
    light: &LinearLight,
    print: &MarkerPrint,
    lighting: Lighting,
) -> bool {
    let edges = by_edges(image, light, &whole.corners_in_view, print, lighting);
    edges.is_some_and(|edges| agree(whole, &edges, print))
}

/// Lighting of a marker.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Lighting {
    /// One white and one black everywhere.
    #[default]
    Even,
    /// Shadows cross it: white and black differ from place to place. Only its edges are fitted,
    /// each place of them in its own light.
    Uneven,
}

/// Extent of the fit that refines corners.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum CornerFit {
    /// The four edges: enough as a start for aligning the whole body.
    Edges,
    /// The edges, then the whole print, at many times the cost: corners are final.
    #[default]
    WholePrint,
}

/// The corners from the whole print, starting from those of the edges. `None` where it does not
/// fit.
fn by_whole_print(
    image: &LumaImage<'_>,
    light: &LinearLight,
    edges: &RefinedCorners,
    print: &MarkerPrint,
    grain: Grain,
) -> Option<RefinedCorners> {
    let whole = whole::fit(image, light, edges, print, grain)?;
    (0.0..=MAX_RESIDUAL_SIGMA).contains(&whole.residual_sigma).then_some(RefinedCorners {
        sigmas_px: whole.sigmas_px.map(|sigma_px| sigma_px.hypot(MIN_SIGMA_PX)),
        residual_sigma: whole.residual_sigma.max(edges.residual_sigma),
        ..whole
    })
}

/// Motion of the corners in a round below which no further round is needed, pixels.
const CONVERGED_PX: f64 = 0.2;

/// Largest residual sigma of a fitting print, as a share of the contrast.
const MAX_RESIDUAL_SIGMA: f64 = 0.25;

/// Least standard deviation of a corner, pixels: the model of a lens is not perfect.
const MIN_SIGMA_PX: f64 = 0.003;

/// Fits the line along each side.
fn fit_lines(sides: &[Side; 4], fit: &model::EdgeFit) -> Option<[EdgeLine; 4]> {
    let line = |k: usize| {
        let line = line::fit(&model::places(&sides[k], fit, k), fit.line_covariance(k))?;
        let blur = fit.blur[k % 2];
        Some(line.with_offset_error(crowding(blur, sides[k].border()).hypot(MODEL_SHARE * blur)))
    };
    Some([line(0)?, line(1)?, line(2)?, line(3)?])
}

/// Standard deviation of an edge's position from errors of the model, as a share of the blur.
/// Compression, sharpening and a blur that is not Gaussian shift an edge in all profiles alike.
const MODEL_SHARE: f64 = 0.03;

/// Standard deviation of an edge's position from blurred neighbours, pixels: the border's inner
/// edge, and the surroundings beyond the quiet zone. All profiles share this error, so it is not in
/// their scatter. Measured on rendered markers of 14 to 60 px (`tests/corners.rs`).
fn crowding(blur: f64, border: f64) -> f64 {
    (blur / border).powf(3.5)
}

/// The corners with their standard deviations, pixels. Corner k joins sides k - 1 and k.
fn cross(sides: &[Side; 4], lines: &[EdgeLine; 4]) -> Option<[(ViewPixel, f64); 4]> {
    let corner = |k: usize| {
        let before = (k + 3) % 4;
        line::cross((&sides[before].frame, &lines[before]), (&sides[k].frame, &lines[k]))
    };
    Some([corner(0)?, corner(1)?, corner(2)?, corner(3)?])
}

/// Width of the border, in blurs, above which each place of an edge shows white and black by
/// itself. Then each place is fitted in its own light for any lighting.
const LEVEL_BLURS: f64 = 4.0;
