//! Agreement of a template with a canonical picture at each shift.
//!
//! The pattern is correlated with the radiance facet by facet, for any light and noise of a facet.
//! The score is the log of a likelihood ratio, like the evidence, without the factor for dependent
//! values.

use super::canvas::{Canvas, REACH_CELLS};
use super::templates::{Template, TemplatePixel};

/// Number of tested shifts along an axis: every second one.
const COARSE: usize = REACH_CELLS + 1;
/// Number of fine shifts along each axis, next to a coarse one.
const FINE: usize = 3;
/// Largest squared correlation that counts: a facet with three samples may fit perfectly.
const MOST: f32 = 0.98;
/// Added to sums of squares, to avoid a division by zero for black.
const TINY: f32 = 1e-9;

/// The best of every second shift, and its score.
pub(super) fn best_shift(template: &Template, canvas: &Canvas) -> (f32, [usize; 2]) {
    let mut best = (0.0, [0, 0]);
    for down in (0..=2 * REACH_CELLS).step_by(2) {
        let scores: [f32; COARSE] = rate(template, |sample| {
            let at = sample.at_parted as usize + down * canvas.side;
            canvas.parted.each_ref().map(|plane| &plane[at..])
        });
        keep_best(&mut best, &scores, |k| [2 * k, down]);
    }
    best
}

/// The best shift beside this one, or itself, and its score.
pub(super) fn best_beside(
    template: &Template,
    canvas: &Canvas,
    [right, down]: [usize; 2],
) -> (f32, [usize; 2]) {
    let mut best = (0.0, [right, down]);
    let first = right.saturating_sub(1);
    for down in down.saturating_sub(1)..=(down + 1).min(2 * REACH_CELLS) {
        let scores: [f32; FINE] = rate(template, |sample| {
            let at = sample.at as usize + down * canvas.side + first;
            [&canvas.radiance[at..], &canvas.square[at..]]
        });
        keep_best(&mut best, &scores, |k| [first + k, down]);
    }
    best
}

fn keep_best(best: &mut (f32, [usize; 2]), scores: &[f32], shift: impl Fn(usize) -> [usize; 2]) {
    for (k, &score) in scores.iter().enumerate() {
        if score > best.0 {
            *best = (score, shift(k));
        }
    }
}

/// The scores of `N` shifts. `at` gives radiance and its square from a sample on, by shift.
#[inline]
fn rate<'c, const N: usize>(
    template: &Template,
    at: impl Fn(&TemplatePixel) -> [&'c [f32]; 2],
) -> [f32; N] {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma") {
        // SAFETY: the line above has checked that the processor has AVX2 and FMA.
        return unsafe { rate_avx2(template, at) };
    }
    rate_any(template, at)
}

/// The portable code, compiled for wider registers.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn rate_avx2<'c, const N: usize>(
    template: &Template,
    at: impl Fn(&TemplatePixel) -> [&'c [f32]; 2],
) -> [f32; N] {
    rate_any(template, at)
}

#[inline(always)]
fn rate_any<'c, const N: usize>(
    template: &Template,
    at: impl Fn(&TemplatePixel) -> [&'c [f32]; 2],
) -> [f32; N] {
    let mut scores = [0.0; N];
    for (range, weight) in &template.facets {
        let (mut sum, mut squares, mut agreement) = ([0f32; N], [0f32; N], [0f32; N]);
        for sample in &template.samples[range.clone()] {
            let [radiance, square] = at(sample);
            let (radiance, square) = (&radiance[..N], &square[..N]);
            for k in 0..N {
                sum[k] += radiance[k];
                squares[k] += square[k];
                agreement[k] += sample.pattern * radiance[k];
            }
        }
        let share = 1.0 / range.len() as f32;
        for k in 0..N {
            let left = squares[k] - sum[k] * sum[k] * share;
            // A pattern with black and white exchanged does not match.
            let agreement = agreement[k].max(0.0);
            let explained = (agreement * agreement / (left + TINY)).min(MOST);
            scores[k] += weight * minus_ln_1p_minus(explained);
        }
    }
    scores
}

