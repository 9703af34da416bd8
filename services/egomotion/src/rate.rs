//! The camera's rate at the middle of an exposure, from the rotations between exposures.
//!
//! A rotation between two frames gives the mean rate between them, which is the rate half a frame
//! ago. A drone in gusts changes its rate by some degrees a second meanwhile. So the rate is
//! filtered together with its change: a Kalman filter with white-noise jerk (Bar-Shalom, Li,
//! Kirubarajan, section 6.2.3), one for all axes, because all have the same noise.

use flockeye_geometry::ego_rotation::JERK;
use nalgebra::{Matrix2, Matrix3, RowVector2, Vector3};

/// Standard deviations of the first rate and of its change: the fastest motion of a drone, rad/s
/// and rad/s^2.
const FIRST_DEVIATIONS: [f64; 2] = [3.0, 10.0];

/// The rate and its change, with their covariance.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct RateFilter {
    rate: Vector3<f64>,
    acceleration: Vector3<f64>,
    /// Covariance of rate and acceleration about any one axis.
    covariance: Matrix2<f64>,
}

impl RateFilter {
    /// Expected rotation vector over the next `step_s` seconds, in the camera's axes, radians.
    pub(crate) fn expected(&self, step_s: f64) -> Vector3<f64> {
        self.rate * step_s + self.acceleration * (step_s * step_s / 2.0)
    }

    /// The rate now, rad/s, with its covariance.
    pub(crate) fn now(&self) -> (Vector3<f64>, Matrix3<f64>) {
        (self.rate, Matrix3::from_diagonal_element(self.covariance[(0, 0)]))
    }

    /// Returns the filter updated with the camera's rotation vector over the last `step_s` seconds,
    /// in its axes, with its covariance (rad^2). `before` is `None` before the first measurement.
    pub(crate) fn updated(
        before: Option<Self>,
        step_s: f64,
        turned: &Vector3<f64>,
        covariance: &Matrix3<f64>,
    ) -> Self {
        let [rate, change] = FIRST_DEVIATIONS;
        let before = before.unwrap_or_else(|| Self {
            rate: turned / step_s,
            acceleration: Vector3::zeros(),
            covariance: Matrix2::new(rate * rate, 0.0, 0.0, change * change),
        });
        let transition = Matrix2::new(1.0, step_s, 0.0, 1.0);
        let noise =
            Matrix2::new(step_s.powi(3) / 3.0, step_s.powi(2) / 2.0, step_s.powi(2) / 2.0, step_s)
                * (JERK * JERK);
        let predicted = transition * before.covariance * transition.transpose() + noise;
        let (rate, acceleration) =
            (before.rate + before.acceleration * step_s, before.acceleration);
        // Mean rate over the step: the rate now, less half of its change.
        let seen = RowVector2::new(1.0, -step_s / 2.0);
        let variance = covariance.trace() / 3.0 / (step_s * step_s);
        let spread = (seen * predicted * seen.transpose())[0] + variance;
        let gain = predicted * seen.transpose() / spread;
        let innovation = turned / step_s - (rate - acceleration * (step_s / 2.0));
        Self {
            rate: rate + innovation * gain[0],
            acceleration: acceleration + innovation * gain[1],
            covariance: predicted - gain * spread * gain.transpose(),
        }
    }

