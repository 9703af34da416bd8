//! Pixels that show an occluder instead of the fitted model: an arm, a propeller, a finger in front
//! of a marker.
//!
//! An occluder's soft edge is no outlier and moves every edge next to it: it is left out too.

/// A pixel is occluded if its residual exceeds both this many standard deviations of the noise and
/// [`MIN_RESIDUAL_SHARE`]. Edges of a fit that has not converged yet have smaller residuals.
const MIN_RESIDUAL_SIGMAS: f64 = 5.0;
/// Least residual of an occluded pixel, as a share of white.
const MIN_RESIDUAL_SHARE: f64 = 0.12;
/// Margin around an occluded pixel that is left out too, standard deviations of the point spread.
const REACH_BLURS: f64 = 2.5;

/// Threshold of the absolute residual of an occluded pixel. `noise` is the standard deviation of
/// the other residuals, `white` the radiance of white, both in the residual's unit.
pub(crate) fn least_residual(noise: f64, white: f64) -> f64 {
    (MIN_RESIDUAL_SIGMAS * noise).max(MIN_RESIDUAL_SHARE * white)
}

/// Margin around an occluded pixel, pixels, for a standard deviation of the blur.
pub(crate) fn reach_px(blur_px: f64) -> f64 {
    (REACH_BLURS * blur_px).ceil()
}

/// Sets all pixels within `reach` of (x, y), which may lie outside, in an image of rows of `width`.
pub(crate) fn mark_disc(pixels: &mut [bool], width: usize, (x, y): (isize, isize), reach: usize) {
    let height = pixels.len() / width.max(1);
    let reach = reach as isize;
    for row in (y - reach).max(0)..=(y + reach).min(height as isize - 1) {
        let half = f64::from((reach * reach - (row - y).pow(2)) as i32).sqrt() as isize;
        let columns = (x - half).max(0)..(x + half + 1).min(width as isize);
        let start = row as usize * width;
        if !columns.is_empty() {
            pixels[start + columns.start as usize..start + columns.end as usize].fill(true);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disc_is_marked_and_cut_by_the_image() {
        let marked = |at, reach| {
            let mut pixels = vec![false; 7 * 5];
            mark_disc(&mut pixels, 7, at, reach);
            pixels.iter().filter(|pixel| **pixel).count()
        };
        assert_eq!((marked((3, 2), 0), marked((3, 2), 1), marked((3, 2), 2)), (1, 5, 13));
        assert_eq!((marked((0, 0), 1), marked((6, 4), 1), marked((3, 2), 99)), (3, 3, 35));
        assert_eq!((marked((-1, 2), 1), marked((7, 2), 1), marked((9, -3), 2)), (1, 1, 0));
    }
}
