//! Fits the blurred print to the samples of all four sides at once.
//!
//! Along a profile, the print changes from white to black at its edge e. At the depths D_j behind
//! the edge it changes by m_j of the way from black B to white W. Blurred by a Gaussian of standard
//! deviation s, the radiance at depth x is
//!
//! ```text
//! I(x) = B + (W - B) (1 + sum over j of m_j F((x - e - D_j)/s))
//! ```
//!
//! F is the Gaussian distribution function, truncated at 3.6 standard deviations
//! (`crate::gaussian`). The edge of side k lies at e = offset + slope * along. There are twelve
//! unknowns: offset and slope of four sides, the blur of two directions, W and B. They are found by
//! Gauss-Newton with Cauchy weights.

use nalgebra::{Matrix2, SMatrix, SVector};

use super::line::EdgePoint;
use super::profile::{EdgeProfile, FIRST_BLUR_PX, ProfileSample, Side};
use crate::gaussian::{Gaussian, REACH};

const UNKNOWNS: usize = 12;
const BLUR: usize = 8;
const WHITE: usize = 10;
const BLACK: usize = 11;

// Limits of the first fit, which only gives the places of samples, then those of later fits.

/// Most steps.
const MAX_STEPS: [usize; 2] = [4, 8];
/// Length below which a step is the last, pixels.
const CONVERGED_PX: [f64; 2] = [0.05, 0.01];
/// Largest residual sigma of an accepted fit, as a share of the contrast.
const MAX_RESIDUAL_SIGMA: [f64; 2] = [0.35, 0.25];

/// Least radiance of white above black, share of nominal white.
const MIN_CONTRAST: f64 = 0.01;
/// Scale of Cauchy's weight function, standard deviations.
const CAUCHY: f64 = 2.5;
/// Limits of the blur, pixels. A narrower one has no effect, and a wider one leaves no edge.
const BLUR_PX: std::ops::RangeInclusive<f64> = 0.3..=5.0;

type Normal = SMatrix<f64, UNKNOWNS, UNKNOWNS>;
type Unknowns = SVector<f64, UNKNOWNS>;

/// The fit to a marker's four sides.
#[derive(Debug)]
pub(super) struct EdgeFit {
    unknowns: Unknowns,
    /// Blur of the first and third side, then of the second and fourth, pixels.
    pub blur: [f64; 2],
    /// Radiance of the quiet zone.
    pub white: f64,
    /// Radiance of the border.
    pub black: f64,
    /// Robust standard deviation of the residuals, radiance.
    pub noise: f64,
    covariance: Normal,
}

impl EdgeFit {
    /// Covariance of the offset and slope of side `k`, from the normal matrix, pixels squared.
    pub(super) fn line_covariance(&self, k: usize) -> Matrix2<f64> {
        self.covariance.fixed_view::<2, 2>(2 * k, 2 * k).into_owned()
    }
}

/// Share of white at one sample, and its derivatives by the edge's position and by the blur.
pub(super) struct PrintShare {
    pub white: f64,
    by_edge: f64,
    by_blur: f64,
}

