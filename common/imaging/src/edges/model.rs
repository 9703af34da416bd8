//! The blurred print, fitted to the samples of all four sides at once.
//!
//! Along a profile the print changes from white to black at its edge e, and on at the depths D_j
//! behind it, by m_j of the way from black B to white W. Blurred by a Gaussian of standard
//! deviation s, the light at depth x is
//!
//! ```text
//! I(x) = B + (W - B) (1 + sum over j of m_j F((x - e - D_j)/s))
//! ```
//!
//! F is the Gaussian distribution function, ended at 3.6 standard deviations (`crate::gaussian`). The
//! edge of side k lies at e = offset + slope * along. Twelve unknowns: offset and slope of four sides,
//! the blur of two directions, W and B. They are found by Gauss-Newton with Cauchy weights.

use nalgebra::{Matrix2, SMatrix, SVector};

use super::line::Place;
use super::profile::{FIRST_BLUR_PX, Profile, Sample, Side};
use crate::gaussian::{Gaussian, REACH};

const UNKNOWNS: usize = 12;
const BLUR: usize = 8;
const WHITE: usize = 10;
const BLACK: usize = 11;

/// How far a fit is taken.
struct Care {
    /// At most so many steps.
    steps: usize,
    /// A step shorter than this is the last, pixels.
    converged_px: f64,
    /// Residuals that scatter by more of the contrast than this are no blurred print.
    max_misfit: f64,
}

/// Of the first fit, which only says where to look again.
const ROUGH: Care = Care { steps: 4, converged_px: 0.05, max_misfit: 0.35 };
const FINE: Care = Care { steps: 8, converged_px: 0.01, max_misfit: 0.25 };
/// Light that white must be above black, of nominal white.
const MIN_CONTRAST: f64 = 0.01;
/// Residuals up to so many standard deviations are believed.
const CAUCHY: f64 = 2.5;
/// Narrower blurs than this cannot be told from none, wider ones are no edge, pixels.
const BLUR_PX: std::ops::RangeInclusive<f64> = 0.3..=5.0;

type Normal = SMatrix<f64, UNKNOWNS, UNKNOWNS>;
type Unknowns = SVector<f64, UNKNOWNS>;

/// What was fitted to a marker's four sides.
#[derive(Debug)]
pub(super) struct Fit {
    unknowns: Unknowns,
    /// Blur of the first and third side, of the second and fourth, pixels.
    pub blur: [f64; 2],
    /// Light of the quiet zone.
    pub white: f64,
    /// Light of the border.
    pub black: f64,
    /// Robust standard deviation of the residuals, light.
    pub noise: f64,
    covariance: Normal,
}

impl Fit {
    /// Covariance of offset and slope of side `k`, from the normal matrix, pixels squared.
    pub(super) fn line_covariance(&self, k: usize) -> Matrix2<f64> {
        self.covariance.fixed_view::<2, 2>(2 * k, 2 * k).into_owned()
    }
}

/// The print at one sample: the share of white, and its derivatives by edge and blur.
struct Share {
    white: f64,
    by_edge: f64,
    by_blur: f64,
}

fn share(gaussian: Gaussian, profile: &Profile, depth: f64, edge: f64, blur: f64) -> Share {
    let mut share = Share { white: 1.0, by_edge: 0.0, by_blur: 0.0 };
    for change in &profile.changes {
        let at = (depth - edge - change.depth) / blur;
        if at > f64::from(REACH) || change.white == 0.0 {
            share.white += change.white;
            continue;
        }
        if at < -f64::from(REACH) {
            // This change and those behind it are out of sight.
            break;
        }
        let (density, below) = gaussian.at(at as f32);
        let (density, below) = (f64::from(density), f64::from(below));
        share.white += change.white * below;
        share.by_edge -= change.white * density / blur;
        share.by_blur -= change.white * density * at / blur;
    }
    share
}

/// Edge of side `k` at `along`.
fn edge(unknowns: &Unknowns, k: usize, along: f64) -> f64 {
    unknowns[2 * k] + unknowns[2 * k + 1] * along
}

