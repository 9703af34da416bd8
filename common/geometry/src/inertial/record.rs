//! Angular velocities over the last seconds, and the rotation between any two times.

use std::collections::VecDeque;

use nalgebra::{UnitQuaternion, Vector3};

/// Largest distance between samples, seconds. In a longer gap the rotation is not known.
const LONGEST_GAP_S: f64 = 0.03;

/// Time after the newest sample for which its rate still applies, seconds: one sample at 100 Hz.
const HOLD_S: f64 = 0.01;

/// Step back of a sample's time that proves a clock jump, seconds.
const LEAP_S: f64 = 1.0;

/// Most stored samples: a quarter of an hour at 1 kHz.
const MOST_SAMPLES: usize = 1_000_000;

/// Number of newest samples for the estimate of their noise.
const NOISE_SAMPLES: usize = 100;

/// One sample of an inertial sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RateSample {
    /// Time of the sample, seconds.
    pub at_s: f64,
    /// Angular velocity, rad/s.
    pub rate: Vector3<f64>,
}

/// Angular velocities over the last seconds, in the order of their time.
#[derive(Debug, Clone, PartialEq)]
pub struct RateRecord {
    keep_s: f64,
    samples: VecDeque<RateSample>,
}

impl RateRecord {
    /// An empty record that keeps the last `keep_s` seconds.
    pub fn new(keep_s: f64) -> Self {
        Self { keep_s, samples: VecDeque::new() }
    }

    /// Adds the next sample. A sample not later than the last one is left out. A far earlier one
    /// proves that the clock has jumped, so the record starts anew.
    pub fn push(&mut self, sample: RateSample) {
        if self.samples.back().is_some_and(|last| sample.at_s < last.at_s - LEAP_S) {
            self.samples.clear();
        }
        if self.samples.back().is_some_and(|last| sample.at_s <= last.at_s) {
            return;
        }
        if self.samples.len() >= MOST_SAMPLES {
            self.samples.pop_front();
        }
        self.samples.push_back(sample);
        while self.samples.front().is_some_and(|first| first.at_s < sample.at_s - self.keep_s) {
            self.samples.pop_front();
        }
    }

    /// Forgets all samples.
    pub fn clear(&mut self) {
        self.samples.clear();
    }

    /// Time of the newest sample, seconds.
    pub fn newest_s(&self) -> Option<f64> {
        self.samples.back().map(|sample| sample.at_s)
    }

    /// Rotation from one time to a later one, with samples corrected by `correct`, and the variance
    /// about each axis from their white noise, rad^2. It rotates directions from the sensor's frame
    /// at the earlier time into that at the later one. `None` where samples are missing: before the
    /// first, long after the last, in a gap between.
    pub fn turned(
        &self,
        earlier_s: f64,
        later_s: f64,
        correct: impl Fn(Vector3<f64>) -> Vector3<f64>,
    ) -> Option<(UnitQuaternion<f64>, f64)> {
        let points = self.points(earlier_s, later_s)?;
        let over_s = later_s - earlier_s;
        let step_s = over_s / (points.len() - 1) as f64;
        let noise_variance = self.white_noise().powi(2) * step_s * over_s;
        Some((integrated(&points, correct), noise_variance))
    }

    /// The rotation alone, without its noise.
    pub fn later_from_earlier(
        &self,
        earlier_s: f64,
        later_s: f64,
        correct: impl Fn(Vector3<f64>) -> Vector3<f64>,
    ) -> Option<UnitQuaternion<f64>> {
        Some(integrated(&self.points(earlier_s, later_s)?, correct))
    }

    /// The angular velocity averaged over `width_s` round a time, and its variance about each axis
    /// from the samples' white noise, (rad/s)^2. `None` where samples are missing.
    pub fn rate_around(&self, at_s: f64, width_s: f64) -> Option<(Vector3<f64>, f64)> {
        let variance = self.white_noise().powi(2);
        // The window ends at the newest sample and is symmetric, so that a steady change averages
        // out.
        let half_s = (width_s / 2.0).min((self.newest_s()? - at_s).max(0.0));
        let Some(points) = self.points(at_s - half_s, at_s + half_s) else {
            return Some((self.rate_at(at_s)?, variance));
        };
        let steps = points.iter().zip(points.iter().skip(1));
        let turned: Vector3<f64> = steps
            .map(|(before, after)| (before.rate + after.rate) / 2.0 * (after.at_s - before.at_s))
            .sum();
        Some((turned / (2.0 * half_s), variance / (points.len() - 1) as f64))
    }

    /// The samples between two times, with the rates at both ends.
    fn points(&self, from_s: f64, to_s: f64) -> Option<Vec<RateSample>> {
        if to_s <= from_s {
            return None;
        }
        let end = |at_s: f64| Some(RateSample { at_s, rate: self.rate_at(at_s)? });
        let (from, to) = (end(from_s)?, end(to_s)?);
        let inner = self.samples.range(self.index_after(from_s)..self.index_after(to_s));
        let inner = inner.filter(|sample| sample.at_s < to_s).copied();
        let points: Vec<RateSample> =
            std::iter::once(from).chain(inner).chain(std::iter::once(to)).collect();
        let is_whole = points
            .iter()
            .zip(points.iter().skip(1))
            .all(|(before, after)| after.at_s - before.at_s <= LONGEST_GAP_S);
        is_whole.then_some(points)
    }