/// Share of white of the print at `depth` of a profile, pixels, if its edge is at `edge`.
pub(super) fn share(
    gaussian: Gaussian,
    profile: &EdgeProfile,
    depth: f64,
    edge: f64,
    blur: f64,
) -> PrintShare {
    let mut share = PrintShare { white: 1.0, by_edge: 0.0, by_blur: 0.0 };
    for change in &profile.changes {
        let at = (depth - edge - change.depth) / blur;
        if at > f64::from(REACH) || change.white == 0.0 {
            share.white += change.white;
            continue;
        }
        if at < -f64::from(REACH) {
            // This change and those behind it are out of reach.
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

/// Position of the edge of side `k` at `along`.
fn edge(unknowns: &Unknowns, k: usize, along: f64) -> f64 {
    unknowns[2 * k] + unknowns[2 * k + 1] * along
}

/// Calls `visit` with share and residual of each sample of a profile. Clipped samples below the
/// model are left out, because the true radiance may be higher.
fn visit_samples(
    unknowns: &Unknowns,
    k: usize,
    profile: &EdgeProfile,
    mut visit: impl FnMut(&PrintShare, f64),
) {
    let edge = edge(unknowns, k, profile.along);
    let blur = unknowns[BLUR + k % 2];
    let gaussian = Gaussian::get();
    for &ProfileSample { depth, radiance, is_clipped } in &profile.samples {
        let share = share(gaussian, profile, depth, edge, blur);
        let model = unknowns[BLACK] + (unknowns[WHITE] - unknowns[BLACK]) * share.white;
        if !is_clipped || radiance > model {
            visit(&share, radiance - model);
        }
    }
}

/// Cauchy's weight of a residual.
fn weight(residual: f64, noise: f64) -> f64 {
    1.0 / (1.0 + (residual / (CAUCHY * noise)).powi(2))
}

/// Fits the model: coarsely without a fit `before`, and else starting from it. `None` without
/// contrast, or where the model does not fit.
pub(super) fn fit(sides: &[Side; 4], before: Option<&EdgeFit>) -> Option<EdgeFit> {
    let samples = || sides.iter().flat_map(|s| &s.profiles).flat_map(|p| &p.samples);
    let radiances: Vec<f64> = samples().map(|sample| sample.radiance).collect();
    let (white, black) = (quantile(radiances.clone(), 0.9)?, quantile(radiances, 0.1)?);
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
    let stage = usize::from(before.is_some());
    for _ in 0..MAX_STEPS[stage] {
        let (matrix, gradient) =
            normal_equations(sides, &unknowns, noise, (white, black), &mut residuals);
        let step = matrix.cholesky()?.solve(&gradient);
        apply(&mut unknowns, &step, contrast);
        normal = matrix;
        // Noise from the residuals before the step, for the weights of the next one.
        noise = noise_of(&mut residuals).max(0.003 * contrast);
        if step.fixed_rows::<BLUR>(0).amax() < CONVERGED_PX[stage] {
            break;
        }
    }
    let (white, black) = (unknowns[WHITE], unknowns[BLACK]);
    if white - black < MIN_CONTRAST || noise > MAX_RESIDUAL_SIGMA[stage] * (white - black) {
        return None;
    }
    // Samples are denser than pixels, and pixels of a blurred image depend on their neighbours
    // within about the blur. This is the number of samples with the information of one independent
    // sample.
    let dependent = unknowns[BLUR].max(1.0) * unknowns[BLUR + 1].max(1.0);
    let density = (sides.iter().map(samples_per_pixel).fold(0.0, f64::max) * dependent).max(1.0);
    Some(EdgeFit {
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

/// Normal matrix and gradient of one Gauss-Newton step. Writes the absolute residuals to `sizes`.
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
            visit_samples(unknowns, k, profile, |share, residual| {
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
    // Priors of about one sample's weight. They matter only where samples determine nothing: all
    // white clipped, or an edge too short for its slope.
    let contrast = first_white - first_black;
    let mut hold = |index: usize, sigma: f64, residual: f64| {
        let weight = (noise / sigma).powi(2);
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

/// Applies a step, limited to the range in which the model is about linear.
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

/// Robust standard deviation of residuals, from their absolute values.
fn noise_of(sizes: &mut [f64]) -> f64 {
    let middle = sizes.len() / 2;
    if sizes.is_empty() {
        return 0.0;
    }
    1.4826 * *sizes.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Number of samples per pixel of the covered area.
fn samples_per_pixel(side: &Side) -> f64 {
    let (Some(first), Some(last)) = (side.profiles.first(), side.profiles.last()) else {
        return 1.0;
    };
    let length = (last.along - first.along) * side.frame.half;
    side.profiles.len() as f64 / (length + 1.0) / side.step
}

/// Position of the edge in each profile of side `k`, with the fitted blur, white and black.
pub(super) fn places(side: &Side, fit: &EdgeFit, k: usize) -> Vec<EdgePoint> {
    let contrast = fit.white - fit.black;
    let places = side.profiles.iter().filter_map(|profile| {
        let (mut information, mut right) = (0.0, 0.0);
        visit_samples(&fit.unknowns, k, profile, |share, residual| {
            let slope = contrast * share.by_edge;
            let weight = weight(residual, fit.noise);
            information += weight * slope * slope;
            right += weight * slope * residual;
        });
        // A profile without contrast does not determine the edge.
        let least = 0.02 * contrast * contrast / fit.blur[k % 2];
        (information > least).then(|| EdgePoint {
            along: profile.along,
            depth: edge(&fit.unknowns, k, profile.along) + (right / information).clamp(-2.0, 2.0),
            weight: information,
        })
    });
    places.collect()
}
