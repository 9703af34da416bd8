//! All decisions about an alignment, and the limits that they use.
//!
//! [`super::evidence`] states what the image says; here it is decided whether that is enough. How much is
//! enough depends on what else is known: nothing, a track that predicts the body there, or markers that
//! were decoded there.

use super::alignment::Alignment;
use super::evidence::{Evidence, FacetLimits};

/// Least correlation of a facet that agrees. A facet below it is occluded, if another one agrees.
pub(super) const AGREEING_CORRELATION: f64 = 0.6;

/// Which facets [`Evidence`] counts as agreeing and as discriminative.
///
/// Discriminative limits: in 5913 views of simulated bodies at 0.8 to 3.6 m, aligned without a track, two
/// facets agreed with a wrong attitude in 257 cases. In 255 of these the second facet was below the
/// limits. In the right attitude it was above them in 325 of 420 cases (pixels that show nothing else
/// alone).
pub(super) const FACET_LIMITS: FacetLimits =
    FacetLimits { agreeing_correlation: AGREEING_CORRELATION, discriminative: (0.8, 30.0) };

/// This many discriminative facets make a pose unambiguous. One facet can look the same in two attitudes.
/// A second one of a few pixels, or one that half agrees, agrees by chance with any attitude.
const MIN_DISCRIMINATIVE_FACETS: u32 = 2;

/// This many agreeing facets make a pose unambiguous: it is no mirror image. One facet and the chance
/// agreement of a second one led to an attitude that was wrong by 33 degrees.
pub const UNAMBIGUOUS_FACETS: u32 = 3;

/// A body is accepted without other knowledge above any of these pairs of mean correlation and
/// log-likelihood ratio. The fewer cells agree on average, because something occludes part of the body for
/// instance, the larger the ratio must be.
///
/// Of 4776 wrong bodies aligned in place of the right one, on two simulated flights at 0.6 to 4 m, those
/// nearby reach 0.25 with 39, those beyond 2.5 m 0.48 with 18 and 0.7 with 9. Right ones accepted by this
/// table have a ratio of 30 and more.
const ACCEPTED: [(f64, f64); 3] = [(0.7, 20.0), (0.47, 30.0), (0.27, 200.0)];

/// A body is accepted without other knowledge only if this many facets agree, or one has
/// [`SINGLE_FACET_LOG_RATIO`]. A single facet far away is a handful of pixels, and may be anything with a
/// chequered pattern.
const MIN_AGREEING_FACETS: u32 = 2;

/// Least log-likelihood ratio of a body of which fewer facets agree than [`MIN_AGREEING_FACETS`].
const SINGLE_FACET_LOG_RATIO: f64 = 100.0;

/// Pairs as in [`ACCEPTED`] for a body that a track predicts there. One small facet that agrees very well
/// is enough, or one facet of a body whose others are occluded. None of the 4776 wrong bodies reaches
/// either pair.
const ACCEPTED_WITH_TRACK_PRIOR: [(f64, f64); 2] = [(0.8, 25.0), (0.15, 150.0)];

/// Pairs as in [`ACCEPTED`] for a body of which markers were decoded there. Most of it may be occluded,
/// but [`MIN_AGREEING_FACETS`] must agree, so that it is not the marker's mirror image.
const ACCEPTED_WITH_MARKERS: [(f64, f64); 1] = [(0.15, 50.0)];

/// Least share of the samples without occlusion. Below it facets agree by chance, while an airframe in
/// front of the body explains the rest; nor are the pixels left out then.
///
/// On simulated flights out to 4 m, one of three poses with a smaller share was wrong by 11 degrees. None
/// of 1894 with a larger one was wrong by 7 degrees or more.
pub(super) const MIN_VISIBLE_SHARE: f64 = 0.25;

/// Largest standard deviation of position (m) and rotation (rad), over all axes together. Beyond it,
/// mostly because most of the body is occluded, errors are not normal any more.
///
/// On simulated flights out to 4 m, a pose with standard deviations of 32 mm and 4.1 degrees was wrong by
/// 175 mm, and one with 3.4 degrees by 12 degrees.
const MAX_SIGMAS: (f64, f64) = (0.036, 0.055);

/// The same where [`UNAMBIGUOUS_FACETS`] agree and the mean correlation is at least
/// [`WELL_AGREEING_CORRELATION`].
///
/// On twelve simulated flights 99 such poses had standard deviations of 36 to 55 mm or 3.2 to 5.7 degrees.
/// They were wrong by 30 mm in the median, and by 85 mm and 4.9 degrees at most.
const MAX_SIGMAS_WELL_AGREEING: (f64, f64) = (0.04, 0.087);

/// See [`MAX_SIGMAS_WELL_AGREEING`].
const WELL_AGREEING_CORRELATION: f64 = 0.8;

/// Least visible share of a body of which hardly anything is occluded. Chosen on one rendered flight in wind,
/// whose track was lost where clear poses of one facet were refused; no curve was read for it.
const CLEAR_SHARE: f64 = 0.9;

