//! A filter for measurements that arrive late and out of order.
//!
//! Measurements of this drone's camera arrive after some milliseconds. Those of a peer take longer,
//! through its processing and the radio. A filter needs measurements in the order of their times.
//! So the newest measurements are kept, and the filter stays at the first of them. Each query runs
//! a copy of it over the kept ones.
//!
//! The drones' accelerations are not known beforehand, and a setting for gusts is far too large for
//! calm air. The filter would then follow each new measurement, and gain nothing from a second
//! observer. So filters for several accelerations run side by side. The filter with the largest
//! likelihood over about the last second is used. These are multiple models with fading memory
//! (Bar-Shalom, Li, Kirubarajan, section 11.6.2).

use std::collections::VecDeque;

use flockeye_geometry::ego_rotation::EgoRotation;
use flockeye_geometry::filter::{FilterError, MotionEstimate, MotionModel, chi_square_gate};
use flockeye_geometry::pose::PoseEstimate;

use crate::uncertain_pose::UncertainPose;

/// Age relative to the newest measurement at which the filters take one in for good, seconds.
const REPLAYED_S: f64 = 0.3;
/// Maximum measurements that wait: enough for two drones at 60 frames/s.
const MOST_WAITING: usize = 64;
/// Probability that a valid measurement lies within the gate.
const GATE: f64 = 0.9999;
/// Measurements in a row outside the gate after which the filter restarts.
const MOST_MISSES: u32 = 5;

/// Accelerations of the parallel filters, as shares of the largest.
const BRISKNESS: [f64; 3] = [1.0, 0.35, 0.12];
/// Time constant of the likelihoods' memory, seconds.
const MEMORY_S: f64 = 1.0;

/// The filter of one pose, `first_from_second`.
#[derive(Debug, Clone)]
pub(super) struct Replay {
    /// The filters at the first measurement that waits.
    filters: [Filter; BRISKNESS.len()],
    /// Measured poses, in the order of their times, seconds.
    waiting: VecDeque<(f64, UncertainPose)>,
}

#[derive(Debug, Clone)]
struct Filter {
    motion: MotionModel,
    track: Option<MotionEstimate>,
    misses: u32,
    /// Log likelihood of the last measurements.
    likelihood: f64,
}

impl Replay {
    /// A filter without measurements. `motion` has the largest accelerations.
    pub(super) fn new(motion: MotionModel) -> Self {
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

    /// Time of the newest measurement, seconds.
    pub(super) fn newest_s(&self) -> Option<f64> {
        let waiting = self.waiting.back().map(|(newest_s, _)| *newest_s);
        waiting.or_else(|| self.begins_s())
    }

    /// Time of the filters, before the measurements that wait, seconds.
    fn begins_s(&self) -> Option<f64> {
        let begins = self.filters.iter().filter_map(|filter| filter.track.as_ref());
        begins.map(|track| track.stamp_s).reduce(f64::max)
    }

    /// Adds a pose that was measured at `at_s`, seconds; `ego` is the rotation of the first drone.
    /// One that is older than the filters is dropped.
    pub(super) fn add(&mut self, at_s: f64, measured: UncertainPose, ego: &EgoRotation) {
        if !at_s.is_finite() || !measured.is_usable() {
            return;
        }
        if self.begins_s().is_some_and(|begins_s| at_s < begins_s) {
            return;
        }
        let place = self.waiting.partition_point(|(waiting_s, _)| *waiting_s <= at_s);
        self.waiting.insert(place, (at_s, measured));
        let newest_s = self.newest_s().unwrap_or(at_s);
        while let Some((oldest_s, oldest)) = self.waiting.front().copied()
            && (oldest_s < newest_s - REPLAYED_S || self.waiting.len() > MOST_WAITING)
        {
            self.waiting.pop_front();
            self.filters.iter_mut().for_each(|filter| filter.take(oldest_s, &oldest, ego));
        }
    }

    /// The estimate at `at_s`; none before the first measurement, or too long after the last.
    pub(super) fn at(&self, at_s: f64, ego: &EgoRotation) -> Option<MotionEstimate> {
        let mut filters = self.filters.clone();
        for (waiting_s, measured) in self.waiting.iter().take_while(|(s, _)| *s <= at_s) {
            filters.iter_mut().for_each(|filter| filter.take(*waiting_s, measured, ego));
        }
        let best = filters.into_iter().max_by(|a, b| a.likelihood.total_cmp(&b.likelihood))?;
        best.track?.predict(at_s, &best.motion, ego).ok()
    }
}

impl Filter {
    /// Updates the track with a measurement, or starts one.
    fn take(&mut self, at_s: f64, pose: &UncertainPose, ego: &EgoRotation) {
        let Some(track) = &mut self.track else {
            self.begin(at_s, pose);
            return;
        };
        let since_s = at_s - track.stamp_s;
        match track.update(at_s, &estimate_of(pose), chi_square_gate_of_all(), &self.motion, ego) {
            Ok(log_likelihood) => {
                self.misses = 0;
                self.remember(since_s, log_likelihood);
            }
            Err(FilterError::Gated { log_likelihood, .. }) if self.misses < MOST_MISSES => {
                self.misses += 1;
                self.remember(0.0, log_likelihood);
            }
            Err(FilterError::Gated { .. } | FilterError::Gap { .. }) => self.begin(at_s, pose),
            Err(FilterError::Unusable { .. } | FilterError::Past { .. }) => {}
        }
    }

    fn begin(&mut self, at_s: f64, pose: &UncertainPose) {
        self.misses = 0;
        // Measurements were checked on arrival, so they can start a track.
        self.track = MotionEstimate::start(at_s, &estimate_of(pose), &self.motion).ok();
    }

    fn remember(&mut self, since_s: f64, likelihood: f64) {
        self.likelihood = self.likelihood * (-since_s / MEMORY_S).exp() + likelihood;
    }
}

/// The pose in the filter's type: the second drone's in the axes of the first.
fn estimate_of(pose: &UncertainPose) -> PoseEstimate {
    PoseEstimate { camera_from_markers: pose.a_from_b, covariance: pose.covariance }
}

fn chi_square_gate_of_all() -> f64 {
    static VALUE: std::sync::OnceLock<f64> = std::sync::OnceLock::new();
    *VALUE.get_or_init(|| chi_square_gate(GATE))
}
