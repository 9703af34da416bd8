//! The observer's inertial sensor: samples with bias, noise, a mounting rotation and a clock
//! offset.

use flockeye_config::SimulatedInertial;
use flockeye_contract::ImuSample;
use flockeye_convert::rotation;
use nalgebra::{UnitQuaternion, Vector3};
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rand_distr::StandardNormal;

use crate::drone_motion::DroneMotion;
use crate::scatter::mix;

/// Start of the sensor before the first frame, seconds.
const BEFORE_S: f64 = 0.5;

/// Ratio of the noise of the specific force to that of the rate, m/s^2 per degree/s. Typical
/// sensors: 0.03 m/s^2 and 0.1 degrees/s at 200 Hz.
const FORCE_NOISE: f64 = 0.3;

/// State of the sensor between samples.
#[derive(Debug, Clone)]
pub(crate) struct InertialSensor {
    motion: DroneMotion,
    settings: SimulatedInertial,
    sensor_from_camera: UnitQuaternion<f64>,
    /// Bias of the rate along the sensor's axes, rad/s.
    bias: Vector3<f64>,
    seed: u64,
    next: u64,
}

impl InertialSensor {
    /// A sensor on a camera with this motion; `seed` determines the signs of the bias, and the
    /// noise.
    pub(crate) fn new(motion: DroneMotion, settings: &SimulatedInertial, seed: u64) -> Self {
        let signs = mix(seed ^ 0x696d_7562);
        let sign = |k: usize| if signs >> k & 1 == 1 { 1.0 } else { -1.0 };
        Self {
            motion,
            sensor_from_camera: rotation(settings.camera_from_sensor).inverse(),
            bias: Vector3::from_fn(|k, _| sign(k) * settings.bias_deg_s.to_radians()),
            settings: settings.clone(),
            seed,
            next: 0,
        }
    }

    /// Skips samples more than [`BEFORE_S`] before a time, seconds since the middle of frame 0's
    /// exposure. A process that joins a flight starts here.
    pub(crate) fn join(&mut self, time_s: f64) {
        self.next = self.next.max((time_s * self.settings.rate_hz).max(0.0) as u64);
    }

    /// The samples from the last call until a time, seconds since the middle of frame 0's exposure.
    /// `zero_ns` is time 0 on the frames' clock.
    pub(crate) fn until(&mut self, time_s: f64, zero_ns: i64) -> Vec<ImuSample> {
        let mut samples = Vec::new();
        loop {
            let taken_s = self.next as f64 / self.settings.rate_hz - BEFORE_S;
            if taken_s > time_s {
                return samples;
            }
            samples.push(self.sample(taken_s, zero_ns));
            self.next += 1;
        }
    }

    fn sample(&self, taken_s: f64, zero_ns: i64) -> ImuSample {
        let mut random = StdRng::seed_from_u64(mix(self.seed ^ mix(self.next)));
        let mut noise =
            |size: f64| Vector3::from_fn(|_, _| random.sample::<f64, _>(StandardNormal) * size);
        let noise_deg_s = self.settings.noise_deg_s;
        let rate = self.sensor_from_camera * self.motion.attitude(taken_s).rate_in_camera
            + self.bias
            + noise(noise_deg_s.to_radians());
        let force = self.sensor_from_camera * self.motion.specific_force(taken_s)
            + noise(FORCE_NOISE * noise_deg_s);
        let stamped_s = taken_s - self.settings.time_offset_ms * 1e-3;
        ImuSample {
            at_ns: zero_ns + (stamped_s * 1e9).round() as i64,
            rate: rate.into(),
            specific_force: force.into(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::parameters::WorldParameters;

    fn sensor(settings: &SimulatedInertial) -> InertialSensor {
        let parameters =
            WorldParameters { tilt_deg: 10.0, yaw_swing_deg_s: 40.0, ..WorldParameters::default() };
        InertialSensor::new(DroneMotion::of_observer(&parameters), settings, 7)
    }

    #[test]
    fn samples_come_once_at_their_rate_and_repeat() {
        let settings = SimulatedInertial::default();
        let (mut first, mut second) = (sensor(&settings), sensor(&settings));
        let mut samples = first.until(0.0, 9_000_000_000);
        assert_eq!(samples.len(), 101);
        samples.extend(first.until(0.1, 9_000_000_000));
        assert_eq!(samples, second.until(0.1, 9_000_000_000));
        assert!(first.until(0.1, 0).is_empty());
        assert!(samples.windows(2).all(|pair| pair[1].at_ns - pair[0].at_ns == 5_000_000));
        assert_eq!(samples[100].at_ns, 9_000_000_000);
    }

    #[test]
    fn who_joins_later_has_the_samples_of_half_a_second_before_alone() {
        let settings = SimulatedInertial::default();
        let (mut all, mut late) = (sensor(&settings), sensor(&settings));
        let samples = all.until(60.0, 0);
        late.join(59.95);
        let few = late.until(60.0, 0);
        assert!((101..=112).contains(&few.len()), "{}", few.len());
        assert_eq!(few[..], samples[samples.len() - few.len()..]);
    }

    #[test]
    fn bias_noise_mounting_and_clock_are_as_set() {
        let yawed = std::f64::consts::FRAC_1_SQRT_2;
        let settings = SimulatedInertial {
            camera_from_sensor: [0.0, 0.0, yawed, yawed],
            time_offset_ms: 20.0,
            ..SimulatedInertial::default()
        };
        let mut sensor = sensor(&settings);
        let samples = sensor.until(20.0, 0);
        let camera_from_sensor = rotation(settings.camera_from_sensor);
        let (mut mean, mut squares) = (Vector3::zeros(), 0.0);
        for sample in &samples {
            let time_s = sample.at_ns as f64 * 1e-9 + 0.02;
            let rate = sensor.motion.attitude(time_s).rate_in_camera;
            let off = Vector3::from(sample.rate) - camera_from_sensor.inverse() * rate;
            mean += off / samples.len() as f64;
            squares += (off - sensor.bias).norm_squared() / (3.0 * samples.len() as f64);
            assert!((Vector3::from(sample.specific_force).norm() - 9.81).abs() < 1.2);
        }
        assert!((mean.map(f64::abs) - Vector3::repeat(0.5f64.to_radians())).norm() < 2e-4);
        assert!((squares.sqrt().to_degrees() - 0.1).abs() < 0.005, "{}", squares.sqrt());
    }
}
