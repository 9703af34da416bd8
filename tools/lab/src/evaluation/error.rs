//! Errors of poses relative to the truth.

use flockeye_geometry::statistics::mean;
use flockeye_tables::TruthRow;
use nalgebra::{Matrix6, UnitQuaternion, Vector3};
use serde::Serialize;

use super::statistics::Spread;

/// The error of a pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseOffset {
    /// True position minus the pose's position, metres, in the observer's axes.
    pub position: Vector3<f64>,
    /// Rotation vector from the pose's orientation to the true one, radians, in the observer's
    /// axes.
    pub rotation: Vector3<f64>,
    /// Error of the position along the line of sight, metres; positive if too far.
    pub along_m: f64,
    /// Error of the position across the line of sight, metres.
    pub across_m: f64,
    /// The pose's distance minus the true distance, metres.
    pub distance_m: f64,
    /// Angle between the pose's direction and the true direction, degrees.
    pub bearing_deg: f64,
}

impl PoseOffset {
    /// Compares a pose with the truth.
    pub fn of(
        position: &Vector3<f64>,
        orientation: &UnitQuaternion<f64>,
        truth: &TruthRow,
    ) -> Self {
        Self::between(position, orientation, &truth.position(), &truth.orientation())
    }

    /// Compares a pose with the true position and orientation.
    pub fn between(
        position: &Vector3<f64>,
        orientation: &UnitQuaternion<f64>,
        there: &Vector3<f64>,
        turned: &UnitQuaternion<f64>,
    ) -> Self {
        let off = position - there;
        let sight = there.try_normalize(0.0).unwrap_or_else(Vector3::zeros);
        let along_m = off.dot(&sight);
        Self {
            position: -off,
            rotation: (turned * orientation.inverse()).scaled_axis(),
            along_m,
            across_m: (off - sight * along_m).norm(),
            distance_m: position.norm() - there.norm(),
            bearing_deg: position.angle(there).to_degrees(),
        }
    }

    /// Distance between the positions, metres.
    pub fn position_m(&self) -> f64 {
        self.position.norm()
    }

    /// Angle between the orientations, degrees.
    pub fn rotation_deg(&self) -> f64 {
        self.rotation.norm().to_degrees()
    }
}

/// An error with its covariance.
pub type ErrorSample = (PoseOffset, Matrix6<f64>);

/// Statistics of many errors.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Errors {
    /// Number of errors.
    pub count: usize,
    /// Errors of the position, millimetres.
    pub position_mm: Spread,
    /// Errors of the position along the line of sight, millimetres.
    pub along_mm: Spread,
    /// Signed mean along the line of sight, millimetres; positive if too far.
    pub along_bias_mm: f64,
    /// Errors of the position across the line of sight, millimetres.
    pub across_mm: Spread,
    /// Errors of the distance, millimetres.
    pub distance_mm: Spread,
    /// Signed mean of the distance error, millimetres; positive if too far.
    pub distance_bias_mm: f64,
    /// Errors of the direction, degrees.
    pub bearing_deg: Spread,
    /// Errors of the orientation, degrees.
    pub rotation_deg: Spread,
}

impl Errors {
    /// Statistics of errors; `None` without an error.
    pub fn of(errors: &[PoseOffset]) -> Option<Self> {
        let spread = |size: fn(&PoseOffset) -> f64, unit: f64| {
            Spread::of(errors.iter().map(|e| size(e) * unit))
        };
        let bias = |size: fn(&PoseOffset) -> f64| {
            mean(&errors.iter().map(|error| size(error) * 1e3).collect::<Vec<_>>())
        };
        Some(Self {
            count: errors.len(),
            position_mm: spread(PoseOffset::position_m, 1e3)?,
            along_mm: spread(|error| error.along_m, 1e3)?,
            along_bias_mm: bias(|error| error.along_m)?,
            across_mm: spread(|error| error.across_m, 1e3)?,
            distance_mm: spread(|error| error.distance_m, 1e3)?,
            distance_bias_mm: bias(|error| error.distance_m)?,
            bearing_deg: spread(|error| error.bearing_deg, 1.0)?,
            rotation_deg: spread(PoseOffset::rotation_deg, 1.0)?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::samples::truth_at;

    #[test]
    fn errors_are_split_along_and_across_the_line_of_sight() {
        let truth = truth_at(0, Vector3::new(0.0, 2.0, 0.0));
        let quarter = UnitQuaternion::from_euler_angles(0.0, 0.0, 0.1);
        let error = PoseOffset::of(&Vector3::new(0.3, 2.4, 0.0), &quarter, &truth);
        assert!((error.position_m() - 0.5).abs() < 1e-12);
        assert!((error.along_m - 0.4).abs() < 1e-12 && (error.across_m - 0.3).abs() < 1e-12);
        assert!((error.distance_m - (0.3f64.hypot(2.4) - 2.0)).abs() < 1e-12);
        assert!((error.bearing_deg - 0.125f64.atan().to_degrees()).abs() < 1e-9);
        // The truth is turned back by 0.1 about z, seen from the pose.
        assert!((error.rotation - Vector3::new(0.0, 0.0, -0.1)).norm() < 1e-12);
        assert!((error.rotation_deg() - 0.1f64.to_degrees()).abs() < 1e-9);
    }

    #[test]
    fn means_keep_their_sign_and_sizes_do_not() {
        let truth = truth_at(0, Vector3::new(1.0, 0.0, 0.0));
        let at = |x: f64| PoseOffset::of(&Vector3::new(x, 0.0, 0.0), &truth.orientation(), &truth);
        let errors = Errors::of(&[at(1.01), at(0.97)]).expect("two");
        assert!((errors.along_bias_mm + 10.0).abs() < 1e-9, "{}", errors.along_bias_mm);
        assert!((errors.distance_bias_mm + 10.0).abs() < 1e-9);
        assert!((errors.along_mm.mean - 20.0).abs() < 1e-9);
        assert!((errors.position_mm.worst - 30.0).abs() < 1e-9);
        assert!(errors.across_mm.worst < 1e-9 && errors.count == 2);
        assert_eq!(Errors::of(&[]), None);
    }
}
