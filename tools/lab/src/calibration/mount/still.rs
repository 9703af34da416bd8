//! The pose of a body that stands still, from several frames.

use nalgebra::{Isometry3, Matrix6, Vector6};

use crate::calibration::weighted_ray::{difference, moved};
use flockeye_geometry::filter::chi_square_gate;

/// Probability that a frame of the same pose is farther from the others than the gate.
const ODD_SHARE: f64 = 1e-6;

/// The pose of a still body from several frames.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct StillPose {
    /// Mean of the frames' poses.
    pub camera_from_target: Isometry3<f64>,
    /// Covariance, as large as that of one frame: still pictures share most of their errors.
    pub covariance: Matrix6<f64>,
    /// Number of frames that were used.
    pub frames: usize,
    /// Number of frames with another pose: a motion, or a wrong measurement.
    pub odd: usize,
}

/// The pose of a still body from the poses of several frames. Each has its covariance: position
/// (m), then rotation vector (rad), both in the camera's axes. `None` without a frame, or if a
/// covariance has no inverse.
pub(crate) fn still_pose(frames: &[(Isometry3<f64>, Matrix6<f64>)]) -> Option<StillPose> {
    let informations: Option<Vec<Matrix6<f64>>> =
        frames.iter().map(|(_, covariance)| covariance.try_inverse()).collect();
    let informations = informations?;
    // The difference of two poses has the sum of their covariances. Half of one pose's information
    // approximates its inverse.
    let apart = |a: usize, b: usize| {
        let step = difference(&frames[a].0, &frames[b].0);
        step.dot(&((informations[a] + informations[b]) * step)) / 4.0
    };
    let is_same = |a: usize, b: usize| apart(a, b) <= chi_square_gate(1.0 - ODD_SHARE);
    let company = |a: usize| (0..frames.len()).filter(|&b| is_same(a, b)).count();
    // The frame with the most frames near it; the first of several.
    let middle = (0..frames.len()).rev().max_by_key(|&a| company(a))?;
    let same: Vec<usize> = (0..frames.len()).filter(|&b| is_same(middle, b)).collect();
    let (mut information, mut gradient) = (Matrix6::zeros(), Vector6::zeros());
    for &frame in &same {
        information += informations[frame];
        gradient += informations[frame] * difference(&frames[middle].0, &frames[frame].0);
    }
    let joint = information.try_inverse()?;
    Some(StillPose {
        camera_from_target: moved(&frames[middle].0, &(joint * gradient)),
        covariance: joint * same.len() as f64,
        frames: same.len(),
        odd: frames.len() - same.len(),
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use flockeye_geometry::fixtures::{Chance, distance_squared, error};

    #[test]
    fn the_mean_is_near_the_truth_and_odd_frames_do_not_count() {
        let mut chance = Chance::new(4);
        let deviations = Vector6::new(0.004, 0.001, 0.001, 0.01, 0.02, 0.02);
        let covariance = Matrix6::from_diagonal(&deviations.component_mul(&deviations));
        let (mut sum, benches) = (0.0, 100);
        for _ in 0..benches {
            let truth = chance.pose(0.8);
            let mut frames: Vec<_> = (0..9)
                .map(|_| {
                    let noise = Vector6::from(chance.normals::<6>()).component_mul(&deviations);
                    (moved(&truth, &noise), covariance)
                })
                .collect();
            // A mirrored pose, and a hand that moved the body.
            frames[2].0 = moved(&truth, &Vector6::new(0.0, 0.0, 0.0, 0.6, 0.0, 0.0));
            frames[5].0 = moved(&truth, &Vector6::new(0.0, 0.1, 0.0, 0.0, 0.0, 0.0));
            let found = still_pose(&frames).unwrap();
            assert_eq!((found.frames, found.odd), (7, 2));
            assert!((found.covariance - covariance).norm() < 1e-9, "that of one frame");
            sum += distance_squared(&error(&truth, &found.camera_from_target), &covariance);
        }
        // Seven frames of independent noise: a seventh of the six that one has.
        let mean = sum / f64::from(benches);
        assert!((0.7..1.05).contains(&mean), "{mean}");
    }

    #[test]
    fn no_frame_is_no_pose() {
        assert_eq!(still_pose(&[]), None);
        assert_eq!(still_pose(&[(Isometry3::identity(), Matrix6::zeros())]), None);
    }
}
