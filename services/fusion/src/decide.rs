//! All decisions about poses: which tried pose is the body's, and whether it is usable by itself.
//!
//! A decision is a value. Passes collect [`Hypothesis`]es and [`CornerPose`]s, and a function of
//! this module returns the [`Decision`] about them. The account and `flockeye explain` print it.
//! Explain compares with the limits alone, to name the one that a refused pose missed.
//!
//! The limits are formulas of `acceptance.rs` in imaging, and within fusion only this module uses
//! them. The least lead is one of geometry, because the filter needs it too. Each alignment states
//! whether it is precise before the factor of the picture's coding.
//!
//! | module | what it decides |
//! | --- | --- |
//! | this one | which hypothesis is the body's pose |
//! | [`markers`] | whether decoded markers support or contradict a pose |
//! | [`rivals`] | which poses compete with one |
//! | [`outcome`] | the outcome of a measured pose: publication, a correction of the track, or nothing |

pub(crate) mod markers;
pub(crate) mod outcome;
mod rivals;
#[cfg(test)]
mod tests;

use flockeye_contract::MeasuredBy;
use flockeye_geometry::filter::RivalPose;
use flockeye_geometry::pose::{
    PoseEstimate, PoseSolution, least_lead, position_deviation_m, rotation_deviation_rad,
};
use flockeye_imaging::align::{Alignment, is_precise_by_corners};
use nalgebra::Isometry3;

use self::rivals::rivals_of;
use crate::hypothesis::{CornerPose, CornerVerdict, Hypothesis, StartSource};
use crate::measurement::PoseMeasurement;
use crate::policy::TimeBudget;

/// Log of the prior probability of a pose beyond the tilt limit: one in a thousand.
const TILTED_LOG: f64 = -6.9;
/// Standard deviation about each axis of a right pose's rotation from its track's prediction,
/// radians.
const TURN_SIGMA_RAD: f64 = 0.15;
/// Standard deviation of a false pose's rotation from its start, radians, where no body is. Half of
/// those with log odds above 1 had turned by more than 0.46 (docs/results/decisions.md).
const FALSE_TURN_SIGMA_RAD: f64 = 0.3;
/// Least number of decoded markers that fit a pose which neither a track nor alignment supports.
/// One marker may be a misread square, and its mirror pose looks the same.
pub(crate) const MARKERS_WITHOUT_TRACK: usize = 2;

/// Decision about the poses that a pass has tried.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Decision {
    /// The body's pose, or one of two that are possible.
    pub chosen: Option<PoseIndex>,
    /// Where the first rival may be the body's pose instead: the lead of the chosen one over all
    /// rivals, in log odds.
    pub lead: Option<f64>,
    /// Indices of the hypotheses that compete with the likeliest one, the likeliest first.
    pub rivals: Vec<usize>,
    /// Verdict on each hypothesis, in their order.
    pub reasons: Vec<Verdict>,
}

/// The pose that was chosen, by its index.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PoseIndex {
    /// A hypothesis.
    Hypothesis(usize),
    /// A pose from corners alone.
    Corners(usize),
}

/// Verdict on a hypothesis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Verdict {
    /// The hypothesis is the body's pose, according to the picture.
    Accepted,
    /// The hypothesis would be accepted, but another one was more likely.
    LessLikely,
    /// The evidence from the picture and all else is too low.
    BelowThreshold,
    /// The hypothesis is likely. Its standard deviations are too large to start a track with.
    Imprecise,
    /// The hypothesis is likely, but others are too likely beside it: its lead over them, in log
    /// odds.
    Rivals(f64),
    /// A rival of the likeliest one.
    Rival,
    /// The pose contradicts the track.
    OutsideGate,
    /// Nothing could be compared.
    NotAligned,
}

impl Decision {
    fn nothing(tried: &[Hypothesis]) -> Self {
        let reason = |hypothesis: &Hypothesis| match hypothesis.found {
            Ok(_) => Verdict::BelowThreshold,
            Err(_) => Verdict::NotAligned,
        };
        Self { reasons: tried.iter().map(reason).collect(), ..Self::default() }
    }

    /// The index of the chosen hypothesis.
    pub fn hypothesis(&self) -> Option<usize> {
        match self.chosen? {
            PoseIndex::Hypothesis(index) => Some(index),
            PoseIndex::Corners(_) => None,
        }
    }