/// Calls `see` with each sample of a profile that says something against the model: share of white,
/// and residual. Where the camera clipped and the model is above, there is nothing to say.
fn look(unknowns: &Unknowns, k: usize, profile: &Profile, mut see: impl FnMut(&Share, f64)) {
    let edge = edge(unknowns, k, profile.along);
    let blur = unknowns[BLUR + k % 2];
    let gaussian = Gaussian::get();
    for &Sample { depth, light, is_clipped } in &profile.samples {
        let share = share(gaussian, profile, depth, edge, blur);
        let model = unknowns[BLACK] + (unknowns[WHITE] - unknowns[BLACK]) * share.white;
        if !is_clipped || light > model {
            see(&share, light - model);
        }
    }
}

/// How much a residual counts (Cauchy).
fn weight(residual: f64, noise: f64) -> f64 {
    1.0 / (1.0 + (residual / (CAUCHY * noise)).powi(2))
}

/// Fits the model, roughly at first; `before` is where it starts, if there was a fit. `None` without
/// contrast, or where it does not fit.
pub(super) fn fit(sides: &[Side; 4], before: Option<&Fit>) -> Option<Fit> {
    let samples = || sides.iter().flat_map(|s| &s.profiles).flat_map(|p| &p.samples);
    let lights: Vec<f64> = samples().map(|sample| sample.light).collect();
    let (white, black) = (quantile(lights.clone(), 0.9)?, quantile(lights, 0.1)?);
    let contrast = white - black;
    if contrast < MIN_CONTRAST {
        return None;
    }
    let mut unknowns = Unknowns::zeros();
    let (first, mut noise) = match before {
        Some(fit) => ([fit.blur[0], fit.blur[1], fit.white, fit.black], fit.noise),
        None => ([FIRST_BLUR_PX, FIRST_BLUR_PX, white, black], 0.1 * contrast),
    };
    unknowns.fixed_rows_mut::<4>(BLUR).copy_from_slice(&first);
    let mut normal = Normal::zeros();
    let mut residuals = Vec::with_capacity(samples().count());
    let care = if before.is_some() { FINE } else { ROUGH };
    for _ in 0..care.steps {
        let (matrix, gradient) =
            normal_equations(sides, &unknowns, noise, (white, black), &mut residuals);
        let step = matrix.cholesky()?.solve(&gradient);
        apply(&mut unknowns, &step, contrast);
        normal = matrix;
        // Of the residuals before the step: the next one weighs by it.
        noise = noise_of(&mut residuals).max(0.003 * contrast);
        if step.fixed_rows::<BLUR>(0).amax() < care.converged_px {
            break;
        }
    }
    let (white, black) = (unknowns[WHITE], unknowns[BLACK]);
    if white - black < MIN_CONTRAST || noise > care.max_misfit * (white - black) {
        return None;
    }
    // Samples lie closer than pixels, and pixels of a magnified or blurred image closer than what
    // they say anew: each says the same as its neighbours within about the blur.
    let alike = unknowns[BLUR].max(1.0) * unknowns[BLUR + 1].max(1.0);
    let density = (sides.iter().map(samples_per_pixel).fold(0.0, f64::max) * alike).max(1.0);
    Some(Fit {
        blur: [unknowns[BLUR], unknowns[BLUR + 1]],
        white,
        black,
        noise,
        covariance: normal.cholesky()?.inverse() * (noise * noise * density),
        unknowns,
    })
}

pub(super) fn quantile(mut values: Vec<f64>, share: f64) -> Option<f64> {
    let last = values.len().checked_sub(1)?;
    let at = (share * last as f64).round() as usize;
    Some(*values.select_nth_unstable_by(at, f64::total_cmp).1)
}

