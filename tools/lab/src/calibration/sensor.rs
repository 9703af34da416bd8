//! Mounting, time offset and bias of an inertial sensor, from a flight without prior knowledge.
//!
//! For each time offset within [`SEARCHED_S`], mounting and bias have a closed-form solution
//! (Kabsch, Acta Crystallographica A32, 1976). It minimizes the difference from the picture's
//! rates. Gauss-Newton steps over all seven unknowns refine the solution of the best offset. Their
//! normal matrix gives the deviations.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};

use super::error::{CalibrationError, LEAST_FRAMES, SEARCHED_S};
use flockeye_geometry::inertial::RateRecord;
use flockeye_geometry::inertial::errors::{Matrix7, Vector7, by_errors};

/// The first search's step, seconds: rates of drones change slowly over it.
const STEP_S: f64 = 0.005;
/// Steps of refinement. The closed form is within milliseconds and tenths of degrees already.
const REFINEMENTS: usize = 5;
/// Deviations beyond which a residual counts as the picture's error and is left out.
const OUTLIER: f64 = 4.0;
/// Largest remaining share of the rates' variation if sensor and picture belong together.
const UNRELATED: f64 = 0.5;

/// Axes count as mirrored if they reduce the residual by this factor.
const MIRRORED: f64 = 4.0;

/// The camera's rotation between two frames, measured in the picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TurnSeen {
    /// Exposure of the earlier frame, seconds.
    pub earlier_s: f64,
    /// Exposure of the later frame, seconds.
    pub later_s: f64,
    /// Mean angular velocity between the two, in the camera's axes, rad/s.
    pub rate: Vector3<f64>,
}

/// The result for a sensor.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct SensorCalibration {
    /// Turns the sensor's axes into the camera's.
    pub camera_from_sensor: UnitQuaternion<f64>,
    /// Offset from the sensor's time to the camera's time, seconds.
    pub time_offset_s: f64,
    /// Bias of the rates along the camera's axes, rad/s.
    pub bias: Vector3<f64>,
    /// Standard deviations of the mounting about the camera's axes, radians.
    pub mounting_deviation: Vector3<f64>,
    /// Standard deviation of the time offset, seconds.
    pub offset_deviation_s: f64,
    /// Root mean square of the residual between picture and sensor about each axis, rad/s.
    pub residual: f64,
    /// Number of comparisons that were used.
    pub comparisons: usize,
}

/// Mean rates of the picture and of the sensor over the same frames.
type RatePair = (TurnSeen, Vector3<f64>);

/// The closed form's solution at one time offset.
struct ClosedForm {
    rotation: Matrix3<f64>,
    bias: Vector3<f64>,
    /// Mean squared residual, and the same for mirrored axes.
    left: f64,
    left_mirrored: f64,
}

/// Finds mounting, time offset and bias of the sensor with the samples `record`, from the picture's
/// rotations in the same flight.
pub(crate) fn calibrate(
    seen: &[TurnSeen],
    record: &RateRecord,
) -> Result<SensorCalibration, CalibrationError> {
    let at = |offset_s: f64| pairs(seen, record, offset_s);
    let steps = (SEARCHED_S / STEP_S) as i32;
    let offsets = (-steps..=steps).map(|k| f64::from(k) * STEP_S);
    let mut best: Option<(f64, ClosedForm)> = None;
    let (mut most, mut least_mirrored) = (0, f64::INFINITY);
    for offset_s in offsets {
        let pairs = at(offset_s);
        most = most.max(pairs.len());
        // Offsets without half of the comparisons are skipped.
        if pairs.len() < LEAST_FRAMES.max(seen.len() / 2) {
            continue;
        }
        let fit = fit(&pairs);
        least_mirrored = fit.left_mirrored.min(least_mirrored);
        if best.as_ref().is_none_or(|(_, least)| fit.left < least.left) {
            best = Some((offset_s, fit));
        }
    }
    let Some((offset_s, fit)) = best else {
        return Err(CalibrationError::FewComparisons { found: most });
    };
    let varied = variation(&at(offset_s));
    if least_mirrored < fit.left / MIRRORED {
        return Err(CalibrationError::LeftHanded);
    }
    if fit.left > UNRELATED * varied {
        return Err(CalibrationError::SensorUnrelated { left: 100.0 * fit.left / varied });
    }
    refined(seen, record, offset_s, &fit)
}