    /// The chosen hypothesis of `tried`.
    pub fn chosen_of<'t>(&self, tried: &'t [Hypothesis]) -> Option<&'t Alignment> {
        tried.get(self.hypothesis()?)?.alignment()
    }

    fn choose(&mut self, index: usize) {
        self.chosen = Some(PoseIndex::Hypothesis(index));
        self.lead = None;
        self.give_reason(index, Verdict::Accepted);
    }

    /// Chooses a hypothesis beside a confirmed track. An imprecise one is no measurement, and only
    /// corrects the track. A precise one must lead over its mirror pose and over other poses that
    /// the prediction, markers or several facets support.
    fn choose_tracked(&mut self, tried: &[Hypothesis], best: usize) {
        if tried.get(best).is_none_or(|best| !has_precise_pose(best)) {
            return self.choose(best);
        }
        let is_rival = |other: &Hypothesis| {
            other.source == StartSource::Mirror || is_supported_beside_track(other)
        };
        self.choose_among(tried, best, is_rival);
    }

    /// Chooses a hypothesis, unless its rivals are too likely. Then the pose and its likeliest rival
    /// are both possible. With a third one, nothing is chosen.
    fn choose_among(
        &mut self,
        tried: &[Hypothesis],
        best: usize,
        is_rival: impl Fn(&Hypothesis) -> bool,
    ) {
        (self.chosen, self.lead) = (None, None);
        let rivals = rivals_of(tried, best, is_rival);
        let [all, others] = [&rivals[..], rivals.get(1..).unwrap_or_default()]
            .map(|some| some.iter().map(|(_, log_odds)| log_odds.exp()).sum::<f64>());
        let limit = (-least_lead()).exp();
        self.rivals = rivals.iter().map(|(index, _)| *index).collect();
        if all <= limit {
            return self.choose(best);
        }
        let lead = -all.ln();
        self.rivals.clone().into_iter().for_each(|rival| self.give_reason(rival, Verdict::Rival));
        self.give_reason(best, Verdict::Rivals(lead));
        if others <= limit {
            self.chosen = Some(PoseIndex::Hypothesis(best));
            self.lead = Some(lead.max(0.0));
        }
    }

    fn give_reason(&mut self, index: usize, verdict: Verdict) {
        self.reasons.get_mut(index).into_iter().for_each(|reason| *reason = verdict);
    }

    /// Returns this decision with the chosen hypothesis refused for this reason.
    pub fn refused(mut self, verdict: Verdict) -> Self {
        if let Some(index) = self.hypothesis() {
            self.give_reason(index, verdict);
        }
        Self { chosen: None, lead: None, ..self }
    }
}

/// Log of the likelihood ratio of a pose's turn from its track's prediction, if it is right against
/// if it is false. A prediction that is less certain than [`TURN_SIGMA_RAD`] widens both
/// distributions, so that it says little against a mirror pose.
pub fn turn_log(camera_from_markers: &Isometry3<f64>, predicted: &PoseEstimate) -> f64 {
    let rotation = &predicted.camera_from_markers.rotation;
    let turn_rad = camera_from_markers.rotation.angle_to(rotation);
    let predicted_rad = rotation_deviation_rad(&predicted.covariance) / 3f64.sqrt();
    let right_rad = TURN_SIGMA_RAD.max(predicted_rad);
    let wider = FALSE_TURN_SIGMA_RAD.powi(2) - TURN_SIGMA_RAD.powi(2);
    // Two normal densities in three axes.
    let density = |sigma: f64| -3.0 * sigma.ln() - 0.5 * (turn_rad / sigma).powi(2);
    density(right_rad) - density((right_rad.powi(2) + wider).sqrt())
}

/// Whether a prediction alone excludes a mirror pose beside a pose that was found.
pub(crate) fn excludes_mirror(
    predicted: &PoseEstimate,
    found: &Isometry3<f64>,
    mirror: &Isometry3<f64>,
) -> bool {
    turn_log(found, predicted) - turn_log(mirror, predicted) >= least_lead()
}

/// Log odds from the tilt of a pose; `is_within_limit` is `None` if no limit is known.
pub(crate) fn tilt_log(is_within_limit: Option<bool>) -> f64 {
    if is_within_limit == Some(false) { TILTED_LOG } else { 0.0 }
}

/// Whether the track's prediction supports a pose.
fn is_predicted(hypothesis: &Hypothesis) -> bool {
    hypothesis
        .alignment()
        .zip(hypothesis.turn_log)
        .is_some_and(|(found, turn)| found.is_accepted_with_track_prior(turn))
}

/// Whether markers were decoded at the places of a pose that is too weak alone.
fn is_marked(hypothesis: &Hypothesis) -> bool {
    // The prediction may reject a marker's mirror pose. It does not replace missing evidence in the
    // picture.
    let prior_log_odds = hypothesis.turn_log.map_or(0.0, |turn| turn.min(0.0));
    let found = hypothesis.alignment().filter(|_| hypothesis.is_marked);
    found.is_some_and(|found| found.is_accepted_with_markers(prior_log_odds))
}

