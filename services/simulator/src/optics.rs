//! Blur: the lens's point spread and motion during the exposure, in linear light.

/// Half of a symmetric blur kernel: the weights of the samples at distance 0, 1, 2, ... on either
/// side. All weights sum to 1.
///
/// Convolution of a Gaussian of standard deviation `sigma` with a box of `length`; both in samples.
pub(crate) fn blur_kernel(sigma: f64, length: f64) -> Vec<f32> {
    let parts = (4.0 * length / sigma).ceil().max(1.0) as usize;
    let reach = (3.7 * sigma + length / 2.0).ceil() as usize;
    let weight = |distance: usize| -> f64 {
        (0..parts)
            .map(|part| {
                let shift = ((part as f64 + 0.5) / parts as f64 - 0.5) * length;
                (-0.5 * ((distance as f64 - shift) / sigma).powi(2)).exp()
            })
            .sum()
    };
    let weights: Vec<f64> = (0..=reach).map(weight).collect();
    let sum = weights[0] + 2.0 * weights[1..].iter().sum::<f64>();
    weights.into_iter().map(|weight| (weight / sum) as f32).collect()
}

/// Blurs along a row: `out[i]` from `padded[i + reach * step]` and `reach` neighbours at multiples
/// of `step` on either side. `padded` is longer than `out` by `2 * reach * step`.
pub(crate) fn blur_row(padded: &[f32], out: &mut [f32], kernel: &[f32], step: usize) {
    let middle = (kernel.len() - 1) * step;
    let n = out.len();
    for (out, value) in out.iter_mut().zip(&padded[middle..][..n]) {
        *out = value * kernel[0];
    }
    for (distance, &weight) in kernel.iter().enumerate().skip(1) {
        let before = &padded[middle - distance * step..][..n];
        let after = &padded[middle + distance * step..][..n];
        for ((out, before), after) in out.iter_mut().zip(before).zip(after) {
            *out += (before + after) * weight;
        }
    }
}

/// Blurs across rows: `out` is the result for the `columns` of row `at`. Each of `rows` has `width`
/// values. The first and last row are repeated beyond the ends.
pub(crate) fn blur_rows(
    rows: &[f32],
    width: usize,
    at: usize,
    columns: std::ops::Range<usize>,
    out: &mut [f32],
    kernel: &[f32],
) {
    let last = rows.len() / width - 1;
    let row = |index: usize| &rows[index * width..][columns.clone()];
    for (out, value) in out.iter_mut().zip(row(at)) {
        *out = value * kernel[0];
    }
    for (distance, &weight) in kernel.iter().enumerate().skip(1) {
        let (above, below) = (row(at.saturating_sub(distance)), row((at + distance).min(last)));
        for ((out, above), below) in out.iter_mut().zip(above).zip(below) {
            *out += (above + below) * weight;
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;

    fn variance(kernel: &[f32]) -> f64 {
        kernel.iter().enumerate().map(|(k, &w)| 2.0 * f64::from(w) * (k * k) as f64).sum()
    }

    #[test]
    fn a_kernel_has_the_variance_of_its_parts() {
        for (sigma, length) in [(0.6, 0.0), (1.6, 0.0), (1.6, 5.0), (3.2, 17.3)] {
            let kernel = blur_kernel(sigma, length);
            let sum = kernel[0] + 2.0 * kernel[1..].iter().sum::<f32>();
            assert!((sum - 1.0).abs() < 1e-5);
            let expected = sigma * sigma + length * length / 12.0;
            assert!((variance(&kernel) / expected - 1.0).abs() < 0.03, "{sigma} {length}");
        }
    }

    #[test]
    fn a_point_spreads_to_the_kernel_in_either_direction() {
        let kernel = [0.4f32, 0.2, 0.1];
        let mut out = [0.0; 5];
        let mut padded = [0.0; 9];
        padded[4] = 1.0;
        blur_row(&padded, &mut out, &kernel, 1);
        assert_eq!(out, [0.1, 0.2, 0.4, 0.2, 0.1]);
        let rows = [0.0, 0.0, 1.0, 0.0, 0.0];
        let mut one = [0.0];
        let spread: Vec<f32> = (0..5)
            .map(|at| {
                blur_rows(&rows, 1, at, 0..1, &mut one, &kernel);
                one[0]
            })
            .collect();
        assert_eq!(spread, [0.1, 0.2, 0.4, 0.2, 0.1]);
        // The first row is repeated above itself.
        blur_rows(&[1.0, 0.0, 0.0, 0.0, 0.0], 1, 0, 0..1, &mut one, &kernel);
        assert!((one[0] - 0.7).abs() < 1e-6);
    }
}