    /// Angular velocity at a time, interpolated between samples.
    pub fn rate_at(&self, at_s: f64) -> Option<Vector3<f64>> {
        let after = self.index_after(at_s);
        match (after.checked_sub(1).and_then(|k| self.samples.get(k)), self.samples.get(after)) {
            (Some(before), Some(next)) if next.at_s - before.at_s <= LONGEST_GAP_S => {
                let share = (at_s - before.at_s) / (next.at_s - before.at_s);
                Some(before.rate.lerp(&next.rate, share))
            }
            (Some(last), None) if at_s <= last.at_s + HOLD_S => Some(last.rate),
            _ => None,
        }
    }

    /// Standard deviation of one sample's white noise about an axis, rad/s. It follows from the
    /// second differences of the newest samples, on which motion has little effect.
    pub fn white_noise(&self) -> f64 {
        let newest = self.samples.range(self.samples.len().saturating_sub(NOISE_SAMPLES)..);
        let rates: Vec<Vector3<f64>> = newest.map(|sample| sample.rate).collect();
        let mut bends: Vec<f64> = rates
            .windows(3)
            .flat_map(|three| {
                let bend = three[0] - 2.0 * three[1] + three[2];
                [bend.x.abs(), bend.y.abs(), bend.z.abs()]
            })
            .collect();
        if bends.is_empty() {
            return 0.0;
        }
        let middle = bends.len() / 2;
        let (_, median, _) = bends.select_nth_unstable_by(middle, f64::total_cmp);
        // 0.6745: the median of a normal distribution's absolute values. 6 = 1 + 4 + 1.
        *median / (0.6745 * 6f64.sqrt())
    }

    /// Index of the first sample that is later than a time.
    fn index_after(&self, at_s: f64) -> usize {
        self.samples.partition_point(|sample| sample.at_s <= at_s)
    }
}

/// Rotation along samples, from one to the next at their mean rate. It maps directions from the
/// first sample's frame to the last one's.
fn integrated(
    points: &[RateSample],
    correct: impl Fn(Vector3<f64>) -> Vector3<f64>,
) -> UnitQuaternion<f64> {
    let steps = points.iter().zip(points.iter().skip(1));
    let earlier_from_later = steps.fold(UnitQuaternion::identity(), |turned, (before, after)| {
        let rate = correct((before.rate + after.rate) / 2.0);
        turned * UnitQuaternion::from_scaled_axis(rate * (after.at_s - before.at_s))
    });
    earlier_from_later.inverse()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::fixtures::flight::{flown, rate};
    use proptest::prelude::*;

    fn recorded(hz: f64) -> RateRecord {
        let mut record = RateRecord::new(5.0);
        let samples = (0..(2.0 * hz) as u32).map(|k| f64::from(k) / hz);
        samples.for_each(|at_s| record.push(RateSample { at_s, rate: rate(at_s) }));
        record
    }

    proptest! {
        #[test]
        fn the_rotation_between_any_times_is_that_flown(earlier in 0.0..1.5f64, way in 0.005..0.4f64) {
            let (found, _) = recorded(200.0).turned(earlier, earlier + way, |rate| rate).unwrap();
            let truth = flown(earlier + way).inverse() * flown(earlier);
            prop_assert!(found.angle_to(&truth) < 3e-5);
        }

        #[test]
        fn the_rate_at_any_time_is_that_flown(at in 0.1..1.9f64) {
            let (found, _) = recorded(200.0).rate_around(at, 0.01).unwrap();
            prop_assert!((found - rate(at)).norm() < 2e-3);
        }
    }

    #[test]
    fn what_is_not_covered_is_not_known() {
        let mut record = recorded(200.0);
        let known =
            |record: &RateRecord, from: f64, to: f64| record.turned(from, to, |r| r).is_some();
        assert!(known(&record, 0.0, 1.99) && known(&record, 1.9, 2.0));
        assert!(
            !known(&record, -0.1, 0.5) && !known(&record, 1.9, 2.1) && !known(&record, 1.0, 1.0)
        );
        // The sensor was silent for 0.1 s.
        record.push(RateSample { at_s: 2.1, rate: Vector3::zeros() });
        record.push(RateSample { at_s: 2.105, rate: Vector3::zeros() });
        assert!(!known(&record, 1.9, 2.102) && known(&record, 2.1, 2.105));
        assert_eq!(record.rate_at(2.05), None);
        // Old news, and what is too long ago.
        record.push(RateSample { at_s: 1.5, rate: Vector3::x() });
        assert_eq!(record.newest_s(), Some(2.105));
        record.push(RateSample { at_s: 6.9, rate: Vector3::zeros() });
        assert!(!known(&record, 1.0, 1.5));
        // The clock has jumped far ahead, and back.
        record.push(RateSample { at_s: 9e9, rate: Vector3::zeros() });
        record.push(RateSample { at_s: 6.9, rate: Vector3::zeros() });
        assert_eq!(record.newest_s(), Some(6.9));
        record.clear();
        assert_eq!((record.newest_s(), record.rate_around(6.9, 0.0)), (None, None));
    }

    #[test]
    fn noise_is_told_from_motion() {
        let quiet = recorded(200.0).white_noise();
        assert!(quiet < 5e-4, "{quiet}");
        let mut record = RateRecord::new(5.0);
        for k in 0..400u32 {
            let at_s = f64::from(k) / 200.0;
            // Two waves that no two samples have in common stand for noise of deviation 0.01.
            let noise = 0.01 * ((f64::from(k) * 2.399_963).sin() + (f64::from(k) * 4.1).cos());
            record.push(RateSample { at_s, rate: rate(at_s) + Vector3::repeat(noise) });
        }
        let noise = record.white_noise();
        assert!((0.005..0.02).contains(&noise), "{noise}");
        let (_, noise_variance) = record.turned(0.5, 0.533, |rate| rate).unwrap();
        assert!((1e-8..1e-6).contains(&noise_variance), "{noise_variance}");
    }
}
