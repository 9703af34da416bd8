#![allow(clippy::unwrap_used, clippy::expect_used)]
use super::*;
use nalgebra::UnitQuaternion;
use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rand_distr::StandardNormal;

/// A camera that rolls, pitches and yaws as gusts make it: `world_from_camera`.
fn flown(at_s: f64) -> UnitQuaternion<f64> {
    let swing = |hz: f64, start: f64| 0.2 * (std::f64::consts::TAU * hz * at_s + start).sin();
    let yaw = 0.3 * at_s + 0.4 * (1.7 * at_s).sin();
    UnitQuaternion::from_euler_angles(swing(0.6, 0.0), swing(0.53, 1.0), yaw)
}

fn rate(at_s: f64) -> Vector3<f64> {
    let step = 1e-5;
    (flown(at_s - step).inverse() * flown(at_s + step)).scaled_axis() / (2.0 * step)
}

/// White noise: the same for the same number.
fn noise(k: u32, deviation: f64) -> Vector3<f64> {
    let mut random = StdRng::seed_from_u64(u64::from(k));
    Vector3::from_fn(|_, _| random.sample::<f64, _>(StandardNormal) * deviation)
}

const PICTURE_DEVIATION: f64 = 5e-4;

/// A flight of which sensor and picture are compared frame by frame.
struct Flight {
    sensor: SensorWatch,
    sample: u32,
    notices: Vec<(u32, SensorNotice)>,
    /// Errors of the picture's and of the fused rotations, radians; and what the fused ones state.
    errors: Vec<[f64; 3]>,
}

impl Flight {
    fn new() -> Self {
        let sensor = SensorWatch::new();
        Self { sensor, sample: 0, notices: Vec::new(), errors: Vec::new() }
    }

    /// Frames from one to another, where the sensor says `of` at its times.
    fn fly(&mut self, frames: std::ops::Range<u32>, of: impl Fn(f64) -> Option<Vector3<f64>>) {
        for frame in frames {
            let (earlier_s, later_s) = (f64::from(frame) / 30.0, f64::from(frame + 1) / 30.0);
            while f64::from(self.sample) / 200.0 <= later_s + 0.01 {
                let at_s = f64::from(self.sample) / 200.0;
                if let Some(rate) = of(at_s) {
                    let rate = rate + noise(self.sample, 0.0017);
                    self.sensor.push(RateSample { at_s, rate });
                }
                self.sample += 1;
            }
            let truth = flown(later_s).inverse() * flown(earlier_s);
            let off = UnitQuaternion::from_scaled_axis(noise(frame, PICTURE_DEVIATION));
            let later_from_earlier = off * truth;
            let covariance = Matrix3::from_diagonal_element(PICTURE_DEVIATION.powi(2));
            let picture = Turned { later_from_earlier, covariance };
            if let Some(corrected) = self.sensor.between(earlier_s, later_s)
                && let Some(both) =
                    self.sensor.with_picture(&corrected, &picture, later_s - earlier_s)
            {
                self.errors.push([
                    later_from_earlier.angle_to(&truth),
                    both.later_from_earlier.angle_to(&truth),
                    both.covariance.trace().sqrt(),
                ]);
            }
            self.notices.extend(self.sensor.take_notices().into_iter().map(|n| (frame, n)));
        }
    }

    fn said(&self) -> Vec<&'static str> {
        let word = |notice: &SensorNotice| match notice {
            SensorNotice::Agrees { .. } => "agrees",
            SensorNotice::Disagrees { .. } => "disagrees",
            SensorNotice::Silent => "silent",
            SensorNotice::Heard => "heard",
        };
        self.notices.iter().map(|(_, notice)| word(notice)).collect()
    }
}

/// A good sensor: a bias, and nothing else.
fn good(at_s: f64) -> Option<Vector3<f64>> {
    Some(rate(at_s) + Vector3::new(0.01, -0.008, 0.005))
}

#[test]
fn a_good_sensor_counts_soon_and_makes_the_rotation_better() {
    let mut flight = Flight::new();
    flight.fly(2..300, good);
    assert_eq!(flight.said(), ["agrees"]);
    assert!(flight.notices[0].0 < 40, "{:?}", flight.notices);
    let rms = |k: usize| {
        let squares = flight.errors.iter().map(|errors| errors[k].powi(2)).sum::<f64>();
        (squares / flight.errors.len() as f64).sqrt()
    };
    let (picture, both, stated) = (rms(0), rms(1), rms(2));
    assert!(both < 0.3 * picture, "{both} {picture}");
    assert!((0.6..1.5).contains(&(both / stated)), "{both} {stated}");
    // The rate at the exposure, and the rotation beyond it.
    let exposure_s = 10.0;
    let (found, covariance) = flight.sensor.rate(exposure_s, 0.01).unwrap();
    let off = (found - rate(exposure_s)).norm();
    assert!(off.to_degrees() < 0.3 && off < 4.0 * covariance.trace().sqrt(), "{off}");
    let (until_s, ahead) = flight.sensor.ahead(exposure_s - 0.1).unwrap();
    let truth = flown(until_s).inverse() * flown(exposure_s - 0.1);
    let off = ahead.later_from_earlier.angle_to(&truth);
    assert!(off < 1e-3 && off < 4.0 * ahead.covariance.trace().sqrt(), "{off}");
    assert_eq!(flight.sensor.ahead(exposure_s + 1.0), None);
}

