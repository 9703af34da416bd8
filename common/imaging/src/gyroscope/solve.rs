//! The rotation between two frames.

use nalgebra::{Matrix3, SVector, UnitQuaternion, Vector3};

use super::grid::{CELL_COLUMNS, Level, Pyramid};
use super::normal_equations::{Gradient, NormalEquations, UNKNOWNS};
use super::own_airframe::OwnAirframe;
use super::points::{MIN_POINTS, Point, Points};

/// Steps at each level, the finest first.
const STEPS: [usize; 3] = [3, 3, 5];
/// A shorter step ends a level, radians.
const SHORT_RAD: f64 = 2e-5;
/// The scale of the residuals is at least this, code values: quantization.
const MIN_SCALE: f32 = 0.3;
/// Residuals beyond this many scales weigh half (Cauchy).
const CAUCHY: f32 = 2.4;
/// Things are nearer and farther than the one distance that the translation counts for. So much of the
/// parallax may look like a rotation.
const PARALLAX_SHARE: f64 = 0.07;
/// Standard deviation about each axis that interpolation on the grid leaves, in its pixels. In simulated
/// gusts without parallax or texture that moves, errors were 0.02 degrees in the median, 0.027 of a pixel.
const GRID_SIGMA_PX: f64 = 0.018;
/// Sectors whose sums count as independent: columns and rows.
const SECTORS: [usize; 2] = [12, 6];

/// What a fit leads to.
#[derive(Debug, Clone)]
pub struct RotationFit {
    /// Turns directions in the earlier camera's frame into the later one's.
    pub rotation: UnitQuaternion<f64>,
    /// Covariance of the rotation vector in the later camera's frame, radians squared.
    pub covariance: Matrix3<f64>,
    /// Points that it rests on.
    pub points: usize,
    /// Later less earlier values of all points of the finest level, code values.
    pub residuals: Vec<f32>,
}

/// How a direction of the earlier frame comes into the later one.
#[derive(Debug, Clone, Copy)]
struct Warp {
    rotation: UnitQuaternion<f64>,
    /// Over the distance of the scene, in the earlier camera's frame.
    translation: Vector3<f64>,
    offset: f32,
    gain: f32,
}

/// The rotation from the points of an earlier frame to a later frame. `None` where there is too little
/// texture.
pub fn rotation(
    points: &[Points],
    later: &Pyramid,
    start: &UnitQuaternion<f64>,
    airframe: &OwnAirframe,
) -> Option<RotationFit> {
    let translation = Vector3::zeros();
    let mut warp = Warp { rotation: *start, translation, offset: 0.0, gain: 1.0 };
    let levels = points.iter().zip(later.levels()).zip(STEPS);
    let mut last = None;
    for ((points, level), steps) in levels.rev() {
        let counted: Vec<usize> = (0..points.all.len())
            .filter(|&index| !airframe.is_at(points.all[index].cell))
            .collect();
        if counted.len() < MIN_POINTS {
            continue;
        }
        for _ in 0..steps {
            let residuals = residuals(&points.all, &counted, level, &warp);
            let (unknowns, _) = step(&points.all, &counted, &residuals)?;
            warp = warp.after(&unknowns);
            if unknowns.fixed_rows::<3>(0).norm() < SHORT_RAD {
                break;
            }
        }
        last = Some((points, level, counted));
    }
    let (points, level, counted) = last?;
    let all: Vec<usize> = (0..points.all.len()).collect();
    let residuals = residuals(&points.all, &all, level, &warp);
    let of_counted: Vec<f32> = counted.iter().map(|&index| residuals[index]).collect();
    let pixel_rad = later.levels().first()?.pixel_rad();
    let covariance = covariance(&points.all, &counted, &of_counted, &warp, pixel_rad)?;
    Some(RotationFit { rotation: warp.rotation, covariance, points: counted.len(), residuals })
}

impl Warp {
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

/// Later less earlier values of the counted points.
fn residuals(points: &[Point], counted: &[usize], level: &Level, warp: &Warp) -> Vec<f32> {
    let turn = warp.rotation.to_rotation_matrix().into_inner().cast::<f32>();
    let translation = warp.translation.cast::<f32>();
    let (columns, rows) = (level.columns() as f32, level.rows() as f32);
    counted
        .iter()
        .map(|&index| {
            let point = &points[index];
            let there = turn * (point.direction + translation);
            let longitude = angle(there.y, there.x);
            let latitude = angle(there.z, (there.x * there.x + there.y * there.y).sqrt());
            let column = (0.5 - longitude / std::f32::consts::TAU) * columns - 0.5;
            let row = (0.5 - latitude / std::f32::consts::PI) * rows - 0.5;
            level.sample(column, row) - (warp.gain * point.value + warp.offset)
        })
        .collect()
}

/// The angle of a vector in the plane, within 2e-5 radians, which are a thousandth of a pixel: a
/// polynomial of the arc tangent from 0 to 1. It is needed twice for each point and step.
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

/// How the value of a point changes with the unknowns.
fn row(point: &Point) -> [f32; UNKNOWNS] {
    let turn = point.direction.cross(&point.gradient);
    let g = point.gradient;
    [turn.x, turn.y, turn.z, g.x, g.y, g.z, 1.0, point.value]
}

fn scale_of(residuals: &[f32]) -> f32 {
    let mut sizes: Vec<f32> = residuals.iter().map(|residual| residual.abs()).collect();
    let middle = sizes.len() / 2;
    let (_, median, _) = sizes.select_nth_unstable_by(middle, f32::total_cmp);
    (1.4826 * *median).max(MIN_SCALE)
}

/// Points near the poles stand for less of the sphere.
fn weight(point: &Point, residual: f32, scale: f32) -> f32 {
    let cos_latitude = point.direction.x.hypot(point.direction.y);
    cos_latitude / (1.0 + (residual / (CAUCHY * scale)).powi(2))
}

/// A step of the unknowns, and the inverse normal matrix.
fn step(
    points: &[Point],
    counted: &[usize],
    residuals: &[f32],
) -> Option<(Gradient, nalgebra::SMatrix<f64, UNKNOWNS, UNKNOWNS>)> {
    let scale = scale_of(residuals);
    let mut equations = NormalEquations::new();
    for (&index, &residual) in counted.iter().zip(residuals) {
        let point = &points[index];
        equations.add(&row(point), residual, weight(point, residual, scale));
    }
    equations.solve()
}

/// The covariance of the rotation from how the sums of sectors scatter.
fn covariance(
    points: &[Point],
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
        sums[sector_of(point.cell)] += weighted.cast::<f64>();
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
