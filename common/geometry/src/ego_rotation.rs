//! The camera's own rotation, which predictions of neighbours follow.

use std::collections::VecDeque;

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// Random change of angular acceleration: white-noise jerk about each axis, rad/s^3 per root Hz. A
/// drone in gusts that rolls by 15 degrees at 0.7 Hz has up to 22 rad/s^3. Over a frame of 33 ms
/// both have the same effect.
pub const JERK: f64 = 3.5;

/// An acceleration is not expected to last longer than this, seconds.
const ACCELERATION_LASTS_S: f64 = 0.1;

/// A rate is not expected to last longer than this, seconds.
const RATE_LASTS_S: f64 = 0.3;

/// Rotation of the camera from one time to a later one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraTurn {
    /// The earlier time, seconds.
    pub earlier_s: f64,
    /// The later time, seconds.
    pub later_s: f64,
    /// Rotates directions from the camera frame of the earlier time into that of the later time.
    pub later_from_earlier: UnitQuaternion<f64>,
    /// Covariance of the rotation vector in the later camera frame, rad^2.
    pub covariance: Matrix3<f64>,
    /// The camera's angular velocity at the later time, in its own axes, rad/s.
    pub rate_in_camera: Vector3<f64>,
    /// Covariance of the rate, (rad/s)^2.
    pub rate_covariance: Matrix3<f64>,
    /// Rotation since the later time, where an inertial sensor measures it.
    pub ahead: Option<TurnAhead>,
}

/// Rotation of the camera since its newest picture, from an inertial sensor. The rotation from the
/// next picture covers the same time and replaces it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TurnAhead {
    /// End of the measured rotation, seconds.
    pub until_s: f64,
    /// Rotates directions from the camera frame of the picture into that of `until_s`.
    pub ahead_from_later: UnitQuaternion<f64>,
    /// Covariance of the rotation vector in the camera frame of `until_s`, rad^2.
    pub covariance: Matrix3<f64>,
    /// The camera's angular velocity at `until_s`, in its own axes, rad/s.
    pub rate_in_camera: Vector3<f64>,
    /// Covariance of the rate, (rad/s)^2.
    pub rate_covariance: Matrix3<f64>,
}

impl CameraTurn {
    /// Returns this turn in the axes of a frame that is fixed to the camera.
    pub fn in_frame(&self, frame_from_camera: &UnitQuaternion<f64>) -> Self {
        let axes = frame_from_camera.to_rotation_matrix().into_inner();
        let turn =
            |turn: &UnitQuaternion<f64>| frame_from_camera * turn * frame_from_camera.inverse();
        let matrix = |covariance: &Matrix3<f64>| axes * covariance * axes.transpose();
        Self {
            later_from_earlier: turn(&self.later_from_earlier),
            covariance: matrix(&self.covariance),
            rate_in_camera: axes * self.rate_in_camera,
            rate_covariance: matrix(&self.rate_covariance),
            ahead: self.ahead.map(|ahead| TurnAhead {
                ahead_from_later: turn(&ahead.ahead_from_later),
                covariance: matrix(&ahead.covariance),
                rate_in_camera: axes * ahead.rate_in_camera,
                rate_covariance: matrix(&ahead.rate_covariance),
                ..ahead
            }),
            ..*self
        }
    }
}

/// A rotation of the camera between two times, with its covariance.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Turned {
    /// Rotates directions from the camera frame of the earlier time into that of the later time.
    pub later_from_earlier: UnitQuaternion<f64>,
    /// Covariance of the rotation vector in the later camera frame, rad^2.
    pub covariance: Matrix3<f64>,
}

impl Turned {
    fn none() -> Self {
        Self { later_from_earlier: UnitQuaternion::identity(), covariance: Matrix3::zeros() }
    }