/// A fit without the occluded facets is kept if it has at least this share of the log-likelihood ratio
/// that it had with them.
const MIN_KEPT_LOG_RATIO: f64 = 0.8;

impl Alignment {
    /// Whether it is a measurement without other knowledge: the body is there, and its pose is precise
    /// enough to be of use.
    pub fn is_accepted(&self) -> bool {
        self.evidence.is_accepted() && self.is_visible() && self.is_precise()
    }

    /// The same for a body that a track predicts there. Whether it is where the track expects it is for
    /// the filter to decide.
    pub fn is_accepted_with_track_prior(&self) -> bool {
        let is_precise = self.is_precise() || self.is_clear_and_precise();
        self.evidence.is_accepted_with_track_prior() && self.is_visible() && is_precise
    }

    /// The same for a body of which markers were decoded where this pose has them.
    pub fn is_accepted_with_markers(&self) -> bool {
        self.evidence.is_accepted_with_markers() && self.is_visible() && self.is_precise()
    }

    fn is_visible(&self) -> bool {
        self.visible_share >= MIN_VISIBLE_SHARE
    }

    fn is_precise(&self) -> bool {
        let agrees_well = self.evidence.agreeing_facets >= UNAMBIGUOUS_FACETS
            && self.evidence.correlation >= WELL_AGREEING_CORRELATION;
        self.has_sigmas_below(if agrees_well { MAX_SIGMAS_WELL_AGREEING } else { MAX_SIGMAS })
    }

    /// Whether little is occluded, what is seen agrees well, and the pose is of some use to a track, which
    /// knows the attitude as well: it takes in of each axis what is known of it.
    fn is_clear_and_precise(&self) -> bool {
        self.evidence.correlation >= WELL_AGREEING_CORRELATION
            && self.visible_share >= CLEAR_SHARE
            && self.has_sigmas_below(MAX_SIGMAS_WELL_AGREEING)
    }

    fn has_sigmas_below(&self, (position_m, rotation_rad): (f64, f64)) -> bool {
        let sigma = |first| self.covariance.fixed_view::<3, 3>(first, first).trace().sqrt();
        sigma(0) < position_m && sigma(3) < rotation_rad
    }
}

impl Evidence {
    /// Whether the facets say that the body is there in this attitude, and not in a mirrored one.
    pub fn is_unambiguous(&self) -> bool {
        self.discriminative_facets >= MIN_DISCRIMINATIVE_FACETS
            || self.agreeing_facets >= UNAMBIGUOUS_FACETS
    }

    fn is_accepted(&self) -> bool {
        let has_enough_facets =
            self.agreeing_facets >= MIN_AGREEING_FACETS || self.log_ratio > SINGLE_FACET_LOG_RATIO;
        has_enough_facets && self.exceeds_any(&ACCEPTED)
    }

    fn is_accepted_with_track_prior(&self) -> bool {
        self.is_accepted() || self.exceeds_any(&ACCEPTED_WITH_TRACK_PRIOR)
    }

    fn is_accepted_with_markers(&self) -> bool {
        self.agreeing_facets >= MIN_AGREEING_FACETS && self.exceeds_any(&ACCEPTED_WITH_MARKERS)
    }

    fn exceeds_any(&self, limits: &[(f64, f64)]) -> bool {
        limits.iter().any(|&(correlation, log_ratio)| {
            self.correlation > correlation && self.log_ratio > log_ratio
        })
    }
}

/// Whether a fit without the occluded facets is kept instead of the one before.
pub(super) fn is_refit_kept(before: &Evidence, after: &Evidence) -> bool {
    let is_worse = after.log_ratio < MIN_KEPT_LOG_RATIO * before.log_ratio;
    !is_worse
}

#[cfg(test)]
mod tests {
    use super::*;

    fn evidence(
        correlation: f64,
        log_ratio: f64,
        agreeing_facets: u32,
        discriminative_facets: u32,
    ) -> Evidence {
        Evidence {
            correlation,
            log_ratio,
            agreeing_facets,
            discriminative_facets,
            ..Evidence::default()
        }
    }

    #[test]
    fn two_discriminative_facets_or_three_agreeing_ones_are_unambiguous() {
        assert!(evidence(0.5, 140.0, 2, 2).is_unambiguous());
        assert!(!evidence(0.5, 140.0, 2, 1).is_unambiguous());
        assert!(!evidence(0.9, 500.0, 1, 1).is_unambiguous());
        assert!(evidence(0.8, 90.0, 3, 1).is_unambiguous());
    }

    #[test]
    fn a_mirror_image_can_be_accepted_too() {
        // From one picture: the right attitude, and the mirror image by the most informative facet.
        assert!(evidence(0.68, 210.0, 3, 2).is_accepted());
        assert!(evidence(0.29, 215.0, 2, 1).is_accepted());
    }

    #[test]
    fn a_single_facet_needs_a_track_or_a_large_ratio() {
        let single = evidence(0.9, 60.0, 1, 1);
        assert!(!single.is_accepted() && single.is_accepted_with_track_prior());
        assert!(!single.is_accepted_with_markers());
        assert!(evidence(0.9, 120.0, 1, 1).is_accepted());
    }
}
