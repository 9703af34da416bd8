//! `flockeye calibrate latency`: how late a camera's frames arrive, by the gyroscope.
//!
//! A camera that stamps nothing is taken to expose when its frames arrive. Picture and gyroscope see the same
//! turning, so the time by which the picture's is late is the latency: that of a sensor whose own clock is right.

use crate::calibration::sensor::SensorCalibration;
use flockeye_cli::Screen;
use serde_json::{Value, json};

use super::imu::{self, CalibrateImuArguments};

/// The turning that an error is stated for, degrees a second: a drone in gusts.
const TURNING_DEG_S: f64 = 30.0;
/// The distance that an error is stated for, metres.
const DISTANCE_M: f64 = 1.5;
/// The speed of a neighbour that an error is stated for, metres a second.
const SPEED_M_S: f64 = 1.0;

/// Flies with the sensor beside the picture, and prints the camera's latency.
///
/// # Errors
/// As [`imu::run`].
pub fn run(arguments: &CalibrateImuArguments) -> anyhow::Result<()> {
    let known_ms = arguments.configuration.load()?.inertial.time_offset_ms;
    let found = imu::fly(arguments, &["camera.latency_ms=0"])?;
    let latency = Latency::of(&found, known_ms);
    let mut screen = Screen::new();
    match arguments.json {
        true => screen.line(&serde_json::to_string_pretty(&latency.as_json())?),
        false => screen.line(&latency.text()),
    }
    Ok(())
}

/// What was found.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Latency {
    latency_ms: f64,
    deviation_ms: f64,
    comparisons: usize,
}

impl Latency {
    /// Latency by a sensor whose own time offset is known to be `known_ms`.
    fn of(found: &SensorCalibration, known_ms: f64) -> Self {
        Self {
            latency_ms: found.time_offset_s * 1e3 - known_ms,
            deviation_ms: found.offset_deviation_s * 1e3,
            comparisons: found.comparisons,
        }
    }

    /// What the deviation makes of a neighbour's position, millimetres: while this drone turns, and while the
    /// neighbour flies by.
    fn errors_mm(&self) -> [f64; 2] {
        let deviation_s = self.deviation_ms * 1e-3;
        [TURNING_DEG_S.to_radians() * DISTANCE_M, SPEED_M_S].map(|speed| speed * deviation_s * 1e3)
    }

    fn as_json(&self) -> Value {
        let [turning, flying] = self.errors_mm();
        json!({
            "latency_ms": self.latency_ms,
            "deviation_ms": self.deviation_ms,
            "error_turning_mm": turning,
            "error_flying_mm": flying,
            "comparisons": self.comparisons,
        })
    }

    fn text(&self) -> String {
        let [turning, flying] = self.errors_mm();
        let Self { latency_ms, deviation_ms, comparisons } = self;
        let mut text = format!(
            "{comparisons} comparisons of sensor and picture\n\
             latency      {latency_ms:.2} ms, +- {deviation_ms:.2}\n\
             it leaves    {turning:.1} mm at {DISTANCE_M} m while this drone turns by {TURNING_DEG_S} degrees/s, \
             {flying:.1} mm while a neighbour flies by at {SPEED_M_S} m/s\n\
             for pipeline.yaml:\n\
             camera:\n  latency_ms: {latency_ms:.2}"
        );
        if *latency_ms < 0.0 {
            text += "\n# Frames cannot arrive before they are exposed: the sensor's own clock is late. Cure: \
                     inertial.time_offset_ms, if it is known";
        }
        text
    }
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
        let latency = Latency::of(&found, 5.0);
        assert!((latency.latency_ms - 250.0).abs() < 1e-9);
        let [turning, flying] = latency.errors_mm();
        // 0.524 rad/s at 1.5 m, and 1 m/s, for 2 ms.
        assert!((turning - 1.571).abs() < 1e-3 && (flying - 2.0).abs() < 1e-9);
        let printed = latency.text();
        let yaml = printed.split_once("for pipeline.yaml:\n").unwrap().1;
        assert_eq!(Pipeline::parse(yaml, &[], "x").unwrap().camera.latency_ms, 250.0);
        let early = Latency { latency_ms: -3.0, ..latency };
        assert!(early.text().contains("the sensor's own clock is late"));
    }
}
