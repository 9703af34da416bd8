//! The rotation between two frames.

use flockeye_geometry::ego_rotation::Turned;
use nalgebra::{Matrix3, SVector, UnitQuaternion, Vector3};

use super::grid::{CELL_COLUMNS, Level};
use super::normal_equations::{Gradient, NormalEquations, UNKNOWNS};
use super::own_airframe::AirframeCell;
use super::points::{MIN_POINTS, TexturePoint};

/// Steps at each level, the finest first, without an expected rotation.
const STEPS: [usize; 3] = [3, 3, 5];
/// Steps at each level with an expected rotation that is right within tenths of a degree: coarse
/// levels add little.
const EXPECTED_STEPS: [usize; 3] = [2, 2, 0];
/// Ratio of residuals on the coarsest level below which the last rotation is a better start than
/// the expected one. After a clock jump the expected rotation is too large.
const BETTER: f32 = 0.8;
/// Length below which a step is the last of a level, radians.
const SHORT_RAD: f64 = 2e-5;
/// Least scale of the residuals, code values: quantization.
const MIN_SCALE: f32 = 0.3;
/// Scales at which residuals have half the weight (Cauchy).
const CAUCHY: f32 = 2.4;
/// Share of the parallax that may appear as a rotation, because objects are not all at the one
/// distance of the translation.
const PARALLAX_SHARE: f64 = 0.07;
/// Standard deviation about each axis from interpolation on the grid, in its pixels. In simulated
/// gusts without parallax or moving texture, errors were 0.02 degrees in the median, 0.027 of a
/// pixel.
const GRID_SIGMA_PX: f64 = 0.018;
/// Sectors whose sums count as independent: columns and rows.
const SECTORS: [usize; 2] = [12, 6];

/// Mapping of a direction from the earlier frame to the later one.
#[derive(Debug, Clone, Copy)]
struct Warp {
    rotation: UnitQuaternion<f64>,
    /// Over the distance of the scene, in the earlier camera's frame.
    translation: Vector3<f64>,
    offset: f32,
    gain: f32,
}

/// The rotation from the points of an earlier frame to a later frame, both at all levels, the
/// finest first. `None` where there is too little texture.
///
/// The start is `expected` from another source. It is `last`, the previous rotation, if that fits
/// better or nothing is expected. Also returns the later less earlier code values of all points of
/// the finest level with enough points.
pub fn rotation(
    points: &[Vec<TexturePoint>],
    later: &[Level],
    expected: Option<UnitQuaternion<f64>>,
    last: UnitQuaternion<f64>,
    airframe: &[AirframeCell],
) -> Option<(Turned, Vec<f32>)> {
    let (start, steps) = match expected {
        Some(expected) if is_as_expected(points, later, &expected, &last, airframe) => {
            (expected, EXPECTED_STEPS)
        }
        _ => (last, STEPS),
    };
    let mut warp = Warp::of(start);
    let levels = points.iter().zip(later).zip(steps);
    let mut finest = None;
    for ((points, level), steps) in levels.rev() {
        let counted = counted_of(points, airframe);
        if steps == 0 || counted.len() < MIN_POINTS {
            continue;
        }
        for _ in 0..steps {
            let residuals = residuals(points, &counted, level, &warp);
            let (unknowns, _) = step(points, &counted, &residuals)?;
            warp = warp.after(&unknowns);
            if unknowns.fixed_rows::<3>(0).norm() < SHORT_RAD {
                break;
            }
        }
        finest = Some((points, level, counted));
    }
    let (points, level, counted) = finest?;
    let all: Vec<usize> = (0..points.len()).collect();
    let residuals = residuals(points, &all, level, &warp);
    let of_counted: Vec<f32> = counted.iter().map(|&index| residuals[index]).collect();
    let pixel_rad = later.first()?.pixel_rad();
    let covariance = covariance(points, &counted, &of_counted, &warp, pixel_rad)?;
    Some((Turned { later_from_earlier: warp.rotation, covariance }, residuals))
}

/// The points of a level that do not show the drone itself.
fn counted_of(points: &[TexturePoint], airframe: &[AirframeCell]) -> Vec<usize> {
    (0..points.len()).filter(|&index| !airframe[points[index].place.cell].is_airframe()).collect()
}

/// Whether the expected rotation fits the coarsest level about as well as the last one, or better.
fn is_as_expected(
    points: &[Vec<TexturePoint>],
    later: &[Level],
    expected: &UnitQuaternion<f64>,
    last: &UnitQuaternion<f64>,
    airframe: &[AirframeCell],
) -> bool {
    let (Some(points), Some(level)) = (points.last(), later.last()) else { return true };
    let counted = counted_of(points, airframe);
    if counted.len() < MIN_POINTS {
        return true;
    }
    let scale = |start: &UnitQuaternion<f64>| {
        scale_of(&residuals(points, &counted, level, &Warp::of(*start)))
    };
    scale(last) > BETTER * scale(expected)
}

