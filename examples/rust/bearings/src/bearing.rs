//! The track of a neighbour of which only the direction is known.

use flockeye_contract::{MeasuredBy, Pose, StageLatency, Track, TrackState};
use nalgebra::{Isometry3, Matrix3, Matrix6, Vector3};

/// Standard deviation along the line of sight, metres.
const UNKNOWN_M: f64 = 1.0;
/// Standard deviation of the attitude, of which nothing is known, radians.
const UNKNOWN_RAD: f64 = 3.0;

/// A neighbour one metre off, along the mean of its markers' rays, which are in the camera frame.
pub fn track(
    target: u32,
    name: &str,
    observer_from_camera: &Isometry3<f64>,
    rays_in_camera: &[Vector3<f64>],
) -> Track {
    let rays = rays_in_camera.iter().map(|ray| observer_from_camera.rotation * ray);
    let count = rays.len().max(1) as f64;
    let mean = rays.clone().sum::<Vector3<f64>>() / count;
    let variance = rays.map(|ray| (ray - mean).map(|x| x * x)).sum::<Vector3<f64>>() / count;
    let across = variance.max().sqrt() / 2.0 + 1e-3;
    // Opposite rays have no mean direction; their track must still be made of numbers.
    let bearing = mean / mean.norm().max(1e-9);

    let position =
        across.powi(2) * Matrix3::identity() + UNKNOWN_M.powi(2) * bearing * bearing.transpose();
    let mut covariance = Matrix6::zeros();
    covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&position);
    covariance.fixed_view_mut::<3, 3>(3, 3).fill_diagonal(UNKNOWN_RAD.powi(2));
    let covariance = std::array::from_fn(|k| covariance[(k / 6, k % 6)]);
    let observer_from_target = Pose {
        position: (observer_from_camera.translation.vector + bearing).into(),
        ..Pose::default()
    };
    Track {
        observer_from_target,
        covariance,
        measured_observer_from_target: observer_from_target,
        measured_covariance: covariance,
        predicted_observer_from_target: observer_from_target,
        predicted_covariance: covariance,
        name: name.into(),
        target,
        state: TrackState::Measured.code(),
        measured_by: MeasuredBy::Decoded.code(),
        markers: (rays_in_camera.len() / 4) as u32,
        linear_velocity: [0.0; 3],
        angular_velocity: [0.0; 3],
        predicted_ns: 0,
        age_ns: 0,
        unseen_ns: 0,
        latency: StageLatency::default(),
        track_id: 0,
        reserved: 0,
    }
}
