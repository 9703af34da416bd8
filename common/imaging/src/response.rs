//! The curve from light to code values, from pictures of one scene at several exposures.
//!
//! A place of the scene that has code z in a picture exposed for t seconds has the radiance f(z)/t,
//! where f gives the light of a code. Its logarithm g = ln f is found for all codes at once, by
//! least squares over many places:
//!
//! ```text
//! g(z of place p in picture k) = ln E_p + ln t_k
//! ```
//!
//! The radiances E_p are eliminated. Between the observed codes, and beyond them, the curve
//! continues like a power of the code: z^2 g''(z), which is constant for a power, changes slowly.
//!
//! Source: P. Debevec and J. Malik, Recovering high dynamic range radiance maps from photographs
//! (1997), with the penalty above in place of that on g''.

use nalgebra::{DMatrix, DVector};
use thiserror::Error;

use crate::image::LumaImage;
use crate::light::LinearLight;

/// Least number of pictures for a curve.
pub const MIN_PICTURES: usize = 3;
/// Least ratio between the longest and the shortest exposure.
pub const MIN_RANGE: f64 = 3.0;
/// Least number of places for a curve.
pub const MIN_PLACES: usize = 200;

/// Codes outside these may be clipped.
const CODES: std::ops::RangeInclusive<u8> = 3..=251;
/// Largest difference between the nine pixels of an even place, code values, in its best exposure.
const EVEN_CODES: u8 = 12;
/// Number of code ranges for even places, and places used from each.
const RANGES: usize = 64;
const PLACES_OF_RANGE: usize = 40;
/// Distance between tested places, pixels.
const STRIDE_PX: usize = 3;
/// Weight of the penalty, relative to that of one place.
const STIFFNESS: f64 = 0.02;
/// Code whose light is fixed, because only ratios of light can be measured.
const ANCHOR: usize = 128;
/// Scale of Cauchy's weight function, standard deviations.
const CAUCHY: f64 = 2.5;
/// Largest fall of light from a code to a brighter one that noise may cause.
const FALL: f64 = 0.02;
/// Least rise of light from a code to the next.
const LEAST_RISE: f32 = 1e-4;

/// A picture with its exposure.
#[derive(Debug, Clone, Copy)]
pub struct Exposure<'a> {
    /// The picture.
    pub image: LumaImage<'a>,
    /// Exposure time, seconds or any other unit.
    pub seconds: f64,
}

/// Reason why a series of pictures does not determine the curve.
#[allow(missing_docs, reason = "the messages say what each is")]
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ResponseError {
    #[error(
        "{given} pictures; {MIN_PICTURES} or more are needed, of one scene at different exposures"
    )]
    Pictures { given: usize },
    #[error("picture {index} was exposed for {seconds} s; it must be above 0")]
    Seconds { index: usize, seconds: f64 },
    #[error(
        "picture {index} has {given:?} px, the first one {first:?}. Give pictures of one camera, all of one size"
    )]
    Size { index: usize, given: (usize, usize), first: (usize, usize) },
    #[error(
        "the longest exposure is {ratio:.2} times the shortest; {MIN_RANGE} times or more are needed"
    )]
    Range { ratio: f64 },
    #[error(
        "{found} even places of different greys are neither black nor white in two pictures; {MIN_PLACES} are needed. Photograph \
         something with even areas of many greys, from a tripod"
    )]
    Places { found: usize },
    #[error(
        "the pictures do not determine the curve. Photograph more greys, at exposures that are nearer to each other"
    )]
    Undetermined,
    #[error(
        "code {code} stands for less light than the one before it. Were the exposures as given, with everything automatic off?"
    )]
    Falling { code: u8 },
}

