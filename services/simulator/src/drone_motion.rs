//! How the observer's camera moves: what its picture shows and its inertial sensor measures.

use std::f64::consts::TAU;

use nalgebra::{Isometry3, UnitQuaternion, Vector3};

use crate::gusts::{GRAVITY, Gusts};
use crate::moment::Attitude;
use crate::parameters::WorldParameters;

/// Step of the differences that give velocities, seconds.
pub(crate) const STEP_S: f64 = 1e-4;
/// Step of the differences that give accelerations, seconds: wider, because they are taken twice.
const WIDE_STEP_S: f64 = 1e-3;

/// The camera's way through the world.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraMotion {
    /// Rate of the steady yaw, rad/s.
    yaw_rate: f64,
    /// `None` in calm air.
    gusts: Option<Gusts>,
}

impl CameraMotion {
    /// The motion in the world of these parameters.
    pub fn of(parameters: &WorldParameters) -> Self {
        let [tilt, swing] = [parameters.tilt_deg, parameters.yaw_swing_deg_s].map(f64::to_radians);
        // The observer is the first of the drones that gusts tell apart.
        let gusts = (!parameters.is_calm()).then(|| Gusts::draw(parameters.seed, 0, tilt, swing));
        Self { yaw_rate: parameters.observer_yaw_rate(), gusts }
    }

    /// The camera's pose in the world at a time, seconds since the middle of frame 0's exposure.
    pub fn world_from_camera(&self, time_s: f64) -> Isometry3<f64> {
        let yaw = |angle: f64| UnitQuaternion::from_axis_angle(&Vector3::z_axis(), wrapped(angle));
        match &self.gusts {
            Some(gusts) => gusts.sway(time_s) * yaw(self.yaw_rate * time_s + gusts.yaw(time_s)),
            None => Isometry3::from_parts(Vector3::zeros().into(), yaw(self.yaw_rate * time_s)),
        }
    }

    /// How the camera is turned at a time, and how it turns.
    pub fn attitude(&self, time_s: f64) -> Attitude {
        if self.gusts.is_none() {
            let level = Attitude::level(wrapped(self.yaw_rate * time_s));
            return Attitude { rate_in_camera: Vector3::z() * self.yaw_rate, ..level };
        }
        let turned_at = |time_s: f64| self.world_from_camera(time_s).rotation;
        let turned = turned_at(time_s - STEP_S).inverse() * turned_at(time_s + STEP_S);
        Attitude {
            world_from_camera: turned_at(time_s),
            rate_in_camera: turned.scaled_axis() / (2.0 * STEP_S),
        }
    }

    /// What an accelerometer in the camera measures, along its axes, m/s^2: acceleration less gravity.
    pub fn specific_force(&self, time_s: f64) -> Vector3<f64> {
        let at = |time_s: f64| self.world_from_camera(time_s);
        let position = |time_s: f64| at(time_s).translation.vector;
        let acceleration = (position(time_s - WIDE_STEP_S) - 2.0 * position(time_s)
            + position(time_s + WIDE_STEP_S))
            / (WIDE_STEP_S * WIDE_STEP_S);
        at(time_s).rotation.inverse() * (acceleration + Vector3::z() * GRAVITY)
    }
}

/// An angle as -pi to pi.
fn wrapped(angle: f64) -> f64 {
    angle - (angle / TAU).round() * TAU
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_camera_yaws_and_feels_gravity_alone() {
        let parameters =
            WorldParameters { observer_yaw_rate_deg_s: 30.0, ..WorldParameters::default() };
        let motion = CameraMotion::of(&parameters);
        let attitude = motion.attitude(7.0);
        assert!((attitude.yaw() - wrapped(210f64.to_radians())).abs() < 1e-9);
        assert_eq!(attitude.rate_in_camera, Vector3::z() * 30f64.to_radians());
        assert!((motion.specific_force(7.0) - Vector3::z() * GRAVITY).norm() < 1e-6);
    }

    #[test]
    fn a_camera_in_gusts_feels_its_thrust_and_turns_as_its_attitudes_do() {
        let parameters = WorldParameters {
            tilt_deg: 15.0,
            yaw_swing_deg_s: 60.0,
            seed: 4,
            ..WorldParameters::default()
        };
        let motion = CameraMotion::of(&parameters);
        for k in 0..40 {
            let time_s = f64::from(k) * 0.31;
            let (now, soon) = (motion.attitude(time_s), motion.attitude(time_s + 0.01));
            let half = motion.attitude(time_s + 0.005).rate_in_camera;
            let turned = now.world_from_camera.inverse() * soon.world_from_camera;
            assert!((turned.scaled_axis() / 0.01 - half).norm() < 2e-3, "{time_s}");
            // Forty percent of the lean accelerates: the rest is wind, which the sensor feels as thrust less
            // drag. So the force along the body is near gravity's.
            let force = motion.specific_force(time_s);
            assert!((9.0..11.0).contains(&force.norm()), "{time_s}: {force}");
        }
    }
}