/// Normal matrix and gradient of one Gauss-Newton step; the residuals' sizes are put in `sizes`.
fn normal_equations(
    sides: &[Side; 4],
    unknowns: &Unknowns,
    noise: f64,
    (first_white, first_black): (f64, f64),
    sizes: &mut Vec<f64>,
) -> (Normal, Unknowns) {
    sizes.clear();
    let mut matrix = Normal::zeros();
    let mut gradient = Unknowns::zeros();
    let (white, black) = (unknowns[WHITE], unknowns[BLACK]);
    for (k, side) in sides.iter().enumerate() {
        for profile in &side.profiles {
            // Rows: edge, blur, white, black.
            let mut local = SMatrix::<f64, 4, 4>::zeros();
            let mut right = SVector::<f64, 4>::zeros();
            look(unknowns, k, profile, |share, residual| {
                sizes.push(residual.abs());
                let row = SVector::<f64, 4>::new(
                    (white - black) * share.by_edge,
                    (white - black) * share.by_blur,
                    share.white,
                    1.0 - share.white,
                );
                let weighted = row * weight(residual, noise);
                local += weighted * row.transpose();
                right += weighted * residual;
            });
            let places = [
                (2 * k, 0, 1.0),
                (2 * k + 1, 0, profile.along),
                (BLUR + k % 2, 1, 1.0),
                (WHITE, 2, 1.0),
                (BLACK, 3, 1.0),
            ];
            for (row, a, by_row) in places {
                gradient[row] += by_row * right[a];
                for (column, b, by_column) in places {
                    matrix[(row, column)] += by_row * by_column * local[(a, b)];
                }
            }
        }
    }
    // Priors of about a sample's weight: they speak only where the samples are silent (all white
    // clipped, an edge too short for its turn).
    let contrast = first_white - first_black;
    let mut hold = |index: usize, deviation: f64, residual: f64| {
        let weight = (noise / deviation).powi(2);
        matrix[(index, index)] += weight;
        gradient[index] += weight * residual;
    };
    for index in 0..BLUR {
        hold(index, 1.0, -unknowns[index]);
    }
    hold(BLUR, 1.0, 0.0);
    hold(BLUR + 1, 1.0, 0.0);
    hold(WHITE, 0.5 * contrast, first_white - white);
    hold(BLACK, 0.5 * contrast, first_black - black);
    (matrix, gradient)
}

/// Takes a step, no longer than the model is linear.
fn apply(unknowns: &mut Unknowns, step: &Unknowns, contrast: f64) {
    for index in 0..BLUR {
        unknowns[index] += step[index].clamp(-0.8, 0.8);
    }
    for index in [BLUR, BLUR + 1] {
        let blur = unknowns[index];
        unknowns[index] = (blur + step[index].clamp(-0.4 * blur, 0.4 * blur))
            .clamp(*BLUR_PX.start(), *BLUR_PX.end());
    }
    for index in [WHITE, BLACK] {
        unknowns[index] += step[index].clamp(-0.5 * contrast, 0.5 * contrast);
    }
}

/// Robust standard deviation of residuals, given their sizes.
fn noise_of(sizes: &mut [f64]) -> f64 {
    let middle = sizes.len() / 2;
    if sizes.is_empty() {
        return 0.0;
    }
    1.4826 * *sizes.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Samples for each pixel of the area that they cover.
fn samples_per_pixel(side: &Side) -> f64 {
    let (Some(first), Some(last)) = (side.profiles.first(), side.profiles.last()) else {
        return 1.0;
    };
    let length = (last.along - first.along) * side.half;
    side.profiles.len() as f64 / (length + 1.0) / side.step
}

/// Where each profile of side `k` sees the edge, the blur and the levels being what was fitted.
pub(super) fn places(side: &Side, fit: &Fit, k: usize) -> Vec<Place> {
    let contrast = fit.white - fit.black;
    let places = side.profiles.iter().filter_map(|profile| {
        let (mut information, mut right) = (0.0, 0.0);
        look(&fit.unknowns, k, profile, |share, residual| {
            let slope = contrast * share.by_edge;
            let weight = weight(residual, fit.noise);
            information += weight * slope * slope;
            right += weight * slope * residual;
        });
        // A profile whose contrast is gone says nothing of the edge.
        let least = 0.02 * contrast * contrast / fit.blur[k % 2];
        (information > least).then(|| Place {
            along: profile.along,
            depth: edge(&fit.unknowns, k, profile.along) + (right / information).clamp(-2.0, 2.0),
            weight: information,
        })
    });
    places.collect()
}
