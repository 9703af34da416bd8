//! A filter whose measurements may come late and out of order.
//!
//! One's own camera is heard of after some milliseconds, a peer's after its exposure, its work and the radio.
//! A filter takes measurements in the order of their times. So the newest part of them is kept, the
//! filter stands where that part begins, and each question runs it over the part again.
//!
//! How briskly two drones move is not known beforehand, and what is right for a gust is far too much for calm air:
//! the filter then believes each new measurement rather than those before it, and gains nothing from a second
//! observer. So filters for calmer and brisker motion run side by side. The one counts by which the measurements
//! of the last second or so were likeliest (multiple models, Bar-Shalom, Li, Kirubarajan, section 11.6.2, with
//! fading memory).

use std::collections::VecDeque;

use flockeye_geometry::ego_rotation::EgoRotation;
use flockeye_geometry::filter::{FilterError, MotionModel, Prediction, Track, chi_square_gate};

use super::uncertain_pose::UncertainPose;

/// Measurements that are so much older than the newest are taken in for good, seconds.
const REPLAYED_S: f64 = 0.3;
/// Maximum measurements that wait: two drones' at 60 frames/s, and some.
const MOST_WAITING: usize = 64;
/// A right measurement lies within the gate with this probability.
const GATE: f64 = 0.9999;
/// After so many measurements outside the gate, one after the other, it is the filter that is wrong.
const MOST_MISSES: u32 = 5;

/// Motion of the filters side by side, as shares of the briskest.
const BRISKNESS: [f64; 3] = [1.0, 0.35, 0.12];
/// After so long a measurement says less by a factor of e of how briskly a drone moves, seconds.
const MEMORY_S: f64 = 1.0;

/// A measured pose of one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimedPose {
    /// When, seconds.
    pub at_s: f64,
    /// What.
    pub pose: UncertainPose,
}

/// The filter of one pose, `first_from_second`.
#[derive(Debug, Clone)]
pub struct Replay {
    /// The filter at the first measurement that waits.
    filters: [Filter; BRISKNESS.len()],
    /// In the order of their times.
    waiting: VecDeque<TimedPose>,
}

/// A filter for one briskness.
#[derive(Debug, Clone)]
struct Filter {
    motion: MotionModel,
    track: Option<Track>,
    misses: u32,
    /// How likely the last measurements were, as a logarithm.
    likelihood: f64,
}

impl Replay {
    /// A filter without measurements. Drones move as `motion` says, or less briskly.
    pub fn new(motion: MotionModel) -> Self {
        let filter = |share| Filter {
            motion: MotionModel {
                acceleration: share * motion.acceleration,
                angular_acceleration: share * motion.angular_acceleration,
                ..motion
            },
            track: None,
            misses: 0,
            likelihood: 0.0,
        };
        Self { filters: BRISKNESS.map(filter), waiting: VecDeque::new() }
    }

    /// When it was measured last, seconds.
    pub fn newest_s(&self) -> Option<f64> {
        let waiting = self.waiting.back().map(|newest| newest.at_s);
        waiting.or_else(|| self.begins_s())
    }

    /// When the measurements that wait begin, seconds.
    fn begins_s(&self) -> Option<f64> {
        let begins = self.filters.iter().filter_map(|filter| filter.track.as_ref());
        begins.map(Track::stamp_s).reduce(f64::max)
    }

    /// Takes in a measurement, by a first drone that turns as `ego` says. One that is older than all that
    /// is still kept is left out.
    pub fn add(&mut self, measured: TimedPose, ego: &EgoRotation) {
        if !measured.at_s.is_finite() || !measured.pose.is_usable() {
            return;
        }
        if self.begins_s().is_some_and(|begins_s| measured.at_s < begins_s) {
            return;
        }
        let place = self.waiting.partition_point(|waiting| waiting.at_s <= measured.at_s);
        self.waiting.insert(place, measured);
        let newest_s = self.newest_s().unwrap_or(measured.at_s);
        while let Some(oldest) = self.waiting.front().copied()
            && (oldest.at_s < newest_s - REPLAYED_S || self.waiting.len() > MOST_WAITING)
        {
            self.waiting.pop_front();
            self.filters.iter_mut().for_each(|filter| filter.take(&oldest, ego));
        }
    }

    /// What is known at `at_s`; none before the first measurement, or so long after the last that nothing is.
    pub fn at(&self, at_s: f64, ego: &EgoRotation) -> Option<Prediction> {
        let mut filters = self.filters.clone();
        for measured in self.waiting.iter().take_while(|waiting| waiting.at_s <= at_s) {
            filters.iter_mut().for_each(|filter| filter.take(measured, ego));
        }
        let best = filters.into_iter().max_by(|a, b| a.likelihood.total_cmp(&b.likelihood))?;
        best.track?.predict(at_s, ego).ok()
    }
}

impl Filter {
    /// Takes a measurement into the track, or begins one with it.
    fn take(&mut self, measured: &TimedPose, ego: &EgoRotation) {
        let TimedPose { at_s, pose: UncertainPose { a_from_b, covariance } } = measured;
        let Some(track) = &mut self.track else {
            self.begin(measured);
            return;
        };
        let since_s = at_s - track.stamp_s();
        match track.update(*at_s, a_from_b, covariance, chi_square_gate_of_all(), ego) {
            Ok(innovation) => {
                self.misses = 0;
                self.remember(since_s, innovation.log_likelihood());
            }
            Err(FilterError::Gated { innovation, .. }) if self.misses < MOST_MISSES => {
                self.misses += 1;
                self.remember(0.0, innovation.log_likelihood());
            }
            Err(FilterError::Gated { .. } | FilterError::Gap { .. }) => self.begin(measured),
            Err(FilterError::Unusable { .. } | FilterError::Past { .. }) => {}
        }
    }

    fn begin(&mut self, measured: &TimedPose) {
        self.misses = 0;
        let UncertainPose { a_from_b, covariance } = &measured.pose;
        // Measurements were checked when they came, so they can begin a track.
        self.track = Track::start(measured.at_s, *a_from_b, covariance, self.motion).ok();
    }

    fn remember(&mut self, since_s: f64, likelihood: f64) {
        self.likelihood = self.likelihood * (-since_s / MEMORY_S).exp() + likelihood;
    }
}

/// The gate, computed once.
fn chi_square_gate_of_all() -> f64 {
    static VALUE: std::sync::OnceLock<f64> = std::sync::OnceLock::new();
    *VALUE.get_or_init(|| chi_square_gate(GATE))
}
