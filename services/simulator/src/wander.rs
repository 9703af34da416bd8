//! Where the drones of a swarm fly: each near its own place on a ring, the same whoever looks.

use std::f64::consts::{PI, TAU};

use nalgebra::Vector3;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use crate::parameters::WorldParameters;
use crate::scatter::mix;
use crate::trajectory::Wave;

/// Multiples of its round in which a drone swings.
const HARMONICS: [f64; 2] = [2.0, 5.0];
/// Share of the greatest speed at which a drone flies: two that fly against each other have twice
/// that.
const PACE: f64 = 0.25;

/// A drone's way near its place on the ring.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Wander {
    place: Vector3<f64>,
    axes: [Wave; 3],
    /// Phase gained in a second, radians.
    rate: f64,
    /// Its yaw at time 0, radians.
    pub(crate) start_yaw: f64,
    /// Sense of the turn: to the left (1) or to the right (-1).
    pub(crate) sense: f64,
}

impl Wander {
    /// That of drone `drone` of `drones`. Those side by side on the ring stay as far from each
    /// other as `distance_m` says, all others farther.
    pub(crate) fn draw(parameters: &WorldParameters, drone: u32, drones: u32) -> Self {
        let seed = mix(parameters.seed ^ mix(u64::from(drone) ^ 0x7761_6e64));
        let mut random = StdRng::seed_from_u64(seed);
        let [near, far] = parameters.distance_m;
        let radius = (near + far) / 4.0 / (PI / f64::from(drones)).sin();
        let azimuth = TAU * f64::from(drone) / f64::from(drones);
        // Two of these lie between near and far, along any direction.
        let reach = (far - near) / 4.0;
        let mut axis = || Wave::draw(&mut random, 0.0, reach / 3f64.sqrt(), HARMONICS);
        let axes = [axis(), axis(), axis()];
        // No wave changes faster than its amplitude times its faster harmonic.
        let rate = PACE * parameters.speed_m_s / (reach * HARMONICS[1]).max(f64::MIN_POSITIVE);
        Self {
            place: Vector3::new(azimuth.cos(), azimuth.sin(), 0.0) * radius,
            axes,
            rate: rate.min(1.0),
            start_yaw: random.random_range(-PI..PI),
            sense: if random.random_bool(0.5) { 1.0 } else { -1.0 },
        }
    }

    /// Position at a time, metres.
    pub(crate) fn position(&self, time_s: f64) -> Vector3<f64> {
        let phase = self.rate * time_s;
        self.place + Vector3::from_fn(|axis, _| self.axes[axis].value(phase))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn those_side_by_side_stay_in_their_range_and_below_their_speed() {
        for (seed, drones) in [(1, 2), (2, 3), (3, 4), (4, 8)] {
            let parameters =
                WorldParameters { seed, distance_m: [0.7, 1.3], ..WorldParameters::default() };
            let ways: Vec<Wander> =
                (0..drones).map(|drone| Wander::draw(&parameters, drone, drones)).collect();
            let (mut nearest, mut farthest) = (f64::INFINITY, 0.0_f64);
            for k in 0..4000 {
                let time_s = f64::from(k) * 0.05;
                for (at, way) in ways.iter().enumerate() {
                    let next = &ways[(at + 1) % ways.len()];
                    let apart = (way.position(time_s) - next.position(time_s)).norm();
                    assert!((0.7..=1.3).contains(&apart), "{apart} m at {time_s} s");
                    (nearest, farthest) = (nearest.min(apart), farthest.max(apart));
                    let moved = way.position(time_s + 0.01) - way.position(time_s);
                    assert!(moved.norm() / 0.01 <= 0.2 + 1e-9, "{} m/s", moved.norm() / 0.01);
                }
            }
            assert!(nearest < 0.95 && farthest > 1.05, "{nearest} to {farthest} m");
        }
    }
}
