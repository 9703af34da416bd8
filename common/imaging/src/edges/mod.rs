//! A marker's corners, from its four edges.
//!
//! OpenCV's corners lie where a threshold or a gradient of *code values* does, and that is inside
//! the true square by 0.2 to 0.85 px. Here each corner is where two lines cross, each fitted to
//! the place where the light steps from the white quiet zone to the black border:
//!
//! 1. `profile`: light is sampled across each side, at many places along it, away from the
//!    corners, from within the quiet zone to a few cells deep.
//! 2. `model`: the blurred print is fitted to all samples of all four sides: white and black are
//!    the whole marker's, the blur is that of each direction (motion blurs one more than the
//!    other), the position and turn of each edge its own. Because the marker was decoded, what
//!    lies behind the edge is known: on small markers the border is hardly wider than the blur, and
//!    an edge fitted as if the border had no end is some tenths of a pixel too far out.
//! 3. `line`: each profile then says where it sees the edge; a line is fitted to these places,
//!    outliers (a propeller, another edge) put aside, and what they scatter gives the covariance.
//!
//! Two or three times, because the lines say better where to sample and where the cells lie: so the first
//! time, `model` takes a few steps only.

mod drawing;
mod grain;
mod line;
mod model;
mod print;
mod profile;
mod whole;

use flockeye_geometry::view::ViewPixel;
use nalgebra::Vector2;

use crate::image::LumaImage;
use crate::light::LinearLight;
use crate::square::{SquareInView, mean_side_px};
pub use grain::Grain;
use line::EdgeLine;
pub use print::MarkerPrint;
use profile::Side;
use whole::State;

/// Corners of a marker's black square, and how well they are known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefinedCorners {
    /// The corners, in the order of the guesses.
    pub corners_in_view: [ViewPixel; 4],
    /// Standard deviation of each corner along either axis, pixels.
    pub deviations_px: [f64; 4],
    /// Standard deviation of the Gaussian that blurs the first and third side, and the second and
    /// fourth, pixels.
    pub blur_px: [f64; 2],
    /// Light of the quiet zone.
    pub white: f64,
    /// Light of the border.
    pub black: f64,
    /// What the light deviates from the blurred print, as a share of white less black (a robust
    /// standard deviation).
    pub misfit: f64,
}

/// Markers with smaller sides are not refined, pixels: their border is hardly wider than a pixel.
pub const MIN_SIDE_PX: f64 = 8.0;

/// Finds where the corners of a black square on white are, given where they are within about 1.5 px.
///
/// `guess_in_view`: in ArUco's order (clockwise from the printed top left). `None` where the marker
/// is too small (below [`MIN_SIDE_PX`]), cut by the image's border, has too little contrast, or
/// no four straight edges near the guess, or where the light is not that of `print`.
pub fn refine_corners(
    image: &LumaImage<'_>,
    light: &LinearLight,
    guess_in_view: &[ViewPixel; 4],
    print: &MarkerPrint,
    grain: Grain,
    effort: Effort,
) -> Option<RefinedCorners> {
    let size = mean_side_px(guess_in_view);
    // Written so that a NaN is too small.
    let is_large_enough = size >= MIN_SIDE_PX;
    if !is_large_enough {
        return None;
    }
    SquareInView::new(guess_in_view)?;
    let mut corners = approach_corners(image, light, guess_in_view, print.cells())?;
    let mut before: Option<model::Fit> = None;
    let mut refined: Option<RefinedCorners> = None;
    for _ in 0..3 {
        let blur = before.as_ref().map_or([profile::FIRST_BLUR_PX; 2], |fit| fit.blur);
        let side = |k: usize| Side::sample(image, light, &corners, print, k, blur);
        let sides = [side(0)?, side(1)?, side(2)?, side(3)?];
        let fit = model::fit(&sides, before.as_ref())?;
        let lines = fit_lines(&sides, &fit)?;
        let crossed = cross(&sides, &lines)?;
        let moved = (0..4).map(|k| (crossed[k].0.0 - corners[k].0).norm()).fold(0.0, f64::max);
        corners = crossed.map(|corner| corner.0);
        refined = Some(RefinedCorners {
            corners_in_view: corners,
            deviations_px: crossed.map(|corner| corner.1),
            blur_px: fit.blur,
            white: fit.white,
            black: fit.black,
            misfit: fit.noise / (fit.white - fit.black),
        });
        // The first fit is a rough one.
        if before.is_some() && moved < STARTED_PX {
            break;
        }
        before = Some(fit);
    }
    let edges = refined.filter(|refined| is_near(&refined.corners_in_view, guess_in_view))?;
    let whole = match effort {
        Effort::Edges => None,
        Effort::WholePrint => by_whole_print(image, light, &edges, print, grain)
            .filter(|whole| is_near(&whole.corners_in_view, guess_in_view)),
    };
    Some(whole.unwrap_or_else(|| RefinedCorners {
        deviations_px: edges.deviations_px.map(|deviation| without_whole(deviation, &edges, print)),
        ..edges
    }))
}

