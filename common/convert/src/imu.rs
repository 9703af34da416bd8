//! Samples of an inertial sensor: messages of the contract and types of geometry.

use flockeye_contract::ImuSample;
use flockeye_geometry::inertial::RateSample;
use nalgebra::{UnitQuaternion, Vector3};

/// A sample in the camera's axes and on the camera's clock, by the configured mounting and time
/// offset (`inertial.camera_from_sensor`, `inertial.time_offset_ms`).
pub fn rate_sample(
    sample: &ImuSample,
    camera_from_sensor: &UnitQuaternion<f64>,
    time_offset_s: f64,
) -> RateSample {
    RateSample {
        at_s: sample.at_ns as f64 * 1e-9 + time_offset_s,
        rate: camera_from_sensor * Vector3::from(sample.rate),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_is_turned_and_moved_in_time() {
        let sample =
            ImuSample { at_ns: 2_000_000_000, rate: [1.0, 0.0, 0.0], ..ImuSample::default() };
        let yawed = UnitQuaternion::from_euler_angles(0.0, 0.0, std::f64::consts::FRAC_PI_2);
        let read = rate_sample(&sample, &yawed, -0.25);
        assert!((read.at_s - 1.75).abs() < 1e-12 && (read.rate - Vector3::y()).norm() < 1e-12);
    }
}
