//! Paths of the drones of a swarm: each near its place on a ring, equal for all observers.

use std::f64::consts::{PI, TAU};

use nalgebra::Vector3;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use crate::parameters::WorldParameters;
use crate::scatter::mix;
use crate::trajectory::Wave;

/// Harmonics of a drone's motion.
const HARMONICS: [f64; 2] = [2.0, 5.0];
/// Share of the maximum speed at which a drone flies. Two drones that meet have twice that relative
/// speed.
const PACE: f64 = 0.25;

/// Path of a drone near its place on the ring.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Wander {
    place: Vector3<f64>,
    axes: [Wave; 3],
    /// Phase gained in a second, radians.
    rate: f64,
    /// Yaw at time 0, radians.
    pub(crate) start_yaw: f64,
    /// Sense of the rotation: left (1) or right (-1).
    pub(crate) sense: f64,
}

impl Wander {
    /// The path of drone `drone` of `drones`. Neighbours on the ring keep a distance in the range
    /// `distance_m`; other drones are farther apart.
    pub(crate) fn draw(parameters: &WorldParameters, drone: u32, drones: u32) -> Self {
        let seed = mix(parameters.seed ^ mix(u64::from(drone) ^ 0x7761_6e64));
        let mut random = StdRng::seed_from_u64(seed);
        let [near, far] = parameters.distance_m;
        let radius = (near + far) / 4.0 / (PI / f64::from(drones)).sin();
        let azimuth = TAU * f64::from(drone) / f64::from(drones);
        // Twice this amplitude fits between near and far, in any direction.
        let reach = (far - near) / 4.0;
        let mut axis = || Wave::draw(&mut random, 0.0, reach / 3f64.sqrt(), HARMONICS);
        let axes = [axis(), axis(), axis()];
        // Bound: the slope of a wave is at most its amplitude times its faster harmonic.
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