/// Mean rates of picture and sensor over the same frames, with the sensor's time shifted by
/// `offset_s`.
fn pairs(seen: &[TurnSeen], record: &RateRecord, offset_s: f64) -> Vec<RatePair> {
    let pair = |seen: &TurnSeen| {
        let (from_s, to_s) = (seen.earlier_s - offset_s, seen.later_s - offset_s);
        let turned = record.later_from_earlier(from_s, to_s, |rate| rate)?;
        let sensor = -turned.scaled_axis() / (to_s - from_s);
        Some((*seen, sensor))
    };
    seen.iter().filter_map(pair).collect()
}

/// The rotation and the bias with the least difference between the sensor's and the picture's
/// rates.
fn fit(pairs: &[RatePair]) -> ClosedForm {
    let count = pairs.len() as f64;
    let mean_seen = pairs.iter().map(|(seen, _)| seen.rate).sum::<Vector3<f64>>() / count;
    let mean_sensor = pairs.iter().map(|(_, sensor)| sensor).sum::<Vector3<f64>>() / count;
    let together: Matrix3<f64> = pairs
        .iter()
        .map(|(seen, sensor)| (seen.rate - mean_seen) * (sensor - mean_sensor).transpose())
        .sum();
    let squares: f64 = pairs
        .iter()
        .map(|(seen, sensor)| {
            (seen.rate - mean_seen).norm_squared() + (sensor - mean_sensor).norm_squared()
        })
        .sum();
    let svd = together.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else {
        // Cannot happen: both matrices were requested.
        return ClosedForm {
            rotation: Matrix3::identity(),
            bias: Vector3::zeros(),
            left: f64::INFINITY,
            left_mirrored: f64::INFINITY,
        };
    };
    let sign = (u * v_t).determinant().signum();
    let least = svd.singular_values.imin();
    let mut signs = Vector3::repeat(1.0);
    signs[least] = sign;
    let rotation = u * Matrix3::from_diagonal(&signs) * v_t;
    let all = svd.singular_values.sum();
    let smallest = svd.singular_values[least];
    // A rotation reaches the sum of the singular values, where the smallest one has the sign of the
    // determinant.
    let left = |signed: f64| (squares - 2.0 * (all - smallest + signed * smallest)) / count;
    ClosedForm {
        rotation,
        bias: rotation * mean_sensor - mean_seen,
        left: left(sign).max(0.0),
        left_mirrored: left(-sign).max(0.0),
    }
}

/// Mean squared variation of the picture's rates.
fn variation(pairs: &[RatePair]) -> f64 {
    let count = pairs.len().max(1) as f64;
    let mean = pairs.iter().map(|(seen, _)| seen.rate).sum::<Vector3<f64>>() / count;
    pairs.iter().map(|(seen, _)| (seen.rate - mean).norm_squared()).sum::<f64>() / count
}