    fn then(&self, later: &Self) -> Self {
        let turn = later.later_from_earlier.to_rotation_matrix();
        Self {
            later_from_earlier: later.later_from_earlier * self.later_from_earlier,
            covariance: turn.matrix() * self.covariance * turn.matrix().transpose()
                + later.covariance,
        }
    }

    /// A share of this turn, 0 to 1.
    fn share(&self, share: f64) -> Self {
        Self {
            later_from_earlier: self.later_from_earlier.powf(share),
            covariance: self.covariance * share,
        }
    }
}

/// The camera's own rotation over the last seconds. Where it is not known, the camera counts as not
/// turning, with zero covariance. Then tracks are relative to the camera's axes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EgoRotation {
    keep_s: f64,
    knots: VecDeque<Knot>,
    /// Whether the last knot comes from a [`TurnAhead`], which the next turn replaces.
    is_ahead: bool,
}

/// The camera at one time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Knot {
    at_s: f64,
    /// Rotation since the knot before.
    turned: Turned,
    rate: Vector3<f64>,
    rate_covariance: Matrix3<f64>,
    /// Change of the rate since the knot before, rad/s^2.
    acceleration: Vector3<f64>,
}

impl EgoRotation {
    /// Creates a history without any rotation. Turns are kept for `keep_s` seconds.
    pub fn new(keep_s: f64) -> Self {
        Self { keep_s, knots: VecDeque::new(), is_ahead: false }
    }

    /// Continues with the history of another process. Returns false and changes nothing if one of
    /// its numbers is not finite.
    pub fn resume(&mut self, saved: Self) -> bool {
        let is_usable = saved.knots.iter().all(Knot::is_finite);
        if is_usable {
            *self = Self { keep_s: self.keep_s, ..saved };
        }
        is_usable
    }

    /// Adds the next turn. A turn with the same end as the last one is left out. Turns come in
    /// order, so an earlier end means that the clock has jumped. Then the history starts anew.
    pub fn add(&mut self, turn: &CameraTurn) {
        let measured = self.knots.len().checked_sub(1 + usize::from(self.is_ahead));
        if measured
            .and_then(|last| self.knots.get(last))
            .is_some_and(|last| turn.later_s == last.at_s)
        {
            return;
        }
        if self.is_ahead {
            self.knots.pop_back();
        }
        self.add_measured(turn);
        let last = self.knots.back();
        let ahead = turn.ahead.filter(|ahead| ahead.until_s > turn.later_s);
        self.is_ahead = match (ahead, last) {
            (Some(ahead), Some(last)) => {
                let knot = Knot::ahead_of(last, &ahead);
                self.knots.push_back(knot);
                true
            }
            _ => false,
        };
    }

    fn add_measured(&mut self, turn: &CameraTurn) {
        let turned =
            Turned { later_from_earlier: turn.later_from_earlier, covariance: turn.covariance };
        if self.knots.back().is_some_and(|last| turn.later_s < last.at_s) {
            self.knots.clear();
        }
        let Some(last) = self.knots.back() else {
            self.knots.push_back(Knot::of(turn, Turned::none(), turn.earlier_s, None));
            self.knots.push_back(Knot::of(turn, turned, turn.later_s, None));
            return;
        };
        // Frames without a known rotation lie between the turns, or the turns overlap.
        let turned = match turn.earlier_s - last.at_s {
            gap_s if gap_s > 0.0 => last.ahead(gap_s).then(&turned),
            overlap_s => {
                let all_s = turn.later_s - turn.earlier_s;
                turned.share(((all_s + overlap_s) / all_s).clamp(0.0, 1.0))
            }
        };
        let knot = Knot::of(turn, turned, turn.later_s, Some(last));
        self.knots.push_back(knot);
        while self.knots.front().is_some_and(|oldest| oldest.at_s < turn.later_s - self.keep_s) {
            self.knots.pop_front();
        }
    }

    /// End of the known rotation, from pictures or from an inertial sensor, seconds; `None` before
    /// the first turn.
    pub fn known_until_s(&self) -> Option<f64> {
        self.knots.back().map(|last| last.at_s)
    }