impl Warp {
    fn of(rotation: UnitQuaternion<f64>) -> Self {
        Self { rotation, translation: Vector3::zeros(), offset: 0.0, gain: 1.0 }
    }

    /// The warp after a step, which moves the earlier frame's points by the inverse.
    fn after(&self, unknowns: &Gradient) -> Self {
        let turn = Vector3::new(unknowns[0], unknowns[1], unknowns[2]);
        let shift = Vector3::new(unknowns[3], unknowns[4], unknowns[5]);
        let gain = self.gain * (1.0 + unknowns[7] as f32).clamp(0.5, 2.0);
        Self {
            rotation: self.rotation * UnitQuaternion::from_scaled_axis(-turn),
            translation: self.translation - shift,
            offset: self.offset + unknowns[6] as f32,
            gain,
        }
    }
}

/// Later less earlier values of the given points.
fn residuals(points: &[TexturePoint], counted: &[usize], level: &Level, warp: &Warp) -> Vec<f32> {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the line above checked that the processor has AVX2.
        return unsafe { residuals_avx2(points, counted, level, warp) };
    }
    residuals_plain(points, counted, level, warp)
}

/// The portable code, compiled for AVX2. Its values are equal to the last bit.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn residuals_avx2(
    points: &[TexturePoint],
    counted: &[usize],
    level: &Level,
    warp: &Warp,
) -> Vec<f32> {
    residuals_plain(points, counted, level, warp)
}

/// Number of points whose places are computed together, so that the compiler can vectorize it.
const LANES: usize = 8;

#[inline(always)]
fn residuals_plain(
    points: &[TexturePoint],
    counted: &[usize],
    level: &Level,
    warp: &Warp,
) -> Vec<f32> {
    let turn = warp.rotation.to_rotation_matrix().into_inner().cast::<f32>();
    let translation = warp.translation.cast::<f32>();
    let mut residuals = Vec::with_capacity(counted.len());
    for counted in counted.chunks(LANES) {
        let mut directions = [[0.0; LANES]; 3];
        for (lane, &index) in counted.iter().enumerate() {
            let from = points[index].place.direction + translation;
            directions[0][lane] = from.x;
            directions[1][lane] = from.y;
            directions[2][lane] = from.z;
        }
        let (columns, rows) = places(&directions, &turn, level);
        for (lane, &index) in counted.iter().enumerate() {
            let point = &points[index];
            let expected = warp.gain * point.value + warp.offset;
            residuals.push(level.sample(columns[lane], rows[lane]) - expected);
        }
    }
    residuals
}

/// Columns and rows of a level for rotated directions.
#[inline(always)]
fn places(
    directions: &[[f32; LANES]; 3],
    turn: &Matrix3<f32>,
    level: &Level,
) -> ([f32; LANES], [f32; LANES]) {
    let (width, height) = (level.columns as f32, level.rows as f32);
    let (mut columns, mut rows) = ([0.0; LANES], [0.0; LANES]);
    for lane in 0..LANES {
        let [x, y, z] = [0, 1, 2].map(|axis| directions[axis][lane]);
        let there =
            [0, 1, 2].map(|row| turn[(row, 0)] * x + turn[(row, 1)] * y + turn[(row, 2)] * z);
        let longitude = angle(there[1], there[0]);
        let latitude = angle(there[2], (there[0] * there[0] + there[1] * there[1]).sqrt());
        columns[lane] = (0.5 - longitude / std::f32::consts::TAU) * width - 0.5;
        rows[lane] = (0.5 - latitude / std::f32::consts::PI) * height - 0.5;
    }
    (columns, rows)
}

/// The angle of a vector in the plane, within 2e-5 radians, which are a thousandth of a pixel: a
/// polynomial of the arc tangent from 0 to 1. It is needed twice for each point and step.
#[inline(always)]
fn angle(y: f32, x: f32) -> f32 {
    let (wide, high) = (x.abs(), y.abs());
    let t = wide.min(high) / wide.max(high).max(1e-20);
    let s = t * t;
    let mut p = -0.011_719_13_f32;
    for c in [0.052_653_32, -0.116_432_87, 0.193_543_46, -0.332_623_47, 0.999_977_26] {
        p = p * s + c;
    }
    let first = if high > wide { std::f32::consts::FRAC_PI_2 - p * t } else { p * t };
    let upper = if x < 0.0 { std::f32::consts::PI - first } else { first };
    if y < 0.0 { -upper } else { upper }
}

