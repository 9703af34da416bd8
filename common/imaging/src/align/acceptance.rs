//! All decisions about an alignment.
//!
//! [`super::evidence`] states what the image says; here it is decided whether that is enough. A pose is accepted where so
//! few false ones would be that there are at most [`FALSE_POSES_PER_HOUR`] of each way to find one. How many poses are
//! tried in an hour differs: anywhere, where a track predicts the body, or where markers were decoded.

use flockeye_geometry::pose::{FALSE_POSITION_M, FALSE_ROTATION_RAD, PoseDeviations};
use nalgebra::Matrix6;

use super::alignment::Alignment;
use super::evidence::Evidence;

/// False poses of one target, wrong by 10 cm or 10 degrees, that each way to find one may give in an hour of flight.
const FALSE_POSES_PER_HOUR: f64 = 1.0;

/// Share of the poses where no body is whose log odds exceed 0: with [`Evidence::log_odds`] above x it is this times e^-x
/// (docs/results/decisions.md).
const POSITIVE_SHARE: f64 = 0.022;

// How many poses are tried in an hour is assumed, not measured.

/// Poses that are tried in an hour where nothing says that the body is: ten in each second that it is looked for.
const ANYWHERE_PER_HOUR: f64 = 36_000.0;

/// Poses that are tried in an hour where a track predicts the body and it is not: a twentieth of 30 in each second.
const PREDICTED_PER_HOUR: f64 = 5_400.0;

/// Poses that are tried in an hour where markers were decoded that are none: one in a thousand frames.
const MARKED_PER_HOUR: f64 = 108.0;

/// Times in an hour that a pose is chosen from several: a body is found anew each half minute.
const CHOICES_PER_HOUR: f64 = 120.0;

// A pose is a measurement by itself if so many of its standard deviations are less than what makes it a false one.
// docs/results/constants.md#precision has the curve.

/// Deviations within which an aligned pose must be right.
const SIGMAS_OF_ALIGNMENT: f64 = 4.93;
/// Deviations within which a pose by corners alone must be right. When the curve was read, both
/// numbers were equal, and covariances of alignments had a factor of 3.1.
const SIGMAS_OF_CORNERS: f64 = 2.8;

/// The log odds of the picture from which on a pose is accepted, of which so many are tried in an hour where no body is.
fn least_log_odds(tried_per_hour: f64) -> f64 {
    (POSITIVE_SHARE * tried_per_hour / FALSE_POSES_PER_HOUR).ln()
}

/// The log odds from which on a pose is accepted, by what speaks for it beside the picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LeastLogOdds {
    /// Nothing does.
    pub anywhere: f64,
    /// A track predicts the body there.
    pub predicted: f64,
    /// Markers were decoded where the pose has them.
    pub marked: f64,
}

impl LeastLogOdds {
    /// What is asked.
    pub fn asked() -> Self {
        Self {
            anywhere: least_log_odds(ANYWHERE_PER_HOUR),
            predicted: least_log_odds(PREDICTED_PER_HOUR),
            marked: least_log_odds(MARKED_PER_HOUR),
        }
    }
}

/// By how much the log odds of a pose must exceed those of all others together, to be chosen from them.
pub fn least_lead() -> f64 {
    (CHOICES_PER_HOUR / FALSE_POSES_PER_HOUR).ln()
}

/// Whether an aligned pose with this covariance, position (m), then rotation vector (rad), is of use by itself. One that is
/// less precise is only of use to a track, which knows the rest: its covariance says how much. One that is not finite is
/// not precise.
pub fn is_precise(covariance: &Matrix6<f64>) -> bool {
    is_within_false(covariance, SIGMAS_OF_ALIGNMENT)
}

/// Whether a pose by corners alone is of use by itself, by its covariance.
pub fn is_precise_by_corners(covariance: &Matrix6<f64>) -> bool {
    is_within_false(covariance, SIGMAS_OF_CORNERS)
}

fn is_within_false(covariance: &Matrix6<f64>, sigmas: f64) -> bool {
    let PoseDeviations { position_m, rotation_rad } = PoseDeviations::of(covariance);
    sigmas * position_m < FALSE_POSITION_M && sigmas * rotation_rad < FALSE_ROTATION_RAD
}

impl Alignment {
    /// Whether the body is there, by the picture alone.
    pub fn is_accepted(&self) -> bool {
        self.evidence.log_odds >= least_log_odds(ANYWHERE_PER_HOUR)
    }

    /// Whether the body is there, where a track predicts it. `prior_log_odds` speak for how it lies to the prediction.
    /// Whether it is where the track expects it is for the filter to decide.
    pub fn is_accepted_with_track_prior(&self, prior_log_odds: f64) -> bool {
        self.evidence.log_odds + prior_log_odds >= least_log_odds(PREDICTED_PER_HOUR)
    }

    /// Whether the body is there, where markers were decoded at this pose. `prior_log_odds` speak for what else is
    /// known: a mirror pose has its marker at the same place.
    pub fn is_accepted_with_markers(&self, prior_log_odds: f64) -> bool {
        self.evidence.log_odds + prior_log_odds >= least_log_odds(MARKED_PER_HOUR)
    }
}

impl Evidence {
    /// Whether the facets beside the most informative one say that the body is there in this attitude, and not in the
    /// one that is mirrored by that facet.
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
