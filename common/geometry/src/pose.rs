//! The pose of a body from the rays of its corners in one frame.
//!
//! [`solve`] goes four steps:
//! 1. each marker seen whole gives two hypotheses, the two mirror solutions of a square
//!    (`ippe`: Collins and Bartoli, "Infinitesimal Plane-Based Pose Estimation", 2014), and, where
//!    these leave rays unexplained, two more for each three of its corners;
//! 2. all hypotheses are scored on all rays: what does not fit, or would face away, costs a fixed
//!    amount, so that misread markers and wrong corners are outvoted;
//! 3. the best are refined on all rays by Levenberg-Marquardt over the angular error ([`refine()`]);
//! 4. what remains distinct is returned, cheapest first. Both mirror solutions are kept: [`choose`]
//!    decides, with the track's prediction if there is one, and says how ambiguous that was.
//!
//! Rays may point anywhere, also backwards: everything is done on the sphere.

mod candidates;
mod choice;
mod ippe;
mod rays;
mod refine;
mod residual;

pub use candidates::{mirror_image, solve};
pub use choice::{Choice, PosePrior, choose};
pub use ippe::squared_distance_from_square;
pub use rays::{CornerRay, keep_sharpest};
pub use refine::refine;

use nalgebra::{Isometry3, Matrix6};

/// How rays are believed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseOptions {
    /// Scale of the robust (Cauchy) cost, in standard deviations: errors well below it count fully.
    pub robust_scale: f64,
    /// A corner fits if its error is below so many standard deviations, stated or as the corners that
    /// fit scatter, whichever is more...
    pub gate_deviations: f64,
    /// ...and, at first, if it is below this share of its marker's apparent side: detectors' corners
    /// are biased by more than they admit, while a misread or turned marker is off by about a side.
    pub gate_side: f64,
    /// How many hypotheses are refined at most.
    pub refined_max: usize,
}

impl Default for PoseOptions {
    fn default() -> Self {
        Self { robust_scale: 3.0, gate_deviations: 5.0, gate_side: 0.12, refined_max: 6 }
    }
}

/// A pose that explains the rays, or most of them.
#[derive(Debug, Clone, PartialEq)]
pub struct PoseSolution {
    /// The pose of the body's markers in the camera frame.
    pub camera_from_markers: Isometry3<f64>,
    /// Its covariance: position (m), then rotation vector (rad), both in the camera frame's axes,
    /// from the normal matrix of the rays that fit. It believes the rays' stated deviations; see
    /// [`PoseSolution::inflated_covariance`].
    pub covariance: Matrix6<f64>,
    /// Robust cost of all rays, in units of squared standard deviations; rays of markers that do
    /// not fit cost a fixed amount. Costs of solutions of the same rays can be compared.
    pub cost: f64,
    /// Sum of the inliers' squared errors over their degrees of freedom (two for each ray, less
    /// six): about 1 if the stated deviations are right.
    pub reduced_chi_square: f64,
    /// Ids of the markers more than half of whose rays fit, rising.
    pub inlier_markers: Vec<u32>,
    /// Rays of those markers that fit.
    pub inlier_corners: usize,
    /// Usable rays there were in all.
    pub corners: usize,
    /// Whether the front of every inlier marker faces the camera. Solutions in which one clearly
    /// faces away are not returned; `false` is left for one seen edge on.
    pub faces_camera: bool,
}

impl PoseSolution {
    /// The covariance enlarged by [`PoseSolution::reduced_chi_square`] where that exceeds 1: where
    /// the rays scatter more than they state.
    pub fn inflated_covariance(&self) -> Matrix6<f64> {
        self.covariance * self.reduced_chi_square.max(1.0)
    }
}

/// Standard deviations of a pose, all axes together: the roots of the expected squared distance and turn.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseDeviations {
    /// Metres.
    pub position_m: f64,
    /// Radians.
    pub rotation_rad: f64,
}

impl PoseDeviations {
    /// Reads the deviations from a covariance of position (m), then rotation vector (rad).
    pub fn of(covariance: &Matrix6<f64>) -> Self {
        let deviation = |first| covariance.fixed_view::<3, 3>(first, first).trace().sqrt();
        Self { position_m: deviation(0), rotation_rad: deviation(3) }
    }
}

/// A pose that is wrong by more than this, metres, is a false one.
pub const FALSE_POSITION_M: f64 = 0.1;
/// Rotation error beyond which a pose is false, radians: 10 degrees.
pub const FALSE_ROTATION_RAD: f64 = 10.0 * std::f64::consts::PI / 180.0;

/// Whether `pose` is a false one if the body is at `truth`.
pub fn is_false(pose: &Isometry3<f64>, truth: &Isometry3<f64>) -> bool {
    (pose.translation.vector - truth.translation.vector).norm() > FALSE_POSITION_M
        || pose.rotation.angle_to(&truth.rotation) > FALSE_ROTATION_RAD
}

/// Why there is no pose.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PoseError {
    /// A pose needs four rays: one whole marker.
    #[error("{usable} of {given} rays are usable: at least 4 are needed")]
    TooFewRays {
        /// Rays of the body's own corners, finite and with a positive deviation.
        usable: usize,
        /// Rays given.
        given: usize,
    },
    /// No marker has all of its corners, so there is nothing to start from.
    #[error(
        "none of the {markers} markers seen has all four corners: refine a predicted pose instead"
    )]
    NoWholeMarker {
        /// Markers with at least one usable ray.
        markers: usize,
    },
    /// No pose was found in which any marker fits its rays and faces the camera.
    #[error("no pose explains any of the {markers} markers seen")]
    NothingFits {
        /// Markers with at least one usable ray.
        markers: usize,
    },
}

#[cfg(test)]
mod tests;