/// Derivative of a point's value by the unknowns.
#[inline(always)]
fn row(point: &TexturePoint) -> [f32; UNKNOWNS] {
    let turn = point.place.direction.cross(&point.gradient);
    let g = point.gradient;
    [turn.x, turn.y, turn.z, g.x, g.y, g.z, 1.0, point.value]
}

/// The scale of residuals, from the median of about a thousand of them.
fn scale_of(residuals: &[f32]) -> f32 {
    let every = residuals.len().div_ceil(1024).max(1);
    let mut sizes: Vec<f32> =
        residuals.iter().step_by(every).map(|residual| residual.abs()).collect();
    let middle = sizes.len() / 2;
    let (_, median, _) = sizes.select_nth_unstable_by(middle, f32::total_cmp);
    (1.4826 * *median).max(MIN_SCALE)
}

/// Weight of a point. Points near the poles cover less of the sphere.
#[inline(always)]
fn weight(point: &TexturePoint, residual: f32, scale: f32) -> f32 {
    point.place.cos_latitude / (1.0 + (residual / (CAUCHY * scale)).powi(2))
}

/// A step of the unknowns, and the inverse normal matrix.
fn step(
    points: &[TexturePoint],
    counted: &[usize],
    residuals: &[f32],
) -> Option<(Gradient, nalgebra::SMatrix<f64, UNKNOWNS, UNKNOWNS>)> {
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx2") {
        // SAFETY: the line above checked that the processor has AVX2.
        return unsafe { sum_avx2(points, counted, residuals) }.solve();
    }
    sum_plain(points, counted, residuals).solve()
}

/// The portable code, compiled for AVX2. Its sums are equal to the last bit.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn sum_avx2(points: &[TexturePoint], counted: &[usize], residuals: &[f32]) -> NormalEquations {
    sum_plain(points, counted, residuals)
}

#[inline(always)]
fn sum_plain(points: &[TexturePoint], counted: &[usize], residuals: &[f32]) -> NormalEquations {
    let scale = scale_of(residuals);
    let mut equations = NormalEquations::new();
    for (&index, &residual) in counted.iter().zip(residuals) {
        let point = &points[index];
        equations.add(&row(point), residual, weight(point, residual, scale));
    }
    equations
}

/// Covariance of the rotation from the scatter of the sums of sectors.
fn covariance(
    points: &[TexturePoint],
    counted: &[usize],
    residuals: &[f32],
    warp: &Warp,
    pixel_rad: f64,
) -> Option<Matrix3<f64>> {
    let scale = scale_of(residuals);
    let (_, inverse) = step(points, counted, residuals)?;
    let mut sums = vec![Gradient::zeros(); SECTORS[0] * SECTORS[1]];
    for (&index, &residual) in counted.iter().zip(residuals) {
        let point = &points[index];
        let weight = weight(point, residual, scale) * residual;
        let weighted = SVector::<f32, UNKNOWNS>::from(row(point)) * weight;
        sums[sector_of(point.place.cell)] += weighted.cast::<f64>();
    }
    let used = sums.iter().filter(|sum| sum.norm() > 0.0).count() as f64;
    if used <= UNKNOWNS as f64 {
        return None;
    }
    let scatter = sums.iter().fold(inverse * 0.0, |all, sum| all + sum * sum.transpose());
    let all = inverse * scatter * inverse * (used / (used - UNKNOWNS as f64));
    let turn = warp.rotation.to_rotation_matrix().into_inner();
    let parallax_rad = PARALLAX_SHARE * warp.translation.norm();
    let covariance = turn * all.fixed_view::<3, 3>(0, 0) * turn.transpose()
        + Matrix3::identity() * (parallax_rad.powi(2) + (GRID_SIGMA_PX * pixel_rad).powi(2));
    covariance.iter().all(|x| x.is_finite()).then_some(covariance)
}

fn sector_of(cell: usize) -> usize {
    let (row, column) = (cell / CELL_COLUMNS, cell % CELL_COLUMNS);
    let rows = CELL_COLUMNS / 2;
    row * SECTORS[1] / rows * SECTORS[0] + column * SECTORS[0] / CELL_COLUMNS
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_polynomial_is_the_arc_tangent_within_a_thousandth_of_a_pixel() {
        for k in -18_000..18_000_i16 {
            let exact = f64::from(k) * std::f64::consts::PI / 18_000.0;
            let found = angle(exact.sin() as f32, exact.cos() as f32);
            let error = (f64::from(found) - exact + std::f64::consts::PI)
                .rem_euclid(std::f64::consts::TAU)
                - std::f64::consts::PI;
            assert!(error.abs() < 2e-5, "{error} at {exact}");
        }
    }
}
