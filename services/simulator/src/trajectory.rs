//! Paths of the bodies: smooth closed paths round the observer without collisions.

use std::f64::consts::{PI, TAU};

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

use crate::WorldError;
use crate::parameters::WorldParameters;
use crate::scatter::mix;

/// Points of a round at which speeds and clearances are checked.
const CHECKS: u32 = 4096;
/// Limit for the attempts to draw paths without collisions.
const ATTEMPTS: u32 = 48;
/// Minimum gap between two drones, metres.
const CLEARANCE_M: f64 = 0.05;

/// A periodic function of the phase, plus a linear term.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Wave {
    mean: f64,
    turns: f64,
    /// Amplitude, multiple of the phase, and start.
    terms: [[f64; 3]; 2],
}

impl Wave {
    /// A wave within `mean` +- `amplitude`, with two harmonics.
    pub(crate) fn draw(
        random: &mut StdRng,
        mean: f64,
        amplitude: f64,
        harmonics: [f64; 2],
    ) -> Self {
        let mut term = |share: f64, harmonic: f64| {
            [amplitude * share, harmonic, random.random_range(0.0..TAU)]
        };
        Self { mean, turns: 0.0, terms: [term(0.7, harmonics[0]), term(0.3, harmonics[1])] }
    }

    pub(crate) fn value(&self, phase: f64) -> f64 {
        let term = |[a, m, s]: &[f64; 3]| a * (m * phase + s).sin();
        self.mean + self.turns * phase + self.terms.iter().map(term).sum::<f64>()
    }

    fn slope(&self, phase: f64) -> f64 {
        let term = |[a, m, s]: &[f64; 3]| a * m * (m * phase + s).cos();
        self.turns + self.terms.iter().map(term).sum::<f64>()
    }
}

#[derive(Debug, Clone)]
pub(crate) struct Trajectory {
    /// Phase gained in a second, radians.
    rate: f64,
    azimuth: Wave,
    elevation: Wave,
    distance: Wave,
    heading: Wave,
    pitch: Wave,
    roll: Wave,
}

impl Trajectory {
    /// Pose of the body's markers in the world. Its origin is the camera; x is the observer's
    /// forward direction at time 0, z is up.
    pub(crate) fn world_from_markers(&self, time_s: f64) -> Isometry3<f64> {
        let phase = self.rate * time_s;
        let rotation = UnitQuaternion::from_euler_angles(
            self.roll.value(phase),
            self.pitch.value(phase),
            self.heading.value(phase),
        );
        Isometry3::from_parts(Translation3::from(self.position(phase)), rotation)
    }

    /// Velocity of the body in the world, metres per second.
    pub(crate) fn velocity(&self, time_s: f64) -> Vector3<f64> {
        self.change(self.rate * time_s) * self.rate
    }

    fn position(&self, phase: f64) -> Vector3<f64> {
        let (sin_az, cos_az) = self.azimuth.value(phase).sin_cos();
        let (sin_el, cos_el) = self.elevation.value(phase).sin_cos();
        Vector3::new(cos_el * cos_az, cos_el * sin_az, sin_el) * self.distance.value(phase)
    }

    /// Derivative of the position by the phase.
    fn change(&self, phase: f64) -> Vector3<f64> {
        let (sin_az, cos_az) = self.azimuth.value(phase).sin_cos();
        let (sin_el, cos_el) = self.elevation.value(phase).sin_cos();
        let distance = self.distance.value(phase);
        let outwards = Vector3::new(cos_el * cos_az, cos_el * sin_az, sin_el);
        let leftwards = Vector3::new(-sin_az, cos_az, 0.0) * cos_el;
        let upwards = Vector3::new(-sin_el * cos_az, -sin_el * sin_az, cos_el);
        outwards * self.distance.slope(phase)
            + leftwards * (self.azimuth.slope(phase) * distance)
            + upwards * (self.elevation.slope(phase) * distance)
    }
}

/// Draws a random path for each drone, of the given radii (metres). All paths have one period, so a
/// check of one round is sufficient.
///
/// # Errors
/// Too many bodies for the space.
pub(crate) fn draw(
    parameters: &WorldParameters,
    radii: &[f64],
) -> Result<Vec<Trajectory>, WorldError> {
    let [near, far] = parameters.distance_m;
    let phases: Vec<f64> = (0..CHECKS).map(|k| f64::from(k) * TAU / f64::from(CHECKS)).collect();
    for attempt in 0..ATTEMPTS {
        // Each attempt has smaller amplitudes; the last has plain circles at equal spacing.
        let liveliness = 1.0 - f64::from(attempt) / f64::from(ATTEMPTS - 1);
        let seed = mix(parameters.seed ^ u64::from(attempt) << 32 ^ 0x7761_7973);
        let mut random = StdRng::seed_from_u64(seed);
        let mut ways = draw_once(&mut random, radii.len(), [near, far], liveliness);
        if !keep_apart(&ways, radii, &phases) {
            continue;
        }
        let fastest = ways
            .iter()
            .flat_map(|way| phases.iter().map(|&phase| way.change(phase).norm()))
            .fold(0.0, f64::max);
        ways.iter_mut().for_each(|way| way.rate = parameters.speed_m_s / fastest);
        return Ok(ways);
    }
    Err(WorldError::Crowded { bodies: radii.len(), near, far })
}