/// -ln(1 - x), within 5 % for x up to 0.7. Beyond, it is less, because such a correlation occurs by
/// chance on a few samples.
#[inline(always)]
fn minus_ln_1p_minus(x: f32) -> f32 {
    x * (1.0 + x * (0.5 + 0.6 * x))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::acquire::canvas::Size;
    use nalgebra::UnitQuaternion;

    const SIZE: Size = Size { side: 2 * (8 + REACH_CELLS + 1), radius: 8, cell_m: 0.01 };

    /// Numbers by chance, the same in each run.
    fn noise(count: usize) -> Vec<f32> {
        let mut state = 0x2545_f491_u64;
        let mut next = || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 40) as f32 / (1 << 24) as f32
        };
        (0..count).map(|_| next()).collect()
    }

    /// A template of two facets: rows 0 to 3 and 6 to 9.
    fn template() -> Template {
        let (mut samples, mut facets) = (Vec::new(), Vec::new());
        for rows in [0..4, 6..10] {
            let values = noise(24 + rows.start);
            let mean = values.iter().sum::<f32>() / values.len() as f32;
            let norm = values.iter().map(|value| (value - mean).powi(2)).sum::<f32>().sqrt();
            let first = samples.len();
            let pixels = rows.flat_map(|y| (0..6).map(move |x| (x, y)));
            samples.extend(pixels.zip(&values).map(|((x, y), value)| {
                let [at, at_parted] = SIZE.places(x, y);
                TemplatePixel { at, at_parted, pattern: (value - mean) / norm }
            }));
            facets.push((first..samples.len(), (samples.len() - first) as f32));
        }
        Template { sight_from_markers: UnitQuaternion::identity(), samples, facets }
    }

    /// A picture with the template's pattern at a shift, each facet in a light of its own.
    fn canvas(template: &Template, [right, down]: [usize; 2]) -> Canvas {
        let mut radiance: Vec<f32> =
            noise(SIZE.side * SIZE.side).iter().map(|value| 0.2 * value).collect();
        for ((range, _), light) in template.facets.iter().zip([0.1, 0.8]) {
            for sample in &template.samples[range.clone()] {
                let at = sample.at as usize + down * SIZE.side + right;
                radiance[at] = light * (0.5 + sample.pattern);
            }
        }
        Canvas::of(SIZE.side, radiance)
    }

    #[test]
    fn a_pattern_is_found_where_it_is_in_any_light() {
        let template = template();
        for shift in [[4, 10], [0, 0], [22, 22], [16, 2]] {
            let (score, found) = best_shift(&template, &canvas(&template, shift));
            assert_eq!(found, shift, "{score}");
        }
        for shift in [[5, 9], [21, 3], [1, 1], [11, 21]] {
            let canvas = canvas(&template, shift);
            let beside = [shift[0] - 1, shift[1] + 1];
            assert_eq!(best_beside(&template, &canvas, beside).1, shift);
        }
    }

    #[test]
    fn black_and_white_exchanged_do_not_agree() {
        let template = template();
        let right = canvas(&template, [4, 10]);
        let negative = right.radiance.iter().map(|value| 1.0 - value).collect();
        let (agreeing, _) = best_shift(&template, &right);
        let (score, _) = best_shift(&template, &Canvas::of(SIZE.side, negative));
        assert!(score < 0.7 * agreeing, "{score} {agreeing}");
    }

    #[test]
    fn a_picture_without_light_agrees_with_nothing() {
        let (score, _) =
            best_shift(&template(), &Canvas::of(SIZE.side, vec![0.0; SIZE.side * SIZE.side]));
        assert_eq!(score, 0.0);
    }

    #[test]
    fn the_logarithm_is_near_the_true_one_below_0_7() {
        for x in [0.0f32, 0.1, 0.3, 0.5, 0.7] {
            let true_one = -(1.0 - x).ln();
            assert!((minus_ln_1p_minus(x) - true_one).abs() <= 0.05 * true_one, "{x}");
        }
        assert!(minus_ln_1p_minus(MOST) < -(1.0 - MOST).ln());
    }
}
