//! Exposure time of frames: from the configuration, or from the blur of moving bodies.

use std::collections::BTreeMap;

/// Standard deviation of a short measured stretch (see
/// [`Alignment::stretch_px2`](flockeye_imaging::align::Alignment::stretch_px2)), pixels of the
/// sphere image squared.
const STRETCH_SIGMA_PX2: f64 = 0.3;
/// Standard deviation of a long stretch while an exposure is known, as a share of the stretch
/// (docs/results/constants.md#motion-blur).
const SHARE_OF_PATH: f64 = 0.13;
/// Standard deviation of a long stretch while no exposure is known, as a share of the stretch. A
/// Gaussian is fitted then. Its variance is about 1.3 times that of a path of 4 to 8 px.
const SHARE_OF_GAUSSIAN: f64 = 0.4;
/// Largest relative standard deviation of the square of the exposure for its use.
const MAX_UNCERTAINTY: f64 = 0.3;
/// Loss of weight of earlier measurements with each new one, because exposures change with the
/// light.
const FORGETTING: f64 = 0.01;
/// Longest exposure, seconds. A longer one is that of a wrong stretch.
const MAX_EXPOSURE_S: f64 = 0.05;

/// Exposure time of frames.
///
/// A body that moves at `s` radians per second during an exposure `T` is blurred along its path by
/// a variance of (s T)^2 / 12. The lens blurs alike in all directions, so the stretch shows the
/// path alone: T^2 / 12 is its slope over s^2.
#[derive(Debug, Clone)]
pub(crate) struct ExposureEstimate {
    known_s: Option<f64>,
    pixels_per_radian: f64,
    /// Weighted sum of stretch times s^2 over targets and frames, rad^4/s^2. A long stretch is less
    /// certain, and has less weight.
    stretch: f64,
    /// Sum of s^4 with the same weights, rad^4/s^4.
    weight: f64,
    /// Sums of the open frame by target, so that the result does not depend on the order of
    /// measurements.
    pending: BTreeMap<usize, (f64, f64)>,
}

impl ExposureEstimate {
    /// Exposure time of a camera whose sphere image has this resolution; `known_s` is the exposure
    /// in the configuration, seconds.
    pub(crate) fn new(known_s: Option<f64>, pixels_per_radian: f64) -> Self {
        let pending = BTreeMap::new();
        Self { known_s, pixels_per_radian, stretch: 0.0, weight: 0.0, pending }
    }

    /// The exposure, seconds; 0 while it is not known.
    pub(crate) fn seconds(&self) -> f64 {
        self.known_s.or_else(|| self.learned_s()).unwrap_or_default()
    }

    /// Exposure from the blur, if it is precise enough.
    fn learned_s(&self) -> Option<f64> {
        let squared = 12.0 * self.stretch / self.weight;
        let sigma_rad2 = STRETCH_SIGMA_PX2 / self.pixels_per_radian.powi(2);
        let uncertainty = 12.0 * sigma_rad2 / self.weight.sqrt();
        let is_known = squared > 0.0 && uncertainty < MAX_UNCERTAINTY * squared;
        is_known.then(|| squared.sqrt()).filter(|exposure_s| *exposure_s < MAX_EXPOSURE_S)
    }

    /// Adds a target that moved at this rate, radians per second. The stretch is the variance of
    /// its blur along the motion less that across it, pixels of the sphere image squared.
    pub(crate) fn note(&mut self, target: usize, stretch_px2: f64, rate: f64) {
        let known_s = self.seconds();
        // Weights from the measured stretch favour those that are too short.
        let sigma_px2 = if known_s > 0.0 {
            SHARE_OF_PATH * (rate * known_s * self.pixels_per_radian).powi(2) / 12.0
        } else {
            SHARE_OF_GAUSSIAN * stretch_px2
        };
        let weight = 1.0 / (1.0 + (sigma_px2 / STRETCH_SIGMA_PX2).powi(2));
        let (square, stretch) = (rate.powi(2), stretch_px2 / self.pixels_per_radian.powi(2));
        let sums = (weight * stretch * square, weight * square.powi(2));
        if sums.0.is_finite() && sums.1.is_finite() {
            self.pending.insert(target, sums);
        }
    }

    /// The sums of stretch and weight, for the next process.
    pub(crate) fn learned(&self) -> (f64, f64) {
        (self.stretch, self.weight)
    }

    /// Continues from the sums of another process.
    pub(crate) fn resume(&mut self, (stretch, weight): (f64, f64)) {
        if stretch.is_finite() && weight.is_finite() {
            (self.stretch, self.weight) = (stretch, weight);
        }
    }

