//! The truth at any time between frames: a body's pose or the camera's attitude.

use flockeye_tables::TruthRow;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

/// Largest gap between frames that is interpolated, seconds. Over longer gaps the motion is not
/// known.
const LONGEST_GAP_S: f64 = 0.1;
/// Largest difference of equal times, seconds. Recordings have six decimals.
const SAME_S: f64 = 2e-6;

/// True poses at the exposures of frames.
#[derive(Debug, Clone)]
pub struct TruePath {
    knots: Vec<TruePose>,
}

#[derive(Debug, Clone, Copy)]
struct TruePose {
    frame: u64,
    at_s: f64,
    position: Vector3<f64>,
    orientation: UnitQuaternion<f64>,
}

impl TruePath {
    /// The path of the rows' body in the camera's frame.
    pub fn of_body<'a>(rows: impl IntoIterator<Item = &'a TruthRow>) -> Self {
        Self::new(rows.into_iter().map(|row| TruePose {
            frame: row.frame,
            at_s: row.t_s,
            position: row.position(),
            orientation: row.orientation(),
        }))
    }

    /// The camera's attitude in the world over time. `None` if no row contains it.
    pub fn of_camera(rows: &[TruthRow]) -> Option<Self> {
        let knots = rows.iter().filter_map(|row| {
            let orientation = row.world_from_camera()?;
            Some(TruePose {
                frame: row.frame,
                at_s: row.t_s,
                position: Vector3::zeros(),
                orientation,
            })
        });
        let path = Self::new(knots);
        (!path.knots.is_empty()).then_some(path)
    }

    fn new(knots: impl Iterator<Item = TruePose>) -> Self {
        let mut knots: Vec<TruePose> = knots.collect();
        knots.sort_by_key(|knot| knot.frame);
        knots.dedup_by_key(|knot| knot.frame);
        Self { knots }
    }

    /// The pose `after_s` seconds after a frame's exposure; before it if negative. It is
    /// interpolated by a cubic through the two frames before and the two after that time. `None`
    /// without frames on both sides.
    pub fn pose(&self, frame: u64, after_s: f64) -> Option<Isometry3<f64>> {
        let start = self.index(frame)?;
        let at_s = self.knots[start].at_s + after_s;
        let nearest = self.nearest(start, at_s)?;
        let origin = &self.knots[nearest];
        if (origin.at_s - at_s).abs() < SAME_S {
            let translation = Translation3::from(origin.position);
            return Some(Isometry3::from_parts(translation, origin.orientation));
        }
        let window = self.window(nearest, at_s)?;
        let times: Vec<f64> = window.iter().map(|knot| knot.at_s).collect();
        let (mut position, mut turned) = (Vector3::zeros(), Vector3::zeros());
        for (knot, weight) in window.iter().zip(weights(&times, at_s)) {
            position += knot.position * weight;
            turned += origin.turn_to(knot) * weight;
        }
        let orientation = origin.orientation * UnitQuaternion::from_scaled_axis(turned);
        Some(Isometry3::from_parts(Translation3::from(position), orientation))
    }

    /// The angular velocity at a frame's exposure, in the turning frame's axes, rad/s. It is the
    /// slope of the fourth-order polynomial through the frame and its two neighbours on each side.
    /// `None` if one of them is absent.
    pub fn rate(&self, frame: u64) -> Option<Vector3<f64>> {
        let at = self.index(frame)?;
        let around = self.knots.get(at.checked_sub(2)?..at + 3)?;
        let is_steady = around.windows(2).all(|pair| follows(&pair[0], &pair[1]));
        let times: Vec<f64> = around.iter().map(|knot| knot.at_s).collect();
        let slopes = slopes(&times, 2);
        let turns = around.iter().zip(slopes).map(|(knot, slope)| around[2].turn_to(knot) * slope);
        is_steady.then(|| turns.sum())
    }

    fn index(&self, frame: u64) -> Option<usize> {
        self.knots.binary_search_by_key(&frame, |knot| knot.frame).ok()
    }

    /// The last knot at or before a time, without a gap from `start`.
    fn nearest(&self, start: usize, at_s: f64) -> Option<usize> {
        let mut index = start;
        while self.knots[index].at_s > at_s + SAME_S {
            let before = index.checked_sub(1)?;
            if !follows(&self.knots[before], &self.knots[index]) {
                return None;
            }
            index = before;
        }
        while let Some(next) = self.knots.get(index + 1) {
            if !follows(&self.knots[index], next) || next.at_s > at_s + SAME_S {
                break;
            }
            index += 1;
        }
        Some(index)
    }

    /// Up to two knots before a time and two after it. `before` is the last one before.
    fn window(&self, before: usize, at_s: f64) -> Option<&[TruePose]> {
        let after = before + 1;
        let is_between = self
            .knots
            .get(after)
            .is_some_and(|next| follows(&self.knots[before], next) && next.at_s > at_s);
        if !is_between {
            return None;
        }
        let is_joined = |k: usize| match (self.knots.get(k), self.knots.get(k + 1)) {
            (Some(one), Some(next)) => follows(one, next),
            _ => false,
        };
        let from = before - usize::from(before > 0 && is_joined(before - 1));
        let to = after + usize::from(is_joined(after));
        self.knots.get(from..=to)
    }
}