fn draw_once(
    random: &mut StdRng,
    count: usize,
    [near, far]: [f64; 2],
    liveliness: f64,
) -> Vec<Trajectory> {
    let start = random.random_range(0.0..TAU);
    let sense = if random.random_bool(0.5) { 1.0 } else { -1.0 };
    (0..count)
        .map(|k| {
            let place = start + k as f64 * TAU / count as f64;
            let mut azimuth = Wave::draw(random, place, 0.35 * liveliness, [3.0, 4.0]);
            azimuth.turns = 2.0 * sense;
            // Range: from slightly above the observer's legs to nearly overhead.
            let elevation = Wave::draw(random, 0.38, 0.95 * liveliness, [3.0, 5.0]);
            let reach = (far - near) / 2.0 * if count == 1 { 1.0 } else { liveliness };
            let distance = Wave::draw(random, (near + far) / 2.0, reach, [2.0, 5.0]);
            let any_heading = random.random_range(-PI..PI);
            let mut heading = Wave::draw(random, any_heading, 0.8, [1.0, 3.0]);
            heading.turns = if random.random_bool(0.5) { 1.0 } else { -1.0 };
            let pitch = Wave::draw(random, 0.0, 0.2, [4.0, 7.0]);
            let roll = Wave::draw(random, 0.0, 0.2, [3.0, 6.0]);
            Trajectory { rate: 1.0, azimuth, elevation, distance, heading, pitch, roll }
        })
        .collect()
}

fn keep_apart(ways: &[Trajectory], radii: &[f64], phases: &[f64]) -> bool {
    phases.iter().all(|&phase| {
        let at: Vec<Vector3<f64>> = ways.iter().map(|way| way.position(phase)).collect();
        (0..at.len())
            .all(|a| (0..a).all(|b| (at[a] - at[b]).norm() > radii[a] + radii[b] + CLEARANCE_M))
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;

    fn ways(seed: u64, count: usize) -> Vec<Trajectory> {
        let parameters = WorldParameters { seed, ..Default::default() };
        draw(&parameters, &vec![0.21; count]).unwrap()
    }

    #[test]
    fn a_body_stays_in_its_range_and_below_its_speed_and_goes_all_round() {
        for seed in 0..20 {
            let way = &ways(seed, 1)[0];
            let period = TAU / way.rate;
            let (mut fastest, mut highest) = (0.0f64, 0.0f64);
            let mut quarters = [false; 4];
            for k in 0..2000 {
                let time = f64::from(k) / 2000.0 * period;
                let position = way.world_from_markers(time).translation.vector;
                assert!((0.6 - 1e-9..=2.0 + 1e-9).contains(&position.norm()));
                fastest = fastest.max(way.velocity(time).norm());
                highest = highest.max((position.z / position.norm()).asin());
                let azimuth = position.y.atan2(position.x).rem_euclid(TAU);
                quarters[(azimuth / TAU * 4.0) as usize % 4] = true;
            }
            assert!(fastest <= 0.8 + 1e-3 && fastest > 0.7, "{fastest}");
            assert!(highest.to_degrees() > 55.0, "{}", highest.to_degrees());
            assert_eq!(quarters, [true; 4]);
        }
    }

    #[test]
    fn velocity_is_the_derivative_of_position() {
        let way = &ways(3, 1)[0];
        for k in 0..50 {
            let time = f64::from(k) * 0.77;
            let at = |t: f64| way.world_from_markers(t).translation.vector;
            let measured = (at(time + 1e-4) - at(time - 1e-4)) / 2e-4;
            assert!((measured - way.velocity(time)).norm() < 1e-6);
        }
    }

    #[test]
    fn four_bodies_keep_apart() {
        for seed in 0..8 {
            let ways = ways(seed, 4);
            let period = TAU / ways[0].rate;
            for k in 0..1000 {
                let time = f64::from(k) / 999.0 * period;
                let at: Vec<_> =
                    ways.iter().map(|w| w.world_from_markers(time).translation.vector).collect();
                for (a, p) in at.iter().enumerate() {
                    assert!(at[..a].iter().all(|q| (p - q).norm() > 0.45), "seed {seed} at {time}");
                }
            }
        }
    }

    #[test]
    fn a_swarm_that_does_not_fit_is_refused() {
        let error = draw(&WorldParameters::default(), &[0.21; 60]).unwrap_err();
        assert!(error.to_string().contains("60 bodies"), "{error}");
    }

    #[test]
    fn seeds_repeat() {
        let pose = |seed| ways(seed, 1)[0].world_from_markers(7.0);
        assert_eq!(pose(4), pose(4));
        assert_ne!(pose(4), pose(5));
    }
}