/// Whether the evidence in the picture alone is enough for a pose.
fn is_accepted(hypothesis: &Hypothesis) -> bool {
    hypothesis.alignment().is_some_and(Alignment::is_accepted)
}

fn has_precise_pose(hypothesis: &Hypothesis) -> bool {
    hypothesis.alignment().is_some_and(|found| found.is_precise)
}

/// Whether the picture alone proves a pose: it is precise and likely, and several facets support it,
/// so that no mirror pose does.
pub(crate) fn is_proven(found: &Alignment) -> bool {
    found.is_precise && found.is_accepted() && found.evidence.is_unambiguous()
}

/// Whether a pose near a prediction needs no alternative: it is precise, and likely by itself and
/// by the prediction.
pub(crate) fn is_certain(hypothesis: &Hypothesis) -> bool {
    has_precise_pose(hypothesis) && is_accepted(hypothesis) && is_predicted(hypothesis)
}

/// Decides about the pose that started from the prediction of a confirmed track alone, the first
/// one, and its mirror pose. Others wait for markers.
pub(crate) fn of_direct_pass(tried: &[Hypothesis]) -> Decision {
    let mut decision = Decision::nothing(tried);
    let Some(first) = tried.first() else { return decision };
    if is_certain(first) {
        decision.choose_tracked(tried, 0);
    } else if is_accepted(first) && is_predicted(first) {
        decision.give_reason(0, Verdict::Imprecise);
    }
    match decision.lead {
        Some(_) => Decision { chosen: None, lead: None, ..decision },
        None => decision,
    }
}

/// Decides about poses of a body that a confirmed track predicts. The certain one is chosen.
/// Otherwise it is the likeliest that the prediction, decoded markers or several facets support,
/// precise or not. A precise one must lead over its rivals.
pub fn of_tracked(tried: &[Hypothesis]) -> Decision {
    let mut decision = Decision::nothing(tried);
    let mut best: Option<(f64, usize)> = None;
    for (index, log_odds) in competitors(tried) {
        let hypothesis = &tried[index];
        if is_certain(hypothesis) {
            best = Some((log_odds, index));
            break;
        }
        if is_supported_beside_track(hypothesis) {
            decision.give_reason(index, Verdict::LessLikely);
            if best.is_none_or(|(most, _)| log_odds > most) {
                best = Some((log_odds, index));
            }
        }
    }
    best.into_iter().for_each(|(_, index)| decision.choose_tracked(tried, index));
    decision
}

/// Whether the prediction, decoded markers or several facets support a pose beside a track.
fn is_supported_beside_track(hypothesis: &Hypothesis) -> bool {
    let is_alone_enough = hypothesis.alignment().is_some_and(is_proven);
    is_predicted(hypothesis) || is_marked(hypothesis) || is_alone_enough
}

/// Whether no other start is needed for an untracked body.
pub(crate) fn ends_competition(last: &Hypothesis, budget: TimeBudget) -> bool {
    budget != TimeBudget::Unlimited && last.alignment().is_some_and(is_proven)
}

/// Whether a pose may be an untracked body's, apart from its precision.
fn is_likely(hypothesis: &Hypothesis) -> bool {
    is_accepted(hypothesis) || is_marked(hypothesis)
}

/// The hypotheses with a pose: their indices and log odds.
fn competitors(tried: &[Hypothesis]) -> impl Iterator<Item = (usize, f64)> {
    let all = tried.iter().enumerate();
    all.filter_map(|(index, hypothesis)| Some((index, hypothesis.log_odds()?)))
}

/// The likeliest precise pose of an untracked body, whose mirror pose must be tried too.
pub(crate) fn likeliest(tried: &[Hypothesis]) -> Option<usize> {
    competitors(tried)
        .filter(|(index, _)| has_precise_pose(&tried[*index]) && is_likely(&tried[*index]))
        .max_by(|(_, one), (_, other)| one.total_cmp(other))
        .map(|(index, _)| index)
}

/// Decides about poses of a body that no confirmed track predicts. The [`likeliest`] one must lead
/// over its rivals.
pub(crate) fn of_untracked(tried: &[Hypothesis], likeliest: Option<usize>) -> Decision {
    let mut decision = Decision::nothing(tried);
    for (index, _) in competitors(tried).filter(|(index, _)| is_likely(&tried[*index])) {
        let is_precise = has_precise_pose(&tried[index]);
        let verdict = if is_precise { Verdict::LessLikely } else { Verdict::Imprecise };
        decision.give_reason(index, verdict);
    }
    if let Some(best) = likeliest {
        decision.choose_among(tried, best, |_| true);
    }
    decision
}

