//! Lean and sway of a drone in gusts.
//!
//! A multirotor holds its position against wind by leaning, with a residual motion. Its thrust
//! balances gravity, wind and acceleration. So lean and sway are coupled: a share of the lean
//! accelerates the drone, the rest balances the wind.

use std::f64::consts::TAU;

use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use crate::scatter::mix;

/// Gravity, m/s^2.
pub(crate) const GRAVITY: f64 = 9.81;
/// Share of the lean that accelerates the drone.
const ACCELERATING: f64 = 0.4;
/// Lowest and highest frequency, Hz: the residual motion of a small multirotor's position control.
const SWINGS_HZ: [f64; 2] = [0.45, 0.8];
/// Shares of the terms in the amplitude.
const SHARES: [f64; 3] = [0.5, 0.3, 0.2];

/// A sum of sines of random phase and frequency.
#[derive(Debug, Clone, PartialEq)]
struct Swings {
    /// Amplitude, angular frequency (rad/s) and phase of each term.
    terms: [[f64; 3]; 3],
}

impl Swings {
    fn draw(random: &mut StdRng, amplitude: f64) -> Self {
        let terms = SHARES.map(|share| {
            let hz = random.random_range(SWINGS_HZ[0]..SWINGS_HZ[1]);
            [amplitude * share, TAU * hz, random.random_range(0.0..TAU)]
        });
        Self { terms }
    }

    fn value(&self, time_s: f64) -> f64 {
        self.terms.iter().map(|[size, fast, phase]| size * (fast * time_s + phase).sin()).sum()
    }

    /// Second antiderivative, with mean 0.
    fn twice_integrated(&self, time_s: f64) -> f64 {
        let term =
            |[size, fast, phase]: &[f64; 3]| -size / (fast * fast) * (fast * time_s + phase).sin();
        self.terms.iter().map(term).sum()
    }

    /// Integral from time 0.
    fn integrated(&self, time_s: f64) -> f64 {
        let term = |[size, fast, phase]: &[f64; 3]| {
            size / fast * (phase.cos() - (fast * time_s + phase).cos())
        };
        self.terms.iter().map(term).sum()
    }
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Gusts {
    /// Lean along the world's x and y: ratio of horizontal to vertical thrust.
    lean: [Swings; 2],
    /// Yaw rate, rad/s.
    yaw_rate: Swings,
}

impl Gusts {
    /// Gusts with a lean up to `tilt_rad` and a change of the yaw rate up to `yaw_rad_s`. `drone`
    /// selects different random numbers in one world.
    pub(crate) fn draw(seed: u64, drone: u64, tilt_rad: f64, yaw_rad_s: f64) -> Self {
        let mut random = StdRng::seed_from_u64(mix(seed ^ mix(drone ^ 0x6775_7374)));
        // The maximum is reached with both axes at their amplitudes.
        let lean = tilt_rad.tan() / 2f64.sqrt();
        Self {
            lean: [Swings::draw(&mut random, lean), Swings::draw(&mut random, lean)],
            yaw_rate: Swings::draw(&mut random, yaw_rad_s),
        }
    }

    /// Maximum displacement of a drone by gusts with a lean of `tilt_rad`, metres.
    pub(crate) fn reach_m(tilt_rad: f64) -> f64 {
        ACCELERATING * GRAVITY * tilt_rad.tan() / (TAU * SWINGS_HZ[0]).powi(2)
    }

    /// Offset and lean in the world of a drone that would be level at the origin without gusts.
    pub(crate) fn sway(&self, time_s: f64) -> Isometry3<f64> {
        let [x, y] = &self.lean;
        let thrust = Unit::new_normalize(Vector3::new(x.value(time_s), y.value(time_s), 1.0));
        let lean = UnitQuaternion::rotation_between_axis(&Vector3::z_axis(), &thrust);
        let offset = |lean: &Swings| ACCELERATING * GRAVITY * lean.twice_integrated(time_s);
        Isometry3::from_parts(
            Translation3::new(offset(x), offset(y), 0.0),
            // `None` only for opposite directions: a drone upside down.
            lean.unwrap_or_else(UnitQuaternion::identity),
        )
    }

    /// Yaw added by the gusts since time 0, radians.
    pub(crate) fn yaw(&self, time_s: f64) -> f64 {
        self.yaw_rate.integrated(time_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gusts(seed: u64) -> Gusts {
        Gusts::draw(seed, 0, 15f64.to_radians(), 1.0)
    }

    #[test]
    fn a_drone_leans_as_far_as_it_may_and_stays_near_its_place() {
        for seed in 0..20 {
            let (mut most_deg, mut farthest_m, mut fastest) = (0.0f64, 0.0f64, 0.0f64);
            for k in 0..6000 {
                let time_s = f64::from(k) * 0.01;
                let sway = gusts(seed).sway(time_s);
                most_deg = most_deg.max(sway.rotation.angle().to_degrees());
                farthest_m = farthest_m.max(sway.translation.vector.norm());
                let turned = gusts(seed).yaw(time_s + 1e-3) - gusts(seed).yaw(time_s - 1e-3);
                fastest = fastest.max(turned.abs() / 2e-3);
            }
            assert!((9.0..=15.0 + 1e-9).contains(&most_deg), "seed {seed}: {most_deg}");
            assert!(farthest_m < Gusts::reach_m(15f64.to_radians()), "seed {seed}: {farthest_m}");
            assert!((0.6..=1.0).contains(&fastest), "seed {seed}: {fastest}");
        }
    }

    #[test]
    fn a_drone_accelerates_the_way_it_leans() {
        let gusts = gusts(3);
        let at = |time_s: f64| gusts.sway(time_s).translation.vector;
        for k in 0..50 {
            let time_s = f64::from(k) * 0.37;
            let acceleration = (at(time_s + 1e-3) - 2.0 * at(time_s) + at(time_s - 1e-3)) / 1e-6;
            let thrust = gusts.sway(time_s).rotation * Vector3::z();
            let expected = ACCELERATING * GRAVITY * thrust.xy() / thrust.z;
            assert!((acceleration.xy() - expected).norm() < 1e-2, "{time_s}");
        }
    }

    #[test]
    fn seeds_and_drones_differ_and_calm_air_does_nothing() {
        assert_eq!(gusts(1), gusts(1));
        assert_ne!(gusts(1), gusts(2));
        assert_ne!(Gusts::draw(1, 0, 0.2, 0.0), Gusts::draw(1, 1, 0.2, 0.0));
        let calm = Gusts::draw(1, 0, 0.0, 0.0);
        assert_eq!((calm.sway(9.0), calm.yaw(9.0)), (Isometry3::identity(), 0.0));
    }
}
