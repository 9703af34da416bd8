//! The pose of a body from the rays of its corners in one frame.
//!
//! [`solve`] goes four steps:
//! 1. each marker seen whole gives two hypotheses, the two mirror solutions of a square
//!    (`ippe`: Collins and Bartoli, "Infinitesimal Plane-Based Pose Estimation", 2014), and, where
//!    these leave rays unexplained, two more for each three of its corners;
//! 2. all hypotheses are scored on all rays: a ray that does not fit, or faces away, costs a fixed
//!    amount, so that misread markers and wrong corners are outvoted;
//! 3. the best are refined on all rays by Levenberg-Marquardt over the angular error (`refine`);
//! 4. the distinct solutions are returned, cheapest first. Both mirror solutions are kept:
//!    [`choose`] decides, with the track's prediction if there is one.
//!
//! Rays may point anywhere, also backwards: all computations are on the sphere.

mod candidates;
mod choice;
mod ippe;
mod lens_error;
mod rays;
mod refine;
mod residual;

pub use candidates::{mirror_image, solve};
pub use choice::{FALSE_POSES_PER_HOUR, choose, lead, least_lead};
pub use ippe::squared_distance_from_square;
pub use lens_error::LensError;
pub use rays::{CornerRay, keep_sharpest};
pub use residual::moved;

use nalgebra::{Isometry3, Matrix6, UnitQuaternion, Vector6};
use serde::{Deserialize, Serialize};

/// Scale of the robust (Cauchy) cost, in standard deviations: errors well below it count fully.
const ROBUST_SCALE: f64 = 3.0;
/// Largest error of a corner that fits, in standard deviations. The larger of the stated deviation
/// and the scatter of the fitting corners counts.
const GATE_DEVIATIONS: f64 = 5.0;
/// Largest error of a corner that fits at first, as a share of its marker's apparent side. Corners
/// from detectors have larger biases than stated, while a misread or rotated marker is off by about
/// a side.
const GATE_SIDE: f64 = 0.12;

/// A pose with its covariance, measured or predicted.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PoseEstimate {
    /// The pose of the body's markers in the camera frame.
    pub camera_from_markers: Isometry3<f64>,
    /// Covariance of position (m), then rotation vector (rad), in the camera frame's axes.
    pub covariance: Matrix6<f64>,
}

/// `found` less `expected`: position (m), then rotation vector (rad), in the camera frame's axes.
pub fn pose_difference(found: &Isometry3<f64>, expected: &Isometry3<f64>) -> Vector6<f64> {
    let mut difference = Vector6::zeros();
    difference
        .fixed_rows_mut::<3>(0)
        .copy_from(&(found.translation.vector - expected.translation.vector));
    difference
        .fixed_rows_mut::<3>(3)
        .copy_from(&(found.rotation * expected.rotation.inverse()).scaled_axis());
    difference
}

/// The covariance of a pose, position (m), then rotation vector (rad), in axes that are turned by
/// `to_from_source`.
pub fn turned_covariance(
    to_from_source: &UnitQuaternion<f64>,
    covariance: &Matrix6<f64>,
) -> Matrix6<f64> {
    let rotation = to_from_source.to_rotation_matrix();
    let mut both = Matrix6::zeros();
    both.fixed_view_mut::<3, 3>(0, 0).copy_from(rotation.matrix());
    both.fixed_view_mut::<3, 3>(3, 3).copy_from(rotation.matrix());
    both * covariance * both.transpose()
}

/// A pose that explains the rays, or most of them.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseSolution {
    /// The pose of the body's markers in the camera frame.
    pub camera_from_markers: Isometry3<f64>,
    /// Covariance of position (m), then rotation vector (rad), both in the camera frame's axes,
    /// from the normal matrix of the rays that fit. It relies on the stated deviations of the rays;
    /// see [`PoseSolution::inflated_covariance`].
    pub covariance: Matrix6<f64>,
    /// Robust cost of all rays, in units of squared standard deviations; rays of markers that do
    /// not fit cost a fixed amount. Costs of solutions of the same rays can be compared.
    pub cost: f64,
    /// Sum of the inliers' squared errors over their degrees of freedom (two for each ray, less
    /// six): about 1 if the stated deviations are right.
    pub reduced_chi_square: f64,
    /// Ids of the markers of which more than half of the rays fit, rising.
    pub inlier_markers: Vec<u32>,
    /// Rays of those markers that fit.
    pub inlier_corners: usize,
}

impl PoseSolution {
    /// Covariance times [`PoseSolution::reduced_chi_square`] where that exceeds 1, because the rays
    /// scatter more than stated.
    pub fn inflated_covariance(&self) -> Matrix6<f64> {
        self.covariance * self.reduced_chi_square.max(1.0)
    }
}

/// Standard deviation of a pose's position, all axes together: the root of the expected squared
/// distance, metres. The covariance is of position (m), then rotation vector (rad).
pub fn position_deviation_m(covariance: &Matrix6<f64>) -> f64 {
    covariance.fixed_view::<3, 3>(0, 0).trace().sqrt()
}

/// Standard deviation of a pose's rotation, all axes together: the root of the expected squared
/// turn, radians. The covariance is that of [`position_deviation_m`].
pub fn rotation_deviation_rad(covariance: &Matrix6<f64>) -> f64 {
    covariance.fixed_view::<3, 3>(3, 3).trace().sqrt()
}

/// Position error beyond which a pose is false, metres.
pub const FALSE_POSITION_M: f64 = 0.1;
/// Rotation error beyond which a pose is false, radians: 10 degrees.
pub const FALSE_ROTATION_RAD: f64 = 10.0 * std::f64::consts::PI / 180.0;

/// Whether `pose` is a false one if the body is at `truth`.
pub fn is_false(pose: &Isometry3<f64>, truth: &Isometry3<f64>) -> bool {
    (pose.translation.vector - truth.translation.vector).norm() > FALSE_POSITION_M
        || pose.rotation.angle_to(&truth.rotation) > FALSE_ROTATION_RAD
}

/// Reason why there is no pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say what the fields are")]
pub enum PoseError {
    /// A pose needs four rays: one whole marker.
    #[error("{usable} of {given} rays are usable: at least 4 are needed")]
    TooFewRays { usable: usize, given: usize },
    /// No marker has all of its corners, so there is nothing to start from.
    #[error(
        "none of the {markers} markers seen has all four corners: refine a predicted pose instead"
    )]
    NoWholeMarker { markers: usize },
    /// No pose was found in which any marker fits its rays and faces the camera.
    #[error("no pose explains any of the {markers} markers seen")]
    NothingFits { markers: usize },
}

#[cfg(test)]
mod tests;
