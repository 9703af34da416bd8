//! All decisions about an alignment.
//!
//! [`super::evidence`] measures the evidence in the image; this module decides whether it is
//! enough. The limits allow at most [`FALSE_POSES_PER_HOUR`] for each way to find a pose. The
//! number of tries in an hour differs: anywhere, where a track predicts the body, or where markers
//! were decoded.

use flockeye_geometry::pose::{
    FALSE_POSES_PER_HOUR, FALSE_POSITION_M, FALSE_ROTATION_RAD, least_lead, position_deviation_m,
    rotation_deviation_rad,
};
use nalgebra::Matrix6;

use super::alignment::Alignment;
use super::evidence::Evidence;

/// Share of the poses without a body whose log odds exceed 0 (docs/results/decisions.md). The share
/// with [`Evidence::log_odds`] above x is this times e^-x. It depends on how thorough a fit is: read
/// it anew when alignment changes.
const POSITIVE_SHARE: f64 = 0.041;

// The numbers of tries in an hour are assumed, not measured.

/// Poses tried in an hour where nothing predicts the body: ten in each second of searching.
const ANYWHERE_PER_HOUR: f64 = 36_000.0;

/// Poses tried in an hour where a track wrongly predicts the body: a twentieth of 30 a second.
const PREDICTED_PER_HOUR: f64 = 5_400.0;

/// Poses tried in an hour where false markers were decoded: one in a thousand frames.
const MARKED_PER_HOUR: f64 = 108.0;

// Least number of standard deviations that fit into the limits of a false pose, for a pose that is
// a measurement by itself. docs/results/constants.md#precision has the curve.

/// Standard deviations within which an aligned pose must be right.
const SIGMAS_OF_ALIGNMENT: f64 = 4.93;
/// Standard deviations within which a pose from corners alone must be right. When the curve was
/// read, both numbers were equal, and covariances of alignments had a factor of 3.1.
const SIGMAS_OF_CORNERS: f64 = 2.8;

/// Least log odds of an accepted pose, for this many tries in an hour without a body.
fn least_log_odds(tried_per_hour: f64) -> f64 {
    (POSITIVE_SHARE * tried_per_hour / FALSE_POSES_PER_HOUR).ln()
}

/// Least log odds of a pose that only the picture supports.
pub fn least_log_odds_anywhere() -> f64 {
    least_log_odds(ANYWHERE_PER_HOUR)
}

/// Least log odds of a pose where a track predicts the body.
pub fn least_log_odds_predicted() -> f64 {
    least_log_odds(PREDICTED_PER_HOUR)
}

/// Least log odds of a pose that decoded markers support.
pub fn least_log_odds_marked() -> f64 {
    least_log_odds(MARKED_PER_HOUR)
}

/// Whether an aligned pose with this covariance, position (m), then rotation vector (rad), is
/// usable by itself. A less precise pose can only update a track, weighted by its covariance. A
/// pose that is not finite is not precise.
pub fn is_precise(covariance: &Matrix6<f64>) -> bool {
    is_within_false(covariance, SIGMAS_OF_ALIGNMENT)
}

/// Whether a pose from corners alone is usable by itself, by its covariance.
pub fn is_precise_by_corners(covariance: &Matrix6<f64>) -> bool {
    is_within_false(covariance, SIGMAS_OF_CORNERS)
}

fn is_within_false(covariance: &Matrix6<f64>, sigmas: f64) -> bool {
    sigmas * position_deviation_m(covariance) < FALSE_POSITION_M
        && sigmas * rotation_deviation_rad(covariance) < FALSE_ROTATION_RAD
}

impl Alignment {
    /// Whether the body is at the pose, from the picture alone.
    pub fn is_accepted(&self) -> bool {
        self.evidence.log_odds >= least_log_odds_anywhere()
    }

    /// Whether the body is at the pose, where a track predicts it. `prior_log_odds` rate the
    /// rotation from the prediction. The filter checks the position.
    pub fn is_accepted_with_track_prior(&self, prior_log_odds: f64) -> bool {
        self.evidence.log_odds + prior_log_odds >= least_log_odds_predicted()
    }

    /// Whether the body is at the pose, where markers were decoded. `prior_log_odds` rate other
    /// knowledge, because a mirror pose has its marker at the same place.
    pub fn is_accepted_with_markers(&self, prior_log_odds: f64) -> bool {
        self.evidence.log_odds + prior_log_odds >= least_log_odds_marked()
    }
}

impl Evidence {
    /// Whether the facets beside the most informative one support the body in this attitude, and
    /// not in the one mirrored by that facet.
    pub fn is_unambiguous(&self) -> bool {
        self.log_odds_of_others >= least_lead()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_more_is_tried_the_more_is_asked() {
        let [marked, predicted, anywhere] =
            [MARKED_PER_HOUR, PREDICTED_PER_HOUR, ANYWHERE_PER_HOUR].map(least_log_odds);
        assert!(0.0 < marked && marked < predicted && predicted < anywhere && anywhere < 10.0);
        // Share of the false poses that remain.
        let left = ANYWHERE_PER_HOUR * POSITIVE_SHARE * (-anywhere).exp();
        assert!((left - FALSE_POSES_PER_HOUR).abs() < 1e-9);
    }

    #[test]
    fn a_pose_is_precise_if_neither_its_position_nor_its_rotation_may_be_false() {
        let with = |position_m: f64, rotation_deg: f64| {
            let mut covariance = Matrix6::zeros();
            covariance[(0, 0)] = position_m.powi(2);
            covariance[(4, 4)] = rotation_deg.to_radians().powi(2);
            covariance
        };
        assert!(is_precise(&with(0.020, 2.0)));
        assert!(!is_precise(&with(0.021, 2.0)) && !is_precise(&with(0.020, 2.1)));
        assert!(!is_precise(&with(f64::NAN, 1.0)));
        assert!(is_precise_by_corners(&with(0.035, 3.5)));
        assert!(!is_precise_by_corners(&with(0.036, 3.5)));
        assert!(!is_precise_by_corners(&with(0.035, 3.6)));
    }

    #[test]
    fn one_facet_alone_does_not_tell_a_pose_from_its_mirror_image() {
        let one = Evidence { log_odds: 9.0, log_odds_of_others: 0.0, ..Evidence::default() };
        let two = Evidence { log_odds: 15.0, log_odds_of_others: 6.0, ..one };
        assert!(!one.is_unambiguous() && two.is_unambiguous());
    }
}
