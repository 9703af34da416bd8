//! A camera in gusts, for tests.

use nalgebra::{UnitQuaternion, Vector3};

/// It rolls, pitches and yaws unevenly: `world_from_camera`.
pub fn flown(at_s: f64) -> UnitQuaternion<f64> {
    let swing = |hz: f64, start: f64| 0.2 * (std::f64::consts::TAU * hz * at_s + start).sin();
    let yaw = 0.3 * at_s + 0.4 * (1.7 * at_s).sin();
    UnitQuaternion::from_euler_angles(swing(0.6, 0.0), swing(0.53, 1.0), yaw)
}

/// Its angular velocity in its own axes, rad/s.
pub fn rate(at_s: f64) -> Vector3<f64> {
    let step = 1e-5;
    (flown(at_s - step).inverse() * flown(at_s + step)).scaled_axis() / (2.0 * step)
}
