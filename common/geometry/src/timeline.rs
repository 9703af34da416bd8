//! Samples of the last two seconds, and the value between two of them.

use std::collections::VecDeque;

use nalgebra::{Isometry3, UnitQuaternion};

/// Time for which samples are kept, nanoseconds.
const KEPT_NS: i64 = 2_000_000_000;
/// Most samples: 500 a second.
const MAX_SAMPLES: usize = 1000;
/// Longest gap between samples over which values are interpolated, nanoseconds.
const LONGEST_GAP_NS: i64 = 500_000_000;

/// A value that can be interpolated.
pub trait Interpolate: Sized {
    /// Value at `share` (0 to 1) of the way to `later`; `None` where the two cannot be
    /// interpolated.
    fn between(&self, later: &Self, share: f64) -> Option<Self>;
}

/// Takes the shorter way round; `None` between opposite attitudes, which have no shorter way.
impl Interpolate for UnitQuaternion<f64> {
    fn between(&self, later: &Self, share: f64) -> Option<Self> {
        self.try_slerp(later, share, 1e-9)
    }
}

impl Interpolate for Isometry3<f64> {
    fn between(&self, later: &Self, share: f64) -> Option<Self> {
        let rotation = self.rotation.between(&later.rotation, share)?;
        let position = self.translation.vector.lerp(&later.translation.vector, share);
        Some(Self::from_parts(position.into(), rotation))
    }
}

/// Samples with rising times, at most 1,000 of them.
#[derive(Debug)]
pub struct Timeline<T> {
    samples: VecDeque<(i64, T)>,
}

impl<T> Default for Timeline<T> {
    fn default() -> Self {
        Self { samples: VecDeque::new() }
    }
}

impl<T: Interpolate> Timeline<T> {
    /// Adds a sample with this time, CLOCK_MONOTONIC. A sample not newer than the last is left out.
    pub fn push(&mut self, at_ns: i64, sample: T) {
        if self.samples.back().is_some_and(|(last_ns, _)| at_ns <= *last_ns) {
            return;
        }
        self.samples.push_back((at_ns, sample));
        let is_old = |(first_ns, _): &(i64, T)| at_ns.saturating_sub(*first_ns) > KEPT_NS;
        while self.samples.len() > MAX_SAMPLES || self.samples.front().is_some_and(is_old) {
            self.samples.pop_front();
        }
    }

    /// The newest sample and its time.
    pub fn newest(&self) -> Option<&(i64, T)> {
        self.samples.back()
    }

    /// Forgets all samples.
    pub fn clear(&mut self) {
        self.samples.clear();
    }

    /// Value at this time, CLOCK_MONOTONIC; `None` outside the samples and in a long gap.
    pub fn at(&self, at_ns: i64) -> Option<T> {
        let later = self.samples.partition_point(|(time_ns, _)| *time_ns < at_ns);
        let (later_ns, later_sample) = self.samples.get(later)?;
        if *later_ns == at_ns {
            return later_sample.between(later_sample, 0.0);
        }
        let (earlier_ns, earlier_sample) = self.samples.get(later.checked_sub(1)?)?;
        let gap_ns = later_ns.saturating_sub(*earlier_ns);
        if gap_ns > LONGEST_GAP_NS {
            return None;
        }
        let share = at_ns.saturating_sub(*earlier_ns) as f64 / gap_ns as f64;
        earlier_sample.between(later_sample, share)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[derive(Debug, PartialEq)]
    struct Number(f64);

    impl Interpolate for Number {
        fn between(&self, later: &Self, share: f64) -> Option<Self> {
            Some(Self(self.0 + share * (later.0 - self.0)))
        }
    }

    const MS: i64 = 1_000_000;

    #[test]
    fn values_between_samples_and_none_outside() {
        let mut timeline = Timeline::default();
        assert_eq!(timeline.at(0), None);
        for at_ms in (0..=5000).step_by(10) {
            timeline.push(at_ms * MS, Number(at_ms as f64));
        }
        assert_eq!(timeline.at(4567 * MS), Some(Number(4567.0)));
        assert_eq!(timeline.at(5000 * MS), Some(Number(5000.0)));
        assert_eq!(timeline.at(3000 * MS), Some(Number(3000.0)), "two seconds are kept");
        assert_eq!(timeline.at(2999 * MS), None);
        assert_eq!(timeline.at(5001 * MS), None, "it does not look ahead");
        // A gap.
        timeline.push(5600 * MS, Number(0.0));
        assert_eq!(timeline.at(5300 * MS), None);
        assert_eq!(timeline.at(5600 * MS), Some(Number(0.0)));
        // What comes late is left out.
        timeline.push(5500 * MS, Number(1.0));
        assert_eq!(timeline.newest(), Some(&(5600 * MS, Number(0.0))));
    }

    proptest! {
        #[test]
        fn times_of_all_sizes_do_no_harm(times in prop::collection::vec(any::<i64>(), 0..2000)) {
            let mut timeline = Timeline::default();
            for time in times {
                timeline.push(time, Number(1.0));
                timeline.push(time.saturating_add(1), Number(1.0));
                timeline.at(time.wrapping_add(5));
                prop_assert!(timeline.samples.len() <= MAX_SAMPLES);
            }
        }
    }
}