    /// Rotation of the camera from one time to another that is not earlier. Beyond the known
    /// rotation, the last motion is extrapolated with growing covariance.
    pub fn between(&self, earlier_s: f64, later_s: f64) -> Turned {
        let (Some(first), Some(last)) = (self.knots.front(), self.knots.back()) else {
            return Turned::none();
        };
        let mut turned = Turned::none();
        if earlier_s < first.at_s {
            turned = first.back_to(first.at_s - earlier_s);
        }
        for (before, knot) in self.knots.iter().zip(self.knots.iter().skip(1)) {
            let (from_s, to_s) = (earlier_s.max(before.at_s), later_s.min(knot.at_s));
            if from_s < to_s {
                let share = (to_s - from_s) / (knot.at_s - before.at_s);
                turned = turned.then(&knot.turned.share(share));
            }
        }
        if later_s > last.at_s {
            let ahead = last.ahead(later_s - last.at_s);
            let ahead = match earlier_s > last.at_s {
                // Only the rotation after `earlier_s`, with the covariance of the whole
                // extrapolation.
                true => Turned {
                    later_from_earlier: ahead.later_from_earlier
                        * last.ahead(earlier_s - last.at_s).later_from_earlier.inverse(),
                    ..ahead
                },
                false => ahead,
            };
            turned = turned.then(&ahead);
        }
        turned
    }

    /// The camera's angular velocity at a time, in its own axes, rad/s.
    pub fn rate_at(&self, at_s: f64) -> Vector3<f64> {
        let after = self.knots.partition_point(|knot| knot.at_s < at_s);
        match (after.checked_sub(1).and_then(|k| self.knots.get(k)), self.knots.get(after)) {
            (Some(before), Some(knot)) => {
                let share = (at_s - before.at_s) / (knot.at_s - before.at_s);
                before.rate.lerp(&knot.rate, share)
            }
            (Some(last), None) if at_s - last.at_s < RATE_LASTS_S => {
                last.rate + last.acceleration * (at_s - last.at_s).min(ACCELERATION_LASTS_S)
            }
            (None, Some(first)) => first.rate,
            (Some(_) | None, None) => Vector3::zeros(),
        }
    }
}

impl Knot {
    fn of(turn: &CameraTurn, turned: Turned, at_s: f64, before: Option<&Self>) -> Self {
        let acceleration = before.map_or_else(Vector3::zeros, |before| {
            let since_s = at_s - before.at_s;
            match since_s < ACCELERATION_LASTS_S {
                true => (turn.rate_in_camera - before.rate) / since_s,
                false => Vector3::zeros(),
            }
        });
        Self {
            at_s,
            turned,
            rate: turn.rate_in_camera,
            rate_covariance: turn.rate_covariance,
            acceleration,
        }
    }

    /// Knot at the newest sample of an inertial sensor, after the knot of a picture.
    fn ahead_of(last: &Self, ahead: &TurnAhead) -> Self {
        let since_s = ahead.until_s - last.at_s;
        // Over a few milliseconds a difference of rates is mostly noise.
        let acceleration = match since_s > ACCELERATION_LASTS_S / 5.0 {
            true => (ahead.rate_in_camera - last.rate) / since_s,
            false => last.acceleration,
        };
        Self {
            at_s: ahead.until_s,
            turned: Turned {
                later_from_earlier: ahead.ahead_from_later,
                covariance: ahead.covariance,
            },
            rate: ahead.rate_in_camera,
            rate_covariance: ahead.rate_covariance,
            acceleration,
        }
    }

    fn is_finite(&self) -> bool {
        let mut numbers = (self.turned.later_from_earlier.coords.iter())
            .chain(&self.turned.covariance)
            .chain(&self.rate)
            .chain(&self.rate_covariance)
            .chain(&self.acceleration);
        self.at_s.is_finite() && numbers.all(|number| number.is_finite())
    }