#[test]
fn a_wrong_sensor_is_said_once_and_never_counts() {
    type Wrong = (&'static str, fn(f64) -> Option<Vector3<f64>>);
    let upside_down: Wrong = ("upside down", |at_s| {
        let rate = good(at_s)?;
        Some(Vector3::new(rate.x, -rate.y, -rate.z))
    });
    let negative: Wrong = ("the wrong sign", |at_s| good(at_s).map(|rate| -rate));
    let late: Wrong = ("half a second late", |at_s| good(at_s - 0.5));
    let early: Wrong = ("half a second early", |at_s| good(at_s + 0.5));
    let degrees: Wrong = ("degrees for radians", |at_s| good(at_s).map(|rate| rate * 57.3));
    let dead: Wrong = ("always zero", |_| Some(Vector3::zeros()));
    for (what, of) in [upside_down, negative, late, early, degrees, dead] {
        let mut flight = Flight::new();
        flight.fly(2..600, of);
        assert_eq!(flight.said(), ["disagrees"], "{what}: {:?}", flight.notices);
        assert!(flight.notices[0].0 < 60, "{what}: {:?}", flight.notices);
        assert!(flight.errors.is_empty(), "{what}");
        assert_eq!(flight.sensor.rate(10.0, 0.01), None, "{what}");
        assert_eq!(flight.sensor.ahead(10.0), None, "{what}");
    }
}

#[test]
fn a_sensor_that_jumps_is_left_out_and_counts_again_once_it_is_right() {
    let mut flight = Flight::new();
    flight.fly(2..100, good);
    let jumped = |at_s: f64| Some(good(at_s)? + Vector3::new(0.0, 0.6, 0.0));
    flight.fly(100..200, jumped);
    assert_eq!(flight.said(), ["agrees", "disagrees"]);
    let [_, (frame, SensorNotice::Disagrees { off })] = flight.notices[..] else { unreachable!() };
    assert!((103..110).contains(&frame), "{frame}");
    assert!((off + Vector3::new(0.0, 0.6, 0.0)).norm() < 0.1, "{off}");
    let before = flight.errors.len();
    flight.fly(200..300, good);
    assert_eq!(flight.said(), ["agrees", "disagrees", "agrees"]);
    let again = flight.notices[2].0;
    assert!((228..280).contains(&again), "{again}");
    assert!(flight.errors.len() > before);
    // A single wild sample costs its frame, and no more.
    flight.fly(300..400, |at_s| Some(good(at_s)? * if at_s == 11.0 { 50.0 } else { 1.0 }));
    assert_eq!(flight.said().len(), 3);
}

#[test]
fn a_sensor_that_stops_is_said_once_and_used_again() {
    let mut flight = Flight::new();
    flight.fly(2..100, good);
    flight.fly(100..160, |_| None);
    assert_eq!(flight.said(), ["agrees", "silent"]);
    assert!(flight.notices[1].0 < 120, "{:?}", flight.notices);
    assert_eq!(flight.sensor.ahead(160.0 / 30.0), None);
    let before = flight.errors.len();
    flight.fly(160..200, good);
    assert_eq!(flight.said(), ["agrees", "silent", "heard"]);
    assert!(flight.errors.len() > before + 30, "it still counts");
    // A sensor that never speaks.
    let mut flight = Flight::new();
    flight.fly(2..100, |_| None);
    assert_eq!(flight.said(), ["silent"]);
}

#[test]
fn a_drone_at_rest_proves_nothing() {
    let mut sensor = SensorWatch::new();
    let covariance = Matrix3::from_diagonal_element(PICTURE_DEVIATION.powi(2));
    for k in 0..300u32 {
        sensor.push(RateSample { at_s: f64::from(k) / 200.0, rate: noise(k, 0.0017) });
    }
    for frame in 2..44 {
        let (earlier_s, later_s) = (f64::from(frame) / 30.0, f64::from(frame + 1) / 30.0);
        let turned = UnitQuaternion::from_scaled_axis(noise(frame, PICTURE_DEVIATION));
        let picture = Turned { later_from_earlier: turned, covariance };
        let corrected = sensor.between(earlier_s, later_s).unwrap();
        assert_eq!(sensor.with_picture(&corrected, &picture, later_s - earlier_s), None);
    }
    assert!(sensor.take_notices().is_empty());
}
