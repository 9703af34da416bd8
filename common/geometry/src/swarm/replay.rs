//! A filter whose measurements may come late and out of order.
//!
//! One's own camera is heard of after some milliseconds, a peer's after its exposure, its work and the radio.
//! A filter takes measurements in the order of their times. So the newest part of them is kept, the
//! filter stands where that part begins, and each question runs it over the part again.

use std::collections::VecDeque;

use crate::ego_rotation::EgoRotation;
use crate::filter::{FilterError, MotionModel, Prediction, Track, chi_square_gate};

use super::uncertain_pose::UncertainPose;

/// Measurements that are so much older than the newest are taken in for good, seconds.
const REPLAYED_S: f64 = 0.3;
/// Most measurements that wait: two drones' at 60 frames/s, and some.
const MOST_WAITING: usize = 64;
/// A right measurement lies within the gate with this probability.
const GATE: f64 = 0.9999;
/// After so many measurements outside the gate, one after the other, it is the filter that is wrong.
const MOST_MISSES: u32 = 5;

/// A measured pose of one time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// When, seconds.
    pub at_s: f64,
    /// What.
    pub pose: UncertainPose,
}

/// The filter of one pose, `first_from_second`.
#[derive(Debug, Clone)]
pub struct Replay {
    motion: MotionModel,
    track: Option<Track>,
    misses: u32,
    /// In the order of their times.
    waiting: VecDeque<Measured>,
}

impl Replay {
    /// Nothing is measured yet.
    pub fn new(motion: MotionModel) -> Self {
        Self { motion, track: None, misses: 0, waiting: VecDeque::new() }
    }

    /// When it was measured last, seconds.
    pub fn newest_s(&self) -> Option<f64> {
        let waiting = self.waiting.back().map(|newest| newest.at_s);
        waiting.or_else(|| self.track.as_ref().map(Track::stamp_s))
    }

    /// Takes in a measurement, by a first drone that turns as `ego` says. One that is older than all that
    /// is still kept is left out.
    pub fn add(&mut self, measured: Measured, ego: &EgoRotation) {
        if !measured.at_s.is_finite() || !measured.pose.is_usable() {
            return;
        }
        if self.track.as_ref().is_some_and(|track| measured.at_s < track.stamp_s()) {
            return;
        }
        let place = self.waiting.partition_point(|waiting| waiting.at_s <= measured.at_s);
        self.waiting.insert(place, measured);
        let newest_s = self.newest_s().unwrap_or(measured.at_s);
        while let Some(oldest) = self.waiting.front().copied()
            && (oldest.at_s < newest_s - REPLAYED_S || self.waiting.len() > MOST_WAITING)
        {
            self.waiting.pop_front();
            take(&mut self.track, &mut self.misses, &oldest, self.motion, ego);
        }
    }

    /// What is known at `at_s`; none before the first measurement, or so long after the last that nothing is.
    pub fn at(&self, at_s: f64, ego: &EgoRotation) -> Option<Prediction> {
        let (mut track, mut misses) = (self.track.clone(), self.misses);
        for measured in self.waiting.iter().take_while(|waiting| waiting.at_s <= at_s) {
            take(&mut track, &mut misses, measured, self.motion, ego);
        }
        track?.predict(at_s, ego).ok()
    }
}

/// Takes a measurement into a track, or begins one with it.
fn take(
    track: &mut Option<Track>,
    misses: &mut u32,
    measured: &Measured,
    motion: MotionModel,
    ego: &EgoRotation,
) {
    let Measured { at_s, pose: UncertainPose { a_from_b, covariance } } = measured;
    // Measurements were checked when they came, so they can begin a track.
    let begin = || Track::start(*at_s, *a_from_b, covariance, motion).ok();
    let Some(going) = track else {
        *track = begin();
        return;
    };
    match going.update(*at_s, a_from_b, covariance, chi_square_gate_of_all(), ego) {
        Ok(_) => *misses = 0,
        Err(FilterError::Gated { .. }) if *misses < MOST_MISSES => *misses += 1,
        Err(FilterError::Gated { .. } | FilterError::Gap { .. }) => {
            *misses = 0;
            *track = begin();
        }
        Err(FilterError::Unusable { .. } | FilterError::Past { .. }) => {}
    }
}

/// The gate, computed once.
fn chi_square_gate_of_all() -> f64 {
    static VALUE: std::sync::OnceLock<f64> = std::sync::OnceLock::new();
    *VALUE.get_or_init(|| chi_square_gate(GATE))
}
