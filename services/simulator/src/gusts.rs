//! How a drone leans and sways in gusts.
//!
//! A multirotor keeps its place by leaning against the wind, and never quite succeeds: its thrust
//! points along gravity, wind and its own acceleration together. So lean and sway belong to each
//! other: a share of the lean is acceleration, the rest works against the wind.

use std::f64::consts::TAU;

use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use crate::scatter::mix;

/// Gravity, m/s^2.
pub(crate) const GRAVITY: f64 = 9.81;
/// Share of the lean that accelerates the drone.
const ACCELERATING: f64 = 0.4;
/// Slowest and fastest swing, Hz: what a small multirotor's position control leaves over.
const SWINGS_HZ: [f64; 2] = [0.45, 0.8];
/// Shares of the swings in the whole.
const SHARES: [f64; 3] = [0.5, 0.3, 0.2];

/// A sum of swings of random phase and frequency.
#[derive(Debug, Clone, PartialEq)]
struct Swings {
    /// Amplitude, radians per second, phase.
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

    /// What has this as its second derivative, and swings about 0.
    fn twice_integrated(&self, time_s: f64) -> f64 {
        let term =
            |[size, fast, phase]: &[f64; 3]| -size / (fast * fast) * (fast * time_s + phase).sin();
        self.terms.iter().map(term).sum()
    }

    /// What has this as its derivative, less its value at time 0.
    fn integrated(&self, time_s: f64) -> f64 {
        let term = |[size, fast, phase]: &[f64; 3]| {
            size / fast * (phase.cos() - (fast * time_s + phase).cos())
        };
        self.terms.iter().map(term).sum()
    }
}

#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Gusts {
    /// Lean along the world's x and y: horizontal thrust over vertical.
    lean: [Swings; 2],
    /// Rate of the yaw, rad/s.
    yaw_rate: Swings,
}

impl Gusts {
    /// Gusts that make a drone lean by `tilt_rad` at most, and yaw by up to `yaw_rad_s` more or
    /// less than it would. `drone` tells those of one world apart.
    pub(crate) fn draw(seed: u64, drone: u64, tilt_rad: f64, yaw_rad_s: f64) -> Self {
        let mut random = StdRng::seed_from_u64(mix(seed ^ mix(drone ^ 0x6775_7374)));
        // Both axes at their ends at once make the whole.
        let lean = tilt_rad.tan() / 2f64.sqrt();
        Self {
            lean: [Swings::draw(&mut random, lean), Swings::draw(&mut random, lean)],
            yaw_rate: Swings::draw(&mut random, yaw_rad_s),
        }
    }

    /// How far gusts that make it lean by `tilt_rad` bring a drone from its place at most, metres.
    pub(crate) fn reach_m(tilt_rad: f64) -> f64 {
        ACCELERATING * GRAVITY * tilt_rad.tan() / (TAU * SWINGS_HZ[0]).powi(2)
    }

    /// Where the gusts bring a drone that would be level at the origin: offset and lean in the
    /// world.
    pub(crate) fn sway(&self, time_s: f64) -> Isometry3<f64> {
        let [x, y] = &self.lean;
        let thrust = Unit::new_normalize(Vector3::new(x.value(time_s), y.value(time_s), 1.0));
        let lean = UnitQuaternion::rotation_between_axis(&Vector3::z_axis(), &thrust);
        let offset = |lean: &Swings| ACCELERATING * GRAVITY * lean.twice_integrated(time_s);
        Isometry3::from_parts(
            Translation3::new(offset(x), offset(y), 0.0),
            // Opposite only to a drone that flies upside down.
            lean.unwrap_or_else(UnitQuaternion::identity),
        )
    }

    /// Yaw that the gusts add since time 0, radians.
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
