//! `flockeye calibrate latency`: the latency of a camera's frames, measured with the gyroscope.
//!
//! Frames of a camera without timestamps are assumed to be exposed on arrival. Picture and
//! gyroscope measure the same rotation. So the delay of the picture's rotation is the latency, if
//! the sensor's own clock is right.

use crate::calibration::sensor::SensorCalibration;
use serde_json::{Value, json};

use super::imu::{self, CalibrateImuArguments};
use super::show;

/// Angular velocity for which the error is stated, degrees/s: a drone in gusts.
const TURNING_DEG_S: f64 = 30.0;
/// Distance for which the error is stated, metres.
const DISTANCE_M: f64 = 1.5;
/// Speed of a neighbour for which the error is stated, m/s.
const SPEED_M_S: f64 = 1.0;

/// Runs the pipeline with the sensor, and prints the camera's latency.
pub(crate) fn run(arguments: &CalibrateImuArguments) -> anyhow::Result<()> {
    let known_ms = arguments.configuration.load()?.inertial.time_offset_ms;
    let found = imu::fly(arguments, &["camera.latency_ms=0"])?;
    let latency_ms = latency_ms(&found, known_ms);
    show(arguments.json, || as_json(&found, latency_ms), || text(&found, latency_ms))
}

/// The latency, measured by a sensor whose own time offset is `known_ms`.
fn latency_ms(found: &SensorCalibration, known_ms: f64) -> f64 {
    found.time_offset_s * 1e3 - known_ms
}

/// Position errors of a neighbour due to the latency's deviation, millimetres: while this drone
/// turns, and while the neighbour flies by.
fn errors_mm(deviation_ms: f64) -> [f64; 2] {
    let deviation_s = deviation_ms * 1e-3;
    [TURNING_DEG_S.to_radians() * DISTANCE_M, SPEED_M_S].map(|speed| speed * deviation_s * 1e3)
}

fn as_json(found: &SensorCalibration, latency_ms: f64) -> Value {
    let deviation_ms = found.offset_deviation_s * 1e3;
    let [turning, flying] = errors_mm(deviation_ms);
    json!({
        "latency_ms": latency_ms,
        "deviation_ms": deviation_ms,
        "error_turning_mm": turning,
        "error_flying_mm": flying,
        "comparisons": found.comparisons,
    })
}

fn text(found: &SensorCalibration, latency_ms: f64) -> String {
    let deviation_ms = found.offset_deviation_s * 1e3;
    let [turning, flying] = errors_mm(deviation_ms);
    let mut text = format!(
        "{} comparisons of sensor and picture\n\
         latency      {latency_ms:.2} ms, +- {deviation_ms:.2}\n\
         it leaves    {turning:.1} mm at {DISTANCE_M} m while this drone turns by {TURNING_DEG_S} degrees/s, \
         {flying:.1} mm while a neighbour flies by at {SPEED_M_S} m/s\n\
         for pipeline.yaml:\n\
         camera:\n  latency_ms: {latency_ms:.2}",
        found.comparisons
    );
    if latency_ms < 0.0 {
        text += "\n# Frames cannot arrive before they are exposed: the sensor's own clock is late. Cure: \
                 inertial.time_offset_ms, if it is known";
    }
    text
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use flockeye_config::Pipeline;

    #[test]
    fn a_known_offset_of_the_sensor_is_not_the_cameras_latency() {
        let found = SensorCalibration {
            camera_from_sensor: nalgebra::UnitQuaternion::identity(),
            time_offset_s: 0.255,
            bias: nalgebra::Vector3::zeros(),
            mounting_deviation: nalgebra::Vector3::zeros(),
            offset_deviation_s: 0.002,
            residual: 0.01,
            comparisons: 800,
        };
        let latency_ms = latency_ms(&found, 5.0);
        assert!((latency_ms - 250.0).abs() < 1e-9);
        let [turning, flying] = errors_mm(2.0);
        // 0.524 rad/s at 1.5 m, and 1 m/s, for 2 ms.
        assert!((turning - 1.571).abs() < 1e-3 && (flying - 2.0).abs() < 1e-9);
        let printed = text(&found, latency_ms);
        let yaml = printed.split_once("for pipeline.yaml:\n").unwrap().1;
        assert_eq!(Pipeline::parse(yaml, &[], "x").unwrap().camera.latency_ms, 250.0);
        assert!(text(&found, -3.0).contains("the sensor's own clock is late"));
    }
}
