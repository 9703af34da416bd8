//! All decisions about an alignment.
//!
//! [`super::evidence`] states what the image says; here it is decided whether that is enough. A
//! pose is accepted where so few false ones would be that there are at most
//! [`FALSE_POSES_PER_HOUR`] of each way to find one. How many poses are tried in an hour differs:
//! anywhere, where a track predicts the body, or where markers were decoded.

use flockeye_geometry::pose::{
    FALSE_POSITION_M, FALSE_ROTATION_RAD, position_deviation_m, rotation_deviation_rad,
};
use nalgebra::Matrix6;

use super::alignment::Alignment;
use super::evidence::Evidence;

/// False poses of a target, by 10 cm or 10 degrees, that each way to find one may give an hour.
const FALSE_POSES_PER_HOUR: f64 = 1.0;

/// Share of the poses where no body is whose log odds exceed 0: with [`Evidence::log_odds`] above x
/// it is this times e^-x (docs/results/decisions.md).
const POSITIVE_SHARE: f64 = 0.022;

// How many poses are tried in an hour is assumed, not measured.

/// Poses tried in an hour where nothing predicts the body: ten in each second of searching.
const ANYWHERE_PER_HOUR: f64 = 36_000.0;

/// Poses tried in an hour where a track wrongly predicts the body: a twentieth of 30 a second.
const PREDICTED_PER_HOUR: f64 = 5_400.0;

/// Poses tried in an hour where false markers were decoded: one in a thousand frames.
const MARKED_PER_HOUR: f64 = 108.0;

/// Times in an hour that a pose is chosen from several: a body is found anew each half minute.
const CHOICES_PER_HOUR: f64 = 120.0;

// A pose is a measurement by itself if so many of its standard deviations are less than what makes
// it a false one. docs/results/constants.md#precision has the curve.

/// Deviations within which an aligned pose must be right.
const SIGMAS_OF_ALIGNMENT: f64 = 4.93;
/// Deviations within which a pose by corners alone must be right. When the curve was read, both
/// numbers were equal, and covariances of alignments had a factor of 3.1.
const SIGMAS_OF_CORNERS: f64 = 2.8;

/// Least log odds of an accepted pose, if so many are tried in an hour where no body is.
fn least_log_odds(tried_per_hour: f64) -> f64 {
    (POSITIVE_SHARE * tried_per_hour / FALSE_POSES_PER_HOUR).ln()
}

/// The log odds from which on a pose is accepted where nothing but the picture speaks for it.
pub fn least_log_odds_anywhere() -> f64 {
    least_log_odds(ANYWHERE_PER_HOUR)
}

/// The log odds from which on a pose is accepted where a track predicts the body.
pub fn least_log_odds_predicted() -> f64 {
    least_log_odds(PREDICTED_PER_HOUR)
}

/// The log odds from which on a pose is accepted where markers were decoded that it has there.
pub fn least_log_odds_marked() -> f64 {
    least_log_odds(MARKED_PER_HOUR)
}

/// Least lead of a chosen pose: its log odds less those of all others together.
pub fn least_lead() -> f64 {
    (CHOICES_PER_HOUR / FALSE_POSES_PER_HOUR).ln()
}

/// Whether an aligned pose with this covariance, position (m), then rotation vector (rad), is of
/// use by itself. One that is less precise is only of use to a track, which knows the rest: its
/// covariance says how much. One that is not finite is not precise.
pub fn is_precise(covariance: &Matrix6<f64>) -> bool {
    is_within_false(covariance, SIGMAS_OF_ALIGNMENT)
}

/// Whether a pose by corners alone is of use by itself, by its covariance.
pub fn is_precise_by_corners(covariance: &Matrix6<f64>) -> bool {
    is_within_false(covariance, SIGMAS_OF_CORNERS)
}

fn is_within_false(covariance: &Matrix6<f64>, sigmas: f64) -> bool {
    sigmas * position_deviation_m(covariance) < FALSE_POSITION_M
        && sigmas * rotation_deviation_rad(covariance) < FALSE_ROTATION_RAD
}

impl Alignment {
    /// Whether the body is there, by the picture alone.
    pub fn is_accepted(&self) -> bool {
        self.evidence.log_odds >= least_log_odds_anywhere()
    }

    /// Whether the body is there, where a track predicts it. `prior_log_odds` speak for how it lies
    /// to the prediction. Whether it is where the track expects it is for the filter to decide.
    pub fn is_accepted_with_track_prior(&self, prior_log_odds: f64) -> bool {
        self.evidence.log_odds + prior_log_odds >= least_log_odds_predicted()
    }

    /// Whether the body is there, where markers were decoded at this pose. `prior_log_odds` speak
    /// for what else is known: a mirror pose has its marker at the same place.
    pub fn is_accepted_with_markers(&self, prior_log_odds: f64) -> bool {
        self.evidence.log_odds + prior_log_odds >= least_log_odds_marked()
    }
}

impl Evidence {
    /// Whether the facets beside the most informative one say that the body is there in this
    /// attitude, and not in the one that is mirrored by that facet.
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
        // So many false poses are left of those that are tried.
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
