//! Motion of the observer and its camera, from which pictures and inertial samples follow. The
//! other drones of a swarm move in the same way.

use std::f64::consts::TAU;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use crate::gusts::{GRAVITY, Gusts};
use crate::moment::Attitude;
use crate::parameters::WorldParameters;
use crate::wander::Wander;

/// Step of the finite differences for velocities, seconds.
pub(crate) const STEP_S: f64 = 1e-4;
/// Step of the finite differences for accelerations, seconds: wider, because they are second
/// differences.
const WIDE_STEP_S: f64 = 1e-3;

/// Path of a drone through the world.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct DroneMotion {
    /// Yaw at time 0, radians, and the rate of the steady yaw, rad/s.
    yaw: [f64; 2],
    /// Path of the drone without gusts; `None`: the drone stays at the world's origin.
    wander: Option<Wander>,
    /// `None` in calm air.
    gusts: Option<Gusts>,
    /// Position of the camera on the drone; the camera has the drone's orientation.
    drone_from_camera: Translation3<f64>,
}

impl DroneMotion {
    /// The observer's motion in the world of these parameters.
    pub(crate) fn of_observer(parameters: &WorldParameters) -> Self {
        let drone = parameters.swarm.map_or(0, |swarm| swarm.drone);
        let motion = Self::of_drone(parameters, drone);
        let camera = parameters.swarm.map(|swarm| Translation3::from(swarm.observer_from_camera_m));
        Self { drone_from_camera: camera.unwrap_or_else(Translation3::identity), ..motion }
    }

    /// The motion of the drone with this number in a swarm. An observer without a swarm has number
    /// 0.
    pub(crate) fn of_drone(parameters: &WorldParameters, drone: u32) -> Self {
        let [tilt, swing] = [parameters.tilt_deg, parameters.yaw_swing_deg_s].map(f64::to_radians);
        let gusts = (!parameters.is_calm())
            .then(|| Gusts::draw(parameters.seed, u64::from(drone), tilt, swing));
        let rate = parameters.observer_yaw_rate();
        let (yaw, wander) = match &parameters.swarm {
            None => ([0.0, rate], None),
            Some(swarm) => {
                let wander = Wander::draw(parameters, drone, swarm.drones);
                ([wander.start_yaw, wander.sense * rate], Some(wander))
            }
        };
        Self { yaw, wander, gusts, drone_from_camera: Translation3::identity() }
    }

    /// The drone's pose in the world at a time, seconds since the middle of frame 0's exposure.
    pub(crate) fn world_from_drone(&self, time_s: f64) -> Isometry3<f64> {
        let place = self.wander.as_ref().map(|wander| wander.position(time_s));
        let place = Translation3::from(place.unwrap_or_else(Vector3::zeros));
        let yaw = |angle: f64| UnitQuaternion::from_axis_angle(&Vector3::z_axis(), wrapped(angle));
        let steady = self.yaw[0] + self.yaw[1] * time_s;
        match &self.gusts {
            Some(gusts) => place * gusts.sway(time_s) * yaw(steady + gusts.yaw(time_s)),
            None => Isometry3::from_parts(place, yaw(steady)),
        }
    }

    /// The camera's pose in the world at a time, seconds since the middle of frame 0's exposure.
    pub(crate) fn world_from_camera(&self, time_s: f64) -> Isometry3<f64> {
        self.world_from_drone(time_s) * self.drone_from_camera
    }

    /// Orientation and angular velocity of the camera at a time.
    pub(crate) fn attitude(&self, time_s: f64) -> Attitude {
        if self.gusts.is_none() {
            let level = Attitude::level(wrapped(self.yaw[0] + self.yaw[1] * time_s));
            return Attitude { rate_in_camera: Vector3::z() * self.yaw[1], ..level };
        }
        let turned_at = |time_s: f64| self.world_from_camera(time_s).rotation;
        let turned = turned_at(time_s - STEP_S).inverse() * turned_at(time_s + STEP_S);
        Attitude {
            world_from_camera: turned_at(time_s),
            rate_in_camera: turned.scaled_axis() / (2.0 * STEP_S),
        }
    }

    /// Specific force in the camera, along its axes, m/s^2: acceleration minus gravity.
    pub(crate) fn specific_force(&self, time_s: f64) -> Vector3<f64> {
        let at = |time_s: f64| self.world_from_camera(time_s);
        let position = |time_s: f64| at(time_s).translation.vector;
        let acceleration = (position(time_s - WIDE_STEP_S) - 2.0 * position(time_s)
            + position(time_s + WIDE_STEP_S))
            / (WIDE_STEP_S * WIDE_STEP_S);
        at(time_s).rotation.inverse() * (acceleration + Vector3::z() * GRAVITY)
    }
}

/// The angle in the range -pi to pi.
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
        let motion = DroneMotion::of_observer(&parameters);
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
        let motion = DroneMotion::of_observer(&parameters);
        for k in 0..40 {
            let time_s = f64::from(k) * 0.31;
            let (now, soon) = (motion.attitude(time_s), motion.attitude(time_s + 0.01));
            let half = motion.attitude(time_s + 0.005).rate_in_camera;
            let turned = now.world_from_camera.inverse() * soon.world_from_camera;
            assert!((turned.scaled_axis() / 0.01 - half).norm() < 2e-3, "{time_s}");
            // Forty percent of the lean accelerates: the rest is wind, which the sensor feels as
            // thrust less drag. So the force along the body is near gravity's.
            let force = motion.specific_force(time_s);
            assert!((9.0..11.0).contains(&force.norm()), "{time_s}: {force}");
        }
    }
}