    /// Expected rotation in the `ahead_s` seconds after this knot.
    fn ahead(&self, ahead_s: f64) -> Turned {
        let rate_s = ahead_s.min(RATE_LASTS_S);
        let bent_s = ahead_s.min(ACCELERATION_LASTS_S);
        // The acceleration changes the rate for a short time, and the rate lasts longer.
        let bent = self.acceleration * (bent_s * bent_s / 2.0 + bent_s * (rate_s - bent_s));
        Turned {
            later_from_earlier: UnitQuaternion::from_scaled_axis(-(self.rate * rate_s + bent)),
            covariance: self.doubt(ahead_s),
        }
    }

    /// Rotation in the seconds before this knot, extrapolated from its motion.
    fn back_to(&self, before_s: f64) -> Turned {
        Turned {
            later_from_earlier: UnitQuaternion::from_scaled_axis(
                -self.rate * before_s.min(RATE_LASTS_S),
            ),
            covariance: self.doubt(before_s),
        }
    }

    /// Covariance of an extrapolated rotation after this many seconds.
    fn doubt(&self, over_s: f64) -> Matrix3<f64> {
        let jerk = JERK * JERK * over_s.powi(5) / 20.0;
        self.rate_covariance * (over_s * over_s) + Matrix3::from_diagonal_element(jerk)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A camera that rolls, pitches and yaws: `world_from_camera`.
    fn flown(at_s: f64) -> UnitQuaternion<f64> {
        let swing = |hz: f64, start: f64| 0.26 * (std::f64::consts::TAU * hz * at_s + start).sin();
        UnitQuaternion::from_euler_angles(swing(0.6, 0.0), swing(0.5, 1.0), 1.2 * at_s)
    }

    fn turn(earlier_s: f64, later_s: f64) -> CameraTurn {
        let step = 1e-5;
        let rate = (flown(later_s - step).inverse() * flown(later_s + step)).scaled_axis();
        CameraTurn {
            earlier_s,
            later_s,
            later_from_earlier: flown(later_s).inverse() * flown(earlier_s),
            covariance: Matrix3::from_diagonal_element(1e-7),
            rate_in_camera: rate / (2.0 * step),
            rate_covariance: Matrix3::from_diagonal_element(1e-4),
            ahead: None,
        }
    }

    fn followed(until: u32) -> EgoRotation {
        let mut ego = EgoRotation::new(2.0);
        (1..=until).for_each(|k| ego.add(&turn(f64::from(k - 1) / 30.0, f64::from(k) / 30.0)));
        ego
    }

    #[test]
    fn a_camera_of_which_nothing_is_known_does_not_turn() {
        let ego = EgoRotation::new(2.0);
        let turned = ego.between(1.0, 3.0);
        assert_eq!(turned, Turned::none());
        assert_eq!((ego.rate_at(2.0), ego.known_until_s()), (Vector3::zeros(), None));
    }

    proptest! {
        #[test]
        fn turns_between_any_times_are_those_flown(earlier in 0.0..2.0f64, way in 0.0..2.0f64) {
            let later = (earlier + way).min(2.0);
            let found = followed(60).between(earlier, later);
            let truth = flown(later).inverse() * flown(earlier);
            // Between knots a constant rate is assumed.
            prop_assert!(found.later_from_earlier.angle_to(&truth) < 0.004);
            let deviation = found.covariance.trace().sqrt();
            prop_assert!(deviation <= (3.0 * 1e-7 * (30.0 * way + 2.0)).sqrt() + 1e-9);
        }

        #[test]
        fn the_next_frame_is_foreseen_to_a_fraction_of_a_pixel(frame in 5u32..55) {
            let (last, next) = (f64::from(frame) / 30.0, f64::from(frame + 1) / 30.0);
            let found = followed(frame).between(last, next);
            let truth = flown(next).inverse() * flown(last);
            let pixel = std::f64::consts::TAU / 3840.0;
            prop_assert!(found.later_from_earlier.angle_to(&truth) < 0.25 * pixel);
            prop_assert!((followed(frame).rate_at(next) - turn(last, next).rate_in_camera).norm() < 0.05);
        }
    }

    #[test]
    fn doubt_grows_where_nothing_is_known() {
        let ego = followed(30);
        let deviation = |later_s: f64| ego.between(1.0, later_s).covariance.trace().sqrt();
        assert!(deviation(1.1) < deviation(1.5) && deviation(1.5) < deviation(2.0));
        // A manoeuvre of half a second may be anything up to some 15 degrees.
        assert!((0.05..0.4).contains(&deviation(1.5)), "{}", deviation(1.5));
    }

    #[test]
    fn frames_that_nothing_is_known_of_are_bridged() {
        let mut ego = followed(30);
        ego.add(&turn(34.0 / 30.0, 35.0 / 30.0));
        let found = ego.between(1.0, 35.0 / 30.0);
        let truth = flown(35.0 / 30.0).inverse() * flown(1.0);
        let off = found.later_from_earlier.angle_to(&truth);
        assert!(off < 3.0 * found.covariance.trace().sqrt() && off > 0.0, "{off}");
    }

    #[test]
    fn an_inertial_sensor_knows_more_until_the_next_picture() {
        let (later_s, until_s) = (31.0 / 30.0, 1.28);
        let now = turn(later_s, until_s);
        let ahead = TurnAhead {
            until_s,
            ahead_from_later: now.later_from_earlier,
            covariance: now.covariance,
            rate_in_camera: now.rate_in_camera,
            rate_covariance: now.rate_covariance,
        };
        let mut ego = followed(30);
        ego.add(&CameraTurn { ahead: Some(ahead), ..turn(1.0, later_s) });
        assert_eq!(ego.known_until_s(), Some(until_s));
        let off = |ego: &EgoRotation, to_s: f64| {
            let truth = flown(to_s).inverse() * flown(1.0);
            ego.between(1.0, to_s).later_from_earlier.angle_to(&truth)
        };
        let mut without = followed(30);
        without.add(&turn(1.0, later_s));
        assert!(off(&ego, until_s) < 1e-6, "{}", off(&ego, until_s));
        assert!(off(&without, until_s) > 0.005, "{}", off(&without, until_s));
        assert!(off(&ego, 1.3) < 0.1 * off(&without, 1.3));
        let doubt = |ego: &EgoRotation| ego.between(1.0, 1.3).covariance.trace();
        assert!(doubt(&ego) < 0.01 * doubt(&without));
        // A repeated picture changes nothing. The next picture replaces what was known ahead.
        let before = ego.clone();
        ego.add(&turn(1.0, later_s));
        assert_eq!(ego, before);
        ego.add(&turn(later_s, 32.0 / 30.0));
        without.add(&turn(later_s, 32.0 / 30.0));
        assert_eq!(ego, without);
    }

    #[test]
    fn a_turn_counts_once_and_a_clock_that_jumps_begins_anew() {
        let mut ego = followed(30);
        let before = ego.clone();
        ego.add(&turn(0.5, 1.0));
        assert_eq!(ego, before);
        // Half of this turn is known.
        ego.add(&turn(29.0 / 30.0, 31.0 / 30.0));
        let truth = flown(31.0 / 30.0).inverse() * flown(0.9);
        assert!(ego.between(0.9, 31.0 / 30.0).later_from_earlier.angle_to(&truth) < 0.004);
        ego.add(&turn(0.5, 0.6));
        assert_eq!(ego.known_until_s(), Some(0.6));
        // Nothing of before is used: the turn at that time is not known any more.
        assert!(
            ego.between(0.6, 0.9).covariance.trace() > before.between(0.6, 0.9).covariance.trace()
        );
    }
}