/// A measured curve.
#[derive(Debug, Clone)]
pub struct FittedResponse {
    /// The light of each code; that of code 255 is 1.
    pub light: LinearLight,
    /// Relative standard deviation of the light of each code, apart from that of code 128.
    pub deviations: Vec<f64>,
    /// The darkest and the brightest observed code. Beyond them the curve is extrapolated.
    pub seen: (u8, u8),
    /// Standard deviation of the residuals, as a share of light.
    pub residual: f64,
    /// Places that were used.
    pub places: usize,
    /// Apparent shift of edges by this curve because of noise, pixels, from the curves of either
    /// half of the places. `None` where a half alone does not determine the curve.
    pub edge_shift_px: Option<f64>,
}

/// Codes of a place that are neither black nor white, with the logarithms of their exposures.
type Place = Vec<(f64, f64)>;

/// Computes the curve of the camera from pictures of one scene, taken from a tripod.
pub fn fit_response(series: &[Exposure<'_>]) -> Result<FittedResponse, ResponseError> {
    let places = places(series)?;
    let fitted = fit_places(&places)?;
    let half = |first: usize| {
        let places: Vec<Place> = places.iter().skip(first).step_by(2).cloned().collect();
        fit_places(&places).ok()
    };
    // The error of a half has sqrt 2 times the deviation of the whole, the difference of the halves
    // twice.
    let apart_px = |(one, other): (FittedResponse, FittedResponse)| {
        edge_shift_px(&one.light, &other.light).abs() / 2.0
    };
    Ok(FittedResponse { edge_shift_px: half(0).zip(half(1)).map(apart_px), ..fitted })
}

/// Apparent shift of an edge between print and paper, blurred by 0.9 px, if light is taken for
/// `assumed` and is `actual`, pixels. Positive: white appears wider.
pub fn edge_shift_px(assumed: &LinearLight, actual: &LinearLight) -> f64 {
    const BLUR_PX: f64 = 0.9;
    const STEP_PX: f64 = 0.02;
    let (black, white) = (0.03, 0.6);
    let seen = |light: f64| assumed.between(actual.code_of(light));
    let (seen_black, seen_white) = (seen(black), seen(white));
    // Area between the apparent and the actual edge, both from 0 to 1.
    (-250..250)
        .map(|step| {
            let at = (f64::from(step) + 0.5) * STEP_PX;
            let (_, below) = crate::gaussian::density_and_distribution(at / BLUR_PX);
            let light = black + (white - black) * below;
            ((seen(light) - seen_black) / (seen_white - seen_black) - below) * STEP_PX
        })
        .sum()
}

fn places(series: &[Exposure<'_>]) -> Result<Vec<Place>, ResponseError> {
    let [first, ..] = series else { return Err(ResponseError::Pictures { given: 0 }) };
    if series.len() < MIN_PICTURES {
        return Err(ResponseError::Pictures { given: series.len() });
    }
    let size = |exposure: &Exposure<'_>| (exposure.image.width(), exposure.image.height());
    for (index, exposure) in series.iter().enumerate() {
        let seconds = exposure.seconds;
        if !(seconds > 0.0 && seconds.is_finite()) {
            return Err(ResponseError::Seconds { index, seconds });
        }
        if size(exposure) != size(first) {
            return Err(ResponseError::Size { index, given: size(exposure), first: size(first) });
        }
    }
    let seconds = || series.iter().map(|exposure| exposure.seconds);
    let ratio = seconds().fold(0.0, f64::max) / seconds().fold(f64::INFINITY, f64::min);
    if ratio < MIN_RANGE {
        return Err(ResponseError::Range { ratio });
    }
    let (width, height) = size(first);
    let mut taken = [0; RANGES];
    let mut places = Vec::new();
    // The step is prime to most sizes, so that no part of the scene is preferred.
    let (columns, rows) =
        (width.saturating_sub(2) / STRIDE_PX, height.saturating_sub(2) / STRIDE_PX);
    let count = columns * rows;
    for k in 0..count {
        let index = (k * 7919) % count;
        let (x, y) = (1 + STRIDE_PX * (index % columns), 1 + STRIDE_PX * (index / columns));
        let seen: Vec<(f64, u8, f64)> = series
            .iter()
            .filter_map(|exposure| {
                let (mean, codes) = around(&exposure.image, x, y);
                let is_seen = CODES.contains(codes.start()) && CODES.contains(codes.end());
                is_seen.then(|| (mean, codes.end() - codes.start(), exposure.seconds.ln()))
            })
            .collect();
        let best = seen.iter().min_by(|a, b| (a.0 - 128.0).abs().total_cmp(&(b.0 - 128.0).abs()));
        let Some(&(code, spread, _)) = best else { continue };
        let range = (code as usize * RANGES / 256).min(RANGES - 1);
        // Two pictures with one exposure add no information.
        let is_tied = seen.iter().any(|at| (at.2 - seen[0].2).abs() > 1e-6);
        if is_tied && spread <= EVEN_CODES && taken[range] < PLACES_OF_RANGE {
            taken[range] += 1;
            places.push(seen.into_iter().map(|(mean, _, log)| (mean, log)).collect());
        }
    }
    if places.len() < MIN_PLACES {
        return Err(ResponseError::Places { found: places.len() });
    }
    Ok(places)
}

/// Mean of the nine pixels around one, and the least and the largest of them.
fn around(image: &LumaImage<'_>, x: usize, y: usize) -> (f64, std::ops::RangeInclusive<u8>) {
    let (mut sum, mut least, mut most) = (0u32, u8::MAX, 0);
    for row in y - 1..=y + 1 {
        for &code in &image.row(row)[x - 1..=x + 1] {
            sum += u32::from(code);
            least = least.min(code);
            most = most.max(code);
        }
    }
    (f64::from(sum) / 9.0, least..=most)
}

/// Weight of a code: the middle ones are neither noisy nor clipped.
fn trust(code: f64) -> f64 {
    (code.min(255.0 - code) / 127.5).max(0.02)
}

fn fit_places(places: &[Place]) -> Result<FittedResponse, ResponseError> {
    let mut logs = DVector::<f64>::zeros(256);
    let mut deviation = 0.05;
    let mut inverse = DMatrix::<f64>::zeros(256, 256);
    for round in 0..6 {
        let (mut normal, mut right) = (DMatrix::zeros(256, 256), DVector::zeros(256));
        add_penalty(&mut normal);
        let mut residuals: Vec<f64> = Vec::new();
        for place in places {
            let value = |code: f64| {
                let (below, share) = (code as usize, code.fract());
                logs[below] * (1.0 - share) + logs[below + 1] * share
            };
            let mean = |of: &dyn Fn(f64, f64) -> f64| {
                let (mut sum, mut weights) = (0.0, 0.0);
                for &(code, log) in place {
                    sum += trust(code) * of(code, log);
                    weights += trust(code);
                }
                sum / weights
            };
            let radiance = mean(&|code, log| value(code) - log);
            let weight = |code: f64, log: f64| {
                let residual = value(code) - log - radiance;
                // The first round has no curve yet.
                let doubt = if round == 0 { 0.0 } else { residual / (CAUCHY * deviation) };
                trust(code) / (1.0 + doubt * doubt)
            };
            residuals.extend(place.iter().map(|&(code, log)| (value(code) - log - radiance).abs()));
            add_place(&mut normal, &mut right, place, weight);
        }
        if round > 0 {
            let middle = residuals.len() / 2;
            // Each place has used one value for its radiance.
            let freedom = 1.0 - places.len() as f64 / residuals.len() as f64;
            let median = *residuals.select_nth_unstable_by(middle, f64::total_cmp).1;
            deviation = (1.4826 * median / freedom.sqrt()).max(1e-4);
        }
        let Some(solved) = normal.cholesky() else {
            return Err(ResponseError::Undetermined);
        };
        logs = solved.solve(&right);
        inverse = solved.inverse();
    }
    let codes = || places.iter().flatten().map(|&(code, _)| code);
    let seen = (codes().fold(255.0, f64::min) as u8, codes().fold(0.0, f64::max).ceil() as u8);
    let mut table = [0.0f32; 256];
    for code in 1..=255usize {
        let light = (logs[code] - logs[255]).exp() as f32;
        let is_seen = (seen.0..=seen.1).contains(&(code as u8));
        if is_seen && light < table[code - 1] * (1.0 - FALL as f32) {
            return Err(ResponseError::Falling { code: code as u8 });
        }
        // Each code has a little more light than the one before it.
        table[code] = light.max(table[code - 1] * (1.0 + LEAST_RISE));
    }
    let brightest = table[255];
    let light = LinearLight::from_table(table.map(|light| light / brightest))
        .map_err(|_| ResponseError::Falling { code: u8::MAX })?;
    let deviations =
        (0..256).map(|code| deviation * inverse[(code, code)].max(0.0).sqrt()).collect();
    let (residual, places) = (deviation, places.len());
    Ok(FittedResponse { light, deviations, seen, residual, places, edge_shift_px: None })
}

/// Adds a place whose radiance is eliminated.
fn add_place(
    normal: &mut DMatrix<f64>,
    right: &mut DVector<f64>,
    place: &Place,
    weight: impl Fn(f64, f64) -> f64,
) {
    let weights: Vec<f64> = place.iter().map(|&(code, log)| weight(code, log)).collect();
    let total: f64 = weights.iter().sum();
    let mean_log = place.iter().zip(&weights).map(|(at, w)| at.1 * w).sum::<f64>() / total;
    // The mean row of the place, as (code, share of it).
    let shares = |code: f64| {
        let (below, share) = (code as usize, code.fract());
        [(below, 1.0 - share), (below + 1, share)]
    };
    let mean_row: Vec<(usize, f64)> = place
        .iter()
        .zip(&weights)
        .flat_map(|(&(code, _), w)| shares(code).map(|(at, share)| (at, share * w / total)))
        .collect();
    for (&(code, log), w) in place.iter().zip(&weights) {
        let row: Vec<(usize, f64)> = shares(code)
            .into_iter()
            .chain(mean_row.iter().map(|&(at, share)| (at, -share)))
            .collect();
        for &(a, by_a) in &row {
            for &(b, by_b) in &row {
                normal[(a, b)] += w * by_a * by_b;
            }
            right[a] += w * by_a * (log - mean_log);
        }
    }
}

/// Adds the penalty, which determines the curve where no places are.
fn add_penalty(normal: &mut DMatrix<f64>) {
    // z^2 g''(z), as weights of three codes.
    let bend = |z: usize| {
        let square = (z * z) as f64;
        [(z - 1, square), (z, -2.0 * square), (z + 1, square)]
    };
    for z in 1..254 {
        let row = bend(z).map(|(at, by)| (at, -by)).into_iter().chain(bend(z + 1));
        let row: Vec<(usize, f64)> = row.collect();
        for &(a, by_a) in &row {
            for &(b, by_b) in &row {
                normal[(a, b)] += STIFFNESS * by_a * by_b;
            }
        }
    }
    normal[(ANCHOR, ANCHOR)] += 1e6;
    // No place has the code of black, so its value is arbitrary.
    normal[(0, 0)] += 1e-6;
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use crate::light::{CodeRange, TransferCurve};

    /// A scene of even greys in patches of 12 px, at several exposures, as a camera with this curve
    /// sees it.
    fn series(actual: &LinearLight, noise: f64) -> Vec<(Vec<u8>, f64)> {
        let mut state = 88172645463325252u64;
        let mut dice = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1u64 << 53) as f64
        };
        let patches: Vec<f64> = (0..400).map(|_| (-5.0 * dice()).exp()).collect();
        [1.0, 2.0, 4.0, 8.0, 16.0]
            .into_iter()
            .map(|seconds| {
                let pixels = (0..240 * 240).map(|k| {
                    let patch = patches[k % 240 / 12 + k / 240 / 12 * 20];
                    let light = 0.2 * patch * seconds;
                    let noisy = light + noise * (0.02 + light).sqrt() * (dice() + dice() - 1.0);
                    actual.code_of(noisy).round() as u8
                });
                (pixels.collect(), seconds)
            })
            .collect()
    }

    fn exposures(series: &[(Vec<u8>, f64)]) -> Vec<Exposure<'_>> {
        let image = |pixels| LumaImage::new(pixels, 240, 240, 240).unwrap();
        series
            .iter()
            .map(|(pixels, seconds)| Exposure { image: image(pixels), seconds: *seconds })
            .collect()
    }

    fn curve(curve: TransferCurve) -> LinearLight {
        LinearLight::new(curve, CodeRange::Full).unwrap()
    }

    #[test]
    fn a_curve_is_found_within_its_deviations() {
        for actual in [
            curve(TransferCurve::Gamma(1.8)),
            curve(TransferCurve::Srgb),
            curve(TransferCurve::Linear),
        ] {
            let pictures = series(&actual, 0.02);
            let found = fit_response(&exposures(&pictures)).unwrap();
            let ratio = |code: u8| {
                f64::from(found.light.of(code) / found.light.of(128))
                    / f64::from(actual.of(code) / actual.of(128))
            };
            let mut beyond = 0;
            for code in 30..=240u8 {
                assert!((ratio(code) - 1.0).abs() < 0.05, "{code}: {}", ratio(code));
                let stated = found.deviations[usize::from(code)].max(1e-3);
                beyond += u32::from((ratio(code) - 1.0).abs() > 3.0 * stated);
            }
            assert!(beyond < 20, "{beyond} of 211 codes");
            let shift_px = edge_shift_px(&found.light, &actual);
            assert!(found.edge_shift_px.unwrap() < 0.01, "{:?}", found.edge_shift_px);
            assert!(shift_px.abs() < 0.015, "{shift_px}");
        }
    }

    #[test]
    fn an_edge_moves_as_much_as_the_curves_differ() {
        let (srgb, linear) = (curve(TransferCurve::Srgb), curve(TransferCurve::Linear));
        let shift_px = edge_shift_px(&srgb, &srgb);
        assert!(shift_px.abs() < 0.001, "{shift_px}");
        // Codes of a camera with a root curve, taken for light, lift what is dark: white seems
        // wider.
        assert!(edge_shift_px(&linear, &srgb) > 0.2);
        assert!(edge_shift_px(&srgb, &linear) < -0.2);
    }

    #[test]
    fn series_that_do_not_tell_are_refused() {
        let pictures = series(&curve(TransferCurve::Srgb), 0.01);
        let all = exposures(&pictures);
        let error = |series: &[Exposure<'_>]| fit_response(series).unwrap_err();
        assert_eq!(error(&all[..2]), ResponseError::Pictures { given: 2 });
        let mut wrong = all.clone();
        wrong[1].seconds = -1.0;
        assert_eq!(error(&wrong), ResponseError::Seconds { index: 1, seconds: -1.0 });
        wrong.iter_mut().for_each(|exposure| exposure.seconds = 1.0);
        assert_eq!(error(&wrong), ResponseError::Range { ratio: 1.0 });
        let black = vec![0; 240 * 240];
        let image = LumaImage::new(&black, 240, 240, 240).unwrap();
        wrong = all.iter().map(|exposure| Exposure { image, ..*exposure }).collect();
        assert_eq!(error(&wrong), ResponseError::Places { found: 0 });
        // The exposures in the wrong order.
        wrong = all.clone();
        let seconds: Vec<f64> = all.iter().rev().map(|exposure| exposure.seconds).collect();
        wrong.iter_mut().zip(seconds).for_each(|(exposure, seconds)| exposure.seconds = seconds);
        assert!(matches!(error(&wrong), ResponseError::Falling { .. }));
        // Only the first one is neither black nor white, and the others are the same.
        let same = [all[0], all[0], all[0], Exposure { image, ..all[4] }];
        assert_eq!(error(&same), ResponseError::Places { found: 0 });
        let tiny = LumaImage::new(&black, 2, 2, 2).unwrap();
        wrong = all.iter().map(|exposure| Exposure { image: tiny, ..*exposure }).collect();
        assert_eq!(error(&wrong), ResponseError::Places { found: 0 });
    }
}