    pub(crate) fn end_frame(&mut self) {
        for (stretch, weight) in std::mem::take(&mut self.pending).into_values() {
            self.stretch = (1.0 - FORGETTING) * self.stretch + stretch;
            self.weight = (1.0 - FORGETTING) * self.weight + weight;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PIXELS_PER_RADIAN: f64 = 611.0;

    fn seen(exposure_s: f64, rates: &[f64]) -> ExposureEstimate {
        let mut exposure = ExposureEstimate::new(None, PIXELS_PER_RADIAN);
        for (k, &rate) in rates.iter().enumerate() {
            let path_px = rate * exposure_s * PIXELS_PER_RADIAN;
            let noise = if k.is_multiple_of(2) { 0.2 } else { -0.2 };
            exposure.note(0, path_px.powi(2) / 12.0 + noise, rate);
            exposure.end_frame();
        }
        exposure
    }

    #[test]
    fn it_is_learned_from_fast_bodies_and_not_from_slow_ones() {
        let of = |exposure_s: f64, rate: f64| seen(exposure_s, &[rate; 40]).seconds();
        assert!((of(0.010, 0.55) - 0.010).abs() < 5e-4, "{}", of(0.010, 0.55));
        assert!((of(0.010, 1.5) - 0.010).abs() < 5e-4, "{}", of(0.010, 1.5));
        assert!((of(0.005, 1.0) - 0.005).abs() < 5e-4, "{}", of(0.005, 1.0));
        assert_eq!(of(0.005, 0.1), 0.0);
        assert_eq!(seen(0.005, &[]).seconds(), 0.0);
    }

    /// Notes a body at 1.5 rad/s, blurred `wider` times as much as by this exposure, in some frames.
    fn note(exposure: &mut ExposureEstimate, exposure_s: f64, wider: f64, frames: usize) {
        for _ in 0..frames {
            let stretch_px2 = (exposure_s * 1.5 * PIXELS_PER_RADIAN).powi(2) / 12.0;
            exposure.note(0, wider * stretch_px2, 1.5);
            exposure.end_frame();
        }
    }

    #[test]
    fn bodies_that_are_always_fast_show_it_too() {
        let mut exposure = ExposureEstimate::new(None, PIXELS_PER_RADIAN);
        // While no exposure is known, a Gaussian is fitted, whose variance is too large.
        note(&mut exposure, 0.010, 1.4, 2);
        assert!((0.010..0.012).contains(&exposure.seconds()), "{}", exposure.seconds());
        note(&mut exposure, 0.010, 1.0, 15);
        assert!((exposure.seconds() - 0.010).abs() < 3e-4, "{}", exposure.seconds());
    }

    #[test]
    fn single_wrong_stretches_and_their_scatter_change_little() {
        let mut exposure = ExposureEstimate::new(None, PIXELS_PER_RADIAN);
        for wider in [0.87, 1.13].repeat(100) {
            note(&mut exposure, 0.010, wider, 1);
        }
        assert!((exposure.seconds() - 0.010).abs() < 1e-4, "{}", exposure.seconds());
        note(&mut exposure, 0.010, 0.0, 3);
        assert!((exposure.seconds() - 0.010).abs() < 3e-4, "{}", exposure.seconds());
        // Two stretches that no exposure explains.
        let mut exposure = ExposureEstimate::new(None, PIXELS_PER_RADIAN);
        for _ in 0..2 {
            exposure.note(0, 3.0, 0.02);
            exposure.end_frame();
        }
        assert_eq!(exposure.seconds(), 0.0);
    }

    #[test]
    fn it_follows_the_light() {
        let mut exposure = seen(0.010, &[0.55; 300]);
        for _ in 0..400 {
            let path_px = 0.55 * 0.004 * PIXELS_PER_RADIAN;
            exposure.note(0, path_px.powi(2) / 12.0, 0.55);
            exposure.end_frame();
        }
        assert!((exposure.seconds() - 0.004).abs() < 5e-4, "{}", exposure.seconds());
        // Long paths count less than short ones, so a rise takes longer than a fall.
        for (before_s, after_s, frames) in [(0.010, 0.004, 200), (0.004, 0.010, 600)] {
            let mut exposure = ExposureEstimate::new(None, PIXELS_PER_RADIAN);
            note(&mut exposure, before_s, 1.0, 300);
            note(&mut exposure, after_s, 1.0, frames);
            assert!((exposure.seconds() - after_s).abs() < 5e-4, "{}", exposure.seconds());
        }
    }

    #[test]
    fn a_stated_exposure_is_taken_as_it_is_and_numbers_that_are_none_are_left_out() {
        let mut exposure = ExposureEstimate::new(Some(0.007), PIXELS_PER_RADIAN);
        exposure.note(0, 100.0, 1.0);
        exposure.end_frame();
        assert_eq!(exposure.seconds(), 0.007);
        let mut exposure = seen(0.010, &[0.55; 40]);
        exposure.note(0, f64::NAN, 1.0);
        exposure.note(1, 1.0, f64::INFINITY);
        exposure.end_frame();
        assert!((exposure.seconds() - 0.010).abs() < 5e-4);
    }
}