impl TruePose {
    /// The rotation vector from this orientation to another, along the axes of this one.
    fn turn_to(&self, other: &Self) -> Vector3<f64> {
        (self.orientation.inverse() * other.orientation).scaled_axis()
    }
}

/// Whether two knots are consecutive in one flight. A table may contain several flights.
fn follows(one: &TruePose, next: &TruePose) -> bool {
    let gap_s = next.at_s - one.at_s;
    gap_s > 0.0 && gap_s <= LONGEST_GAP_S
}

/// Weight of each value at a time (Lagrange polynomials).
fn weights(times: &[f64], at: f64) -> Vec<f64> {
    let of = |k: usize| {
        let others = times.iter().enumerate().filter(|(other, _)| *other != k);
        others.map(|(_, other)| (at - other) / (times[k] - other)).product()
    };
    (0..times.len()).map(of).collect()
}

/// Weight of each value for the slope at `times[at]` (derivatives of the Lagrange polynomials).
fn slopes(times: &[f64], at: usize) -> Vec<f64> {
    let others = |k: usize| times.iter().enumerate().filter(move |(other, _)| *other != k);
    let of = |k: usize| -> f64 {
        if k == at {
            return others(at).map(|(_, other)| 1.0 / (times[at] - other)).sum();
        }
        let rest = others(k).filter(|(other, _)| *other != at);
        rest.map(|(_, other)| (times[at] - other) / (times[k] - other)).product::<f64>()
            / (times[k] - times[at])
    };
    (0..times.len()).map(of).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::samples::truth_at;

    const STEP_S: f64 = 1.0 / 30.0;

    /// A drone in gusts: swings of 15 degrees at 0.7 Hz, and a body that passes by.
    fn pose(at_s: f64) -> (Vector3<f64>, UnitQuaternion<f64>) {
        let swing = |hz: f64, start: f64| 0.26 * (std::f64::consts::TAU * hz * at_s + start).sin();
        let turned =
            UnitQuaternion::from_euler_angles(swing(0.7, 0.0), swing(0.5, 1.0), 1.2 * at_s);
        (turned.inverse() * Vector3::new(1.5, 0.5 * at_s, 0.3), turned)
    }

    fn knot(frame: u64) -> TruePose {
        let (position, orientation) = pose(frame as f64 * STEP_S);
        TruePose { frame, at_s: frame as f64 * STEP_S, position, orientation }
    }

    #[test]
    fn poses_between_frames_are_those_flown() {
        let path = TruePath::new((0..40).map(knot));
        for (frame, after_s) in [(10, 0.011), (10, 0.5), (20, -0.02), (0, 0.013), (12, 0.0)] {
            let (position, orientation) = pose(frame as f64 * STEP_S + after_s);
            let found = path.pose(frame, after_s).expect("frames lie on both sides");
            let off_mm = (found.translation.vector - position).norm() * 1e3;
            let off_deg = found.rotation.angle_to(&orientation).to_degrees();
            // At the border of the flight the curve is of second order.
            let limit = if frame == 0 { 4.0 } else { 1.0 };
            assert!(off_mm < 0.3 * limit, "{off_mm} mm at {frame} + {after_s}");
            assert!(off_deg < 0.01 * limit, "{off_deg} degrees at {frame} + {after_s}");
        }
        assert!(path.pose(38, 0.05).is_none(), "beyond the last frame");
        assert!(path.pose(39, 0.0).is_some(), "the last frame itself");
        assert!(path.pose(50, 0.0).is_none(), "no such frame");
        assert!(path.pose(1, -0.05).is_none(), "before the first frame");
    }

    #[test]
    fn rates_are_those_flown() {
        let path = TruePath::new((0..40).map(knot));
        for frame in 2..38 {
            let (at_s, step) = (frame as f64 * STEP_S, 1e-5);
            let turned = pose(at_s - step).1.inverse() * pose(at_s + step).1;
            let off =
                path.rate(frame).expect("there are five") - turned.scaled_axis() / (2.0 * step);
            assert!(off.norm().to_degrees() < 0.05, "{} at {frame}", off.norm().to_degrees());
        }
        assert!(path.rate(1).is_none() && path.rate(38).is_none());
    }

    #[test]
    fn nothing_is_said_across_a_gap_or_another_flight() {
        // Frames 10 to 15 were not recorded; frame 20 begins another flight.
        let knots = (0..10).chain(16..30).map(|frame| TruePose {
            at_s: knot(frame).at_s - if frame >= 20 { 0.6 } else { 0.0 },
            ..knot(frame)
        });
        let path = TruePath::new(knots);
        assert!(path.pose(8, 0.02).is_some() && path.pose(8, 0.05).is_none());
        assert!(path.pose(18, 0.05).is_none() && path.pose(21, -0.05).is_none());
        assert!(path.rate(9).is_none() && path.rate(19).is_none() && path.rate(22).is_some());
    }

    #[test]
    fn a_truth_without_attitudes_is_no_path_of_the_camera() {
        let row = truth_at(0, Vector3::x());
        assert!(TruePath::of_camera(std::slice::from_ref(&row)).is_none());
        let turned = TruthRow {
            camera_qw: Some(1.0),
            camera_qx: Some(0.0),
            camera_qy: Some(0.0),
            camera_qz: Some(0.0),
            ..row
        };
        assert!(TruePath::of_camera(&[turned]).is_some());
    }
}