    /// Updates the rate with an inertial sensor's rate at the same time, rad/s, with its
    /// covariance.
    pub(crate) fn observe(&mut self, rate: &Vector3<f64>, covariance: &Matrix3<f64>) {
        let seen = RowVector2::new(1.0, 0.0);
        let spread = self.covariance[(0, 0)] + covariance.trace() / 3.0;
        let gain = self.covariance * seen.transpose() / spread;
        let innovation = rate - self.rate;
        self.rate += innovation * gain[0];
        self.acceleration += innovation * gain[1];
        self.covariance -= gain * spread * gain.transpose();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const STEP_S: f64 = 1.0 / 30.0;

    /// A rate that swings as that of a drone in gusts, and the angle turned by then.
    fn swinging(hz: f64, start: f64) -> impl Fn(f64) -> [f64; 2] {
        let (fast, angle) = (std::f64::consts::TAU * hz, 0.26);
        move |at_s: f64| {
            let phase = fast * at_s + start;
            [angle * fast * phase.cos(), angle * phase.sin()]
        }
    }

    proptest! {
        #[test]
        fn the_rate_is_that_of_now_and_not_of_half_a_frame_ago(hz in 0.1..0.7f64, start in 0.0..6.0f64) {
            let way = swinging(hz, start);
            let mut filter = None;
            let covariance = Matrix3::from_diagonal_element(3.5e-4f64.powi(2));
            for frame in 1..60 {
                let at_s = f64::from(frame) * STEP_S;
                let turned = way(at_s)[1] - way(at_s - STEP_S)[1];
                let turned = Vector3::new(0.0, turned, 0.0);
                let updated = RateFilter::updated(filter.take(), STEP_S, &turned, &covariance);
                let (rate, _) = updated.now();
                filter = Some(updated);
                let off_deg_s = (rate.y - way(at_s)[0]).to_degrees();
                prop_assert!(frame < 8 || off_deg_s.abs() < 1.0, "frame {frame}: {off_deg_s}");
            }
            let next_s = 60.0 * STEP_S;
            let expected = filter.map(|filter| filter.expected(STEP_S).y);
            let truth = way(next_s)[1] - way(next_s - STEP_S)[1];
            prop_assert!((expected.unwrap_or(9.0) - truth).abs().to_degrees() < 0.08);
        }
    }

    #[test]
    fn noise_is_smoothed_and_stated() {
        let mut filter = None;
        let deviation = 3.5e-4;
        let covariance = Matrix3::from_diagonal_element(deviation * deviation);
        let (mut squares, mut stated) = (0.0, 0.0);
        // Errors that are alike on average, without a generator: the golden angle's steps.
        for k in 0..2000u32 {
            let noise = deviation * 2f64.sqrt() * (f64::from(k) * 2.399_963).sin();
            let turned = Vector3::new(noise, 0.0, 0.0);
            let updated = RateFilter::updated(filter.take(), STEP_S, &turned, &covariance);
            let (rate, covariance) = updated.now();
            filter = Some(updated);
            if k > 20 {
                squares += rate.x * rate.x;
                stated += covariance[(0, 0)];
            }
        }
        let ratio = squares / stated;
        assert!((0.1..1.2).contains(&ratio), "{ratio}");
        assert!((stated / 1979.0).sqrt() < 1.8 * deviation / STEP_S);
    }

    #[test]
    fn a_sensor_that_measures_the_rate_itself_is_followed() {
        let way = swinging(0.6, 0.3);
        let (mut by_both, mut by_picture): (Option<RateFilter>, Option<RateFilter>) = (None, None);
        let covariance = Matrix3::from_diagonal_element(3.5e-4f64.powi(2));
        let sensor = Matrix3::from_diagonal_element(2e-3f64.powi(2));
        for frame in 1..40 {
            let at_s = f64::from(frame) * STEP_S;
            let turned = Vector3::x() * (way(at_s)[1] - way(at_s - STEP_S)[1]);
            let updated = |before: Option<RateFilter>| {
                RateFilter::updated(before, STEP_S, &turned, &covariance)
            };
            by_picture = Some(updated(by_picture));
            let mut both = updated(by_both);
            both.observe(&(Vector3::x() * way(at_s)[0]), &sensor);
            let (rate, stated) = both.now();
            by_both = Some(both);
            assert!(frame < 4 || (rate.x - way(at_s)[0]).abs() < 2e-3, "frame {frame}: {rate}");
            assert!(stated[(0, 0)] <= sensor[(0, 0)] * 1.0001);
        }
        let next_s = 40.0 * STEP_S;
        let truth = way(next_s)[1] - way(next_s - STEP_S)[1];
        let off = |filter: Option<RateFilter>| {
            filter.map_or(f64::INFINITY, |filter| (filter.expected(STEP_S).x - truth).abs())
        };
        let (by_both, by_picture) = (off(by_both), off(by_picture));
        assert!(by_both < by_picture, "{by_both} {by_picture}");
    }
}