/// Whether a pose from corners is acceptable as a measurement: if enough markers fit and its
/// covariance is small enough. With a confirmed track, whose prediction is `prior`, `min_markers`
/// must fit. One marker alone is enough only where the prediction itself could not be false. `lead`
/// is the pose's lead over all others ([`flockeye_geometry::pose::lead`]).
pub(crate) fn of_corners(
    solution: &PoseSolution,
    prior: Option<&PoseEstimate>,
    min_markers: usize,
    lead: f64,
) -> CornerVerdict {
    let wanted = if prior.is_some() { min_markers } else { MARKERS_WITHOUT_TRACK };
    if solution.inlier_markers.len() < wanted {
        return CornerVerdict::TooFewMarkers { wanted };
    }
    // Corners blurred by motion favour a mirror pose by some deviations. One marker has no others
    // that contradict it.
    if lead < least_lead() {
        return CornerVerdict::Ambiguous { lead };
    }
    let covariance = solution.inflated_covariance();
    if !is_precise_by_corners(&covariance) {
        return CornerVerdict::TooUncertain {
            position_m: position_deviation_m(&covariance),
            rotation_rad: rotation_deviation_rad(&covariance),
        };
    }
    let is_prior_precise = prior.is_some_and(|prior| is_precise_by_corners(&prior.covariance));
    if solution.inlier_markers.len() < MARKERS_WITHOUT_TRACK && !is_prior_precise {
        return CornerVerdict::OneMarker;
    }
    CornerVerdict::Enough
}

/// Decides again if the last hypothesis is the mirror pose of the chosen one.
pub(crate) fn with_mirror(mut decision: Decision, tried: &[Hypothesis]) -> Decision {
    decision.reasons.extend(Decision::nothing(tried).reasons.pop());
    decision.hypothesis().into_iter().for_each(|best| decision.choose_tracked(tried, best));
    decision
}

/// Chooses between the picture and the corners alone: a precise pose comes first, then one from the
/// picture.
pub(crate) fn with_corners(
    decision: Decision,
    tried: &[Hypothesis],
    corner_poses: &[CornerPose],
) -> Decision {
    let of_use = |pose: &CornerPose| {
        let corrects_track = match pose.verdict {
            CornerVerdict::Enough
            | CornerVerdict::OneMarker
            | CornerVerdict::TooUncertain { .. } => true,
            CornerVerdict::TooFewMarkers { .. } | CornerVerdict::Ambiguous { .. } => false,
        };
        pose.is_chosen
            && corrects_track
            && pose.solution.inflated_covariance().iter().all(|x| x.is_finite())
    };
    let Some(index) = corner_poses.iter().position(of_use) else { return decision };
    let are_corners_precise = corner_poses[index].verdict == CornerVerdict::Enough;
    let is_precise = decision.chosen_of(tried).is_some_and(|found| found.is_precise);
    let is_decided = is_precise && decision.lead.is_none();
    match decision.chosen {
        Some(_) if is_decided || !are_corners_precise => decision,
        _ => Decision { chosen: Some(PoseIndex::Corners(index)), lead: None, ..decision },
    }
}

/// The chosen measurement, with this number of decoded markers.
pub(crate) fn measurement(
    decision: &Decision,
    tried: &[Hypothesis],
    corner_poses: &[CornerPose],
    markers: u32,
) -> Option<PoseMeasurement> {
    match decision.chosen? {
        PoseIndex::Hypothesis(index) => {
            let measurement = PoseMeasurement::aligned(tried.get(index)?.alignment()?, markers);
            let rival = decision.lead.and_then(|lead| {
                let rival = tried.get(*decision.rivals.first()?)?.alignment()?;
                Some(RivalPose { pose: rival.pose(), lead })
            });
            let is_proven = measurement.is_proven && rival.is_none();
            Some(PoseMeasurement { rival, is_proven, ..measurement })
        }
        PoseIndex::Corners(index) => {
            let CornerPose { solution, verdict, .. } = corner_poses.get(index)?;
            let camera_from_markers = solution.camera_from_markers;
            let covariance = solution.inflated_covariance();
            Some(PoseMeasurement {
                pose: PoseEstimate { camera_from_markers, covariance },
                rival: None,
                measured_by: MeasuredBy::Decoded,
                markers,
                is_precise: *verdict == CornerVerdict::Enough,
                is_proven: false,
                shown: None,
            })
        }
    }
}