/// What is fitted to find corners.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Effort {
    /// The four edges: enough to begin an alignment of the whole body from.
    Edges,
    /// The edges, then everything that is printed: many times the cost, for corners that are all
    /// there will be.
    #[default]
    WholePrint,
}

/// Edges alone say less than they seem to where the whole print does not fit: something hides a part
/// of it, or its cells are hardly wider than the blur.
fn without_whole(deviation: f64, edges: &RefinedCorners, print: &MarkerPrint) -> f64 {
    let corners = &edges.corners_in_view;
    let narrowest = (0..4)
        .map(|k| (corners[(k + 1) % 4].0 - corners[k].0).norm())
        .fold(f64::INFINITY, f64::min)
        / print.cells() as f64;
    let blur = edges.blur_px[0].max(edges.blur_px[1]);
    (2.0 * deviation).hypot(0.5 * (blur / narrowest).powi(2).min(1.0))
}

/// The corners by the whole print, which starts from those of the edges. `None` where it does not
/// fit.
fn by_whole_print(
    image: &LumaImage<'_>,
    light: &LinearLight,
    edges: &RefinedCorners,
    print: &MarkerPrint,
    grain: Grain,
) -> Option<RefinedCorners> {
    let start = State::new(&edges.corners_in_view, edges.blur_px, edges.white, edges.black)?;
    let fit = whole::fit(image, light, &start, print, grain)?;
    let misfit = fit.noise / (fit.white - fit.black);
    (0.0..=MAX_MISFIT).contains(&misfit).then_some(RefinedCorners {
        corners_in_view: fit.corners,
        deviations_px: fit.deviations.map(|deviation| deviation.hypot(FLOOR_PX)),
        blur_px: fit.blur,
        white: fit.white,
        black: fit.black,
        misfit: misfit.max(edges.misfit),
    })
}

/// Edges known to this are good enough to start from, pixels.
const STARTED_PX: f64 = 0.2;

/// Residuals that scatter by more of the contrast than this are no blurred print.
const MAX_MISFIT: f64 = 0.25;

/// No corner is believed better than this, pixels: the model of a lens is not perfect.
const FLOOR_PX: f64 = 0.003;

/// Moves each side of a black square to where the light falls most steeply within 2 px of it, in
/// steps of a quarter of a pixel: enough to read a marker whose contour was found, before anything
/// is known of its cells but how many there are along a side, border included.
///
/// `None` where the image ends, or the sides no longer cross.
pub fn approach_corners(
    image: &LumaImage<'_>,
    light: &LinearLight,
    guess_in_view: &[ViewPixel; 4],
    cells: usize,
) -> Option<[ViewPixel; 4]> {
    profile::approach(image, light, guess_in_view, cells)
}

/// The line along each side.
fn fit_lines(sides: &[Side; 4], fit: &model::Fit) -> Option<[EdgeLine; 4]> {
    let line = |k: usize| {
        let line = line::fit(&model::places(&sides[k], fit, k), fit.line_covariance(k))?;
        let blur = fit.blur[k % 2];
        Some(line.less_certain(crowding(blur, sides[k].border()).hypot(MODEL_SHARE * blur)))
    };
    Some([line(0)?, line(1)?, line(2)?, line(3)?])
}

/// An edge is where the model says to within this share of its blur: compression, sharpening and a
/// point spread that is no Gaussian shift it, for all profiles alike.
const MODEL_SHARE: f64 = 0.03;

/// How far off an edge may be because its neighbours (the border's inner edge, what lies beyond the
/// quiet zone) are blurred into it, pixels: it is not in the scatter, because all profiles share it.
/// Measured on drawn markers (`tests/corners.rs`) of 14 to 60 px.
fn crowding(blur: f64, border: f64) -> f64 {
    (blur / border).powf(3.5)
}

/// Corner k, where side k - 1 and side k cross, and its standard deviation in pixels.
fn cross(sides: &[Side; 4], lines: &[EdgeLine; 4]) -> Option<[(ViewPixel, f64); 4]> {
    let corner = |k: usize| {
        let before = (k + 3) % 4;
        line::cross((&sides[before], &lines[before]), (&sides[k], &lines[k]))
    };
    Some([corner(0)?, corner(1)?, corner(2)?, corner(3)?])
}

/// Whether the corners are still those that were meant.
fn is_near(corners: &[ViewPixel; 4], guess: &[ViewPixel; 4]) -> bool {
    let limit = 3.0 + 0.05 * mean_side_px(guess);
    corners.iter().zip(guess).all(|(a, b)| (a.0 - b.0).norm() <= limit)
        && SquareInView::new(corners).is_some()
}

/// The direction along side `k`, the one into the marker, the side's middle and half its length.
fn frame_of_side(
    corners: &[ViewPixel; 4],
    k: usize,
) -> (Vector2<f64>, Vector2<f64>, Vector2<f64>, f64) {
    let (from, to) = (corners[k].0, corners[(k + 1) % 4].0);
    let along = (to - from).normalize();
    (along, Vector2::new(-along.y, along.x), (from + to) / 2.0, (to - from).norm() / 2.0)
}
