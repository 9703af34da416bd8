//! Numbers as they are written into reports, and the checks of those that are read.

use super::WireError;

/// `x` with `digits` significant decimal digits, which keeps the JSON short.
pub(super) fn to_digits(x: f64, digits: i32) -> f64 {
    if x == 0.0 || !x.is_finite() {
        return x;
    }
    let scale = 10f64.powi(digits - 1 - x.abs().log10().floor() as i32);
    if scale.is_finite() && scale > 0.0 { (x * scale).round() / scale } else { x }
}

/// `x` to millionths: micrometres and microradians.
pub(super) fn to_millionths(x: f64) -> f64 {
    if x.is_finite() && x.abs() < 1e9 { (x * 1e6).round() / 1e6 } else { x }
}

/// Refuses numbers that are none.
pub(super) fn check_finite(what: &'static str, numbers: &[f64]) -> Result<(), WireError> {
    if numbers.iter().all(|x| x.is_finite()) { Ok(()) } else { Err(WireError::Number { what }) }
}

/// Refuses what is no unit quaternion.
pub(super) fn check_rotation(what: &'static str, quaternion: &[f64; 4]) -> Result<(), WireError> {
    let norm = quaternion.iter().map(|q| q * q).sum::<f64>().sqrt();
    // NaN compares false, so it is refused here too.
    let is_unit = (norm - 1.0).abs() < 1e-3;
    if is_unit { Ok(()) } else { Err(WireError::Number { what }) }
}

/// Index of each variance in the upper triangle of a 6x6 matrix, row by row.
const DIAGONAL: [usize; 6] = [0, 6, 11, 15, 18, 20];

/// Refuses a covariance with numbers that are none, or with variances that are negative.
pub(super) fn check_covariance(what: &'static str, upper: &[f64; 21]) -> Result<(), WireError> {
    let has_variances = DIAGONAL.iter().all(|&index| upper[index] >= 0.0);
    if has_variances && upper.iter().all(|x| x.is_finite()) {
        Ok(())
    } else {
        Err(WireError::Number { what })
    }
}