/// Gauss-Newton steps over bias, mounting and offset, from the closed form's solution.
fn refined(
    seen: &[TurnSeen],
    record: &RateRecord,
    mut offset_s: f64,
    fit: &ClosedForm,
) -> Result<SensorCalibration, CalibrationError> {
    let mut mounting = UnitQuaternion::from_matrix(&fit.rotation);
    let mut bias = fit.bias;
    let mut deviation = (fit.left / 3.0).sqrt();
    let (mut normal, mut used) = (Matrix7::zeros(), 0);
    for _ in 0..REFINEMENTS {
        normal = Matrix7::zeros();
        let mut right = Vector7::zeros();
        let (mut squares, mut kept) = (0.0, 0);
        let pairs = pairs(seen, record, offset_s);
        for (seen, sensor) in &pairs {
            let rate = mounting * sensor - bias;
            let off = seen.rate - rate;
            if off.norm() > OUTLIER * deviation * 3f64.sqrt() {
                continue;
            }
            let ends = [seen.earlier_s, seen.later_s].map(|at_s| record.rate_at(at_s - offset_s));
            let [Some(from), Some(to)] = ends else { continue };
            let change = mounting * (to - from) / (seen.later_s - seen.earlier_s);
            let by_errors = by_errors(&rate, 1.0, &change);
            normal += by_errors.transpose() * by_errors;
            right += by_errors.transpose() * off;
            squares += off.norm_squared();
            kept += 1;
        }
        let Some(solver) = normal.cholesky() else {
            return Err(CalibrationError::OneAxis { deviation_deg: 180.0 });
        };
        let step = solver.solve(&right);
        bias += step.fixed_rows::<3>(0);
        let turned: Vector3<f64> = step.fixed_rows::<3>(3).into();
        mounting = UnitQuaternion::from_scaled_axis(turned) * mounting;
        offset_s += step[6];
        deviation = (squares / (3.0 * f64::from(kept.max(1)))).sqrt();
        used = kept as usize;
    }
    if used < LEAST_FRAMES {
        return Err(CalibrationError::FewComparisons { found: used });
    }
    let Some(covariance) = normal.try_inverse() else {
        return Err(CalibrationError::OneAxis { deviation_deg: 180.0 });
    };
    let deviations = covariance.map_diagonal(|variance| deviation * variance.max(0.0).sqrt());
    let mounting_deviation: Vector3<f64> = deviations.fixed_rows::<3>(3).into();
    let largest_deg = mounting_deviation.max().to_degrees();
    if largest_deg > 1.0 {
        return Err(CalibrationError::OneAxis { deviation_deg: largest_deg });
    }
    Ok(SensorCalibration {
        camera_from_sensor: mounting,
        time_offset_s: offset_s,
        bias,
        mounting_deviation,
        offset_deviation_s: deviations[6],
        residual: deviation,
        comparisons: used,
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use flockeye_geometry::fixtures::flight::{flown, rate};
    use flockeye_geometry::inertial::RateSample;
    use proptest::prelude::*;

    fn noise(k: u32, size: f64) -> Vector3<f64> {
        let of = |n: u32| (f64::from(k * 3 + n) * 2.399_963).sin() * 2f64.sqrt() * size;
        Vector3::new(of(0), of(1), of(2))
    }

    fn seen(seconds: u32) -> Vec<TurnSeen> {
        let turn = |k: u32| {
            let (earlier_s, later_s) = (f64::from(k) / 30.0, f64::from(k + 1) / 30.0);
            let turned = (flown(earlier_s).inverse() * flown(later_s)).scaled_axis();
            TurnSeen { earlier_s, later_s, rate: turned * 30.0 + noise(k, 0.016) }
        };
        (30..30 + 30 * seconds).map(turn).collect()
    }

    fn record(of: impl Fn(f64) -> Vector3<f64>) -> RateRecord {
        let mut record = RateRecord::new(1000.0);
        for k in 0..3000u32 {
            let at_s = f64::from(k) / 200.0;
            record.push(RateSample { at_s, rate: of(at_s) + noise(k, 0.002) });
        }
        record
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn any_mounting_and_offset_is_found(
            turned in prop::array::uniform3(-1.8..1.8f64), offset_s in -0.6..0.6f64,
        ) {
            let camera_from_sensor = UnitQuaternion::from_scaled_axis(Vector3::from(turned));
            let bias = Vector3::new(0.01, -0.02, 0.015);
            let record = record(|at_s| camera_from_sensor.inverse() * (rate(at_s + offset_s) + bias));
            let found = calibrate(&seen(10), &record).unwrap();
            let off = found.camera_from_sensor.angle_to(&camera_from_sensor);
            prop_assert!(off < 0.006 && off < 5.0 * found.mounting_deviation.norm(), "{off}");
            let off_s = (found.time_offset_s - offset_s).abs();
            prop_assert!(off_s < 0.002 && off_s < 5.0 * found.offset_deviation_s, "{off_s}");
            prop_assert!((found.bias - bias).norm() < 0.004);
        }
    }

    #[test]
    fn what_cannot_be_calibrated_says_why() {
        let still = record(|_| Vector3::zeros());
        assert!(matches!(
            calibrate(&seen(10), &still),
            Err(CalibrationError::SensorUnrelated { .. })
        ));
        let another =
            record(|at_s| Vector3::new((3.1 * at_s).sin(), (2.3 * at_s).cos(), at_s.sin()));
        assert!(matches!(
            calibrate(&seen(10), &another),
            Err(CalibrationError::SensorUnrelated { .. })
        ));
        let mirrored = record(|at_s| rate(at_s).component_mul(&Vector3::new(1.0, -1.0, 1.0)));
        assert_eq!(calibrate(&seen(10), &mirrored), Err(CalibrationError::LeftHanded));
        let empty = RateRecord::new(1.0);
        assert_eq!(
            calibrate(&seen(10), &empty),
            Err(CalibrationError::FewComparisons { found: 0 })
        );
        assert!(calibrate(&[], &still).is_err());
        // A drone on a turntable.
        let yawing = |at_s: f64| Vector3::z() * (1.0 + at_s.sin());
        let turns: Vec<TurnSeen> = (30..200u32)
            .map(|k| {
                let (earlier_s, later_s) = (f64::from(k) / 30.0, f64::from(k + 1) / 30.0);
                let rate = yawing((earlier_s + later_s) / 2.0) + noise(k, 0.016);
                TurnSeen { earlier_s, later_s, rate }
            })
            .collect();
        let found = calibrate(&turns, &record(yawing));
        assert!(matches!(found, Err(CalibrationError::OneAxis { .. })), "{found:?}");
    }
}
