//! All decisions about poses: which one of those that were tried is the body's, and whether it is of use by itself.
//!
//! A decision is a value. Passes collect [`Hypothesis`]es and [`CornerPose`]s, a function of this module gives the
//! [`Decision`] about them, and the account and `flockeye explain` print it. Explain compares with the limits alone, to
//! name the one that a refused pose missed.
//!
//! The limits are formulas of `acceptance.rs` in imaging, and within fusion only this module asks for them. They stay
//! there because alignment needs two of them. Its search round a prediction ends at the first accepted pose. Each
//! alignment states whether it is precise before the factor of the picture's coding.
//!
//! | module | what it decides |
//! | --- | --- |
//! | this one | which hypothesis is the body's pose |
//! | [`markers`] | whether decoded markers support or contradict a pose |
//! | [`outcome`] | what becomes of a measured pose: publication, a correction of the track, or nothing |

pub mod markers;
pub mod outcome;
#[cfg(test)]
mod tests;

use flockeye_geometry::pose::{PoseDeviations, PoseSolution, is_false};
use flockeye_imaging::align::{Alignment, is_precise_by_corners, least_lead};
use nalgebra::Isometry3;

use crate::hypothesis::{CornerPose, CornerVerdict, Hypothesis, Source};
use crate::measurement::{MeasuredBy, Measurement, PoseEstimate};
use crate::policy::TimeBudget;

/// Log of the prior probability of a pose beyond the tilt limit: one in a thousand.
const TILTED_LOG: f64 = -6.9;
/// Standard deviation, about each axis, of the turn of right poses from their tracks' predictions, radians.
const TURN_SIGMA_RAD: f64 = 0.15;
/// Standard deviation of the turn from its start, radians, of a pose that alignment finds where no body is. Half of
/// those with log odds above 1 had turned by more than 0.46 (docs/results/decisions.md).
const FALSE_TURN_SIGMA_RAD: f64 = 0.3;
/// Decoded markers that must agree on a pose where neither a track nor alignment supports it. One marker may be
/// a misread square, and its mirror pose cannot be told from it.
pub const MARKERS_WITHOUT_TRACK: usize = 2;

/// What was decided about the poses that a pass has tried.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Decision {
    /// The body's pose.
    pub chosen: Option<Choice>,
    /// Indices of the hypotheses that compete with the likeliest one, the likeliest first.
    pub rivals: Vec<usize>,
    /// What was decided of each hypothesis, and why, in the order of the hypotheses.
    pub reasons: Vec<Verdict>,
}

/// The pose that was chosen, by its index.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Choice {
    /// A hypothesis.
    Hypothesis(usize),
    /// A pose from corners alone.
    Corners(usize),
}

/// What was decided of a hypothesis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Verdict {
    /// The hypothesis is the body's pose, as far as the picture says.
    Accepted,
    /// The hypothesis would do, and another one was more likely.
    LessLikely,
    /// The picture and all else say too little for it.
    BelowThreshold,
    /// The hypothesis is likely. Its standard deviations are too large to start a track with.
    Imprecise,
    /// The hypothesis is likely, and others are too likely beside it: its lead, in log odds.
    Rivals(f64),
    /// A rival of the likeliest one.
    Rival,
    /// One facet alone tells it, and starts that the background pass will try may tell another.
    OneFacetAlone,
    /// The pose is not where the track can be.
    OutsideGate,
    /// Nothing could be compared.
    NotAligned,
    /// The search found nothing that is accepted.
    NothingFound,
}

impl Decision {
    /// No pose is chosen.
    fn nothing(tried: &[Hypothesis]) -> Self {
        let reason = |hypothesis: &Hypothesis| match hypothesis.found {
            Ok(_) => Verdict::BelowThreshold,
            Err(_) => Verdict::NotAligned,
        };
        Self { chosen: None, rivals: Vec::new(), reasons: tried.iter().map(reason).collect() }
    }

    /// The index of the chosen hypothesis.
    pub fn hypothesis(&self) -> Option<usize> {
        match self.chosen? {
            Choice::Hypothesis(index) => Some(index),
            Choice::Corners(_) => None,
        }
    }

    /// The chosen hypothesis of those that were tried.
    pub fn chosen_of<'t>(&self, tried: &'t [Hypothesis]) -> Option<&'t Alignment> {
        tried.get(self.hypothesis()?)?.alignment()
    }

    /// Chooses a hypothesis.
    fn choose(&mut self, index: usize) {
        self.chosen = Some(Choice::Hypothesis(index));
        self.give_reason(index, Verdict::Accepted);
    }

    fn give_reason(&mut self, index: usize, verdict: Verdict) {
        self.reasons.get_mut(index).into_iter().for_each(|reason| *reason = verdict);
    }

    /// Returns this decision with the chosen hypothesis refused for a reason.
    pub fn refused(mut self, verdict: Verdict) -> Self {
        if let Some(index) = self.hypothesis() {
            self.give_reason(index, verdict);
        }
        Self { chosen: None, ..self }
    }
}

/// Log of the likelihood ratio of a pose's turn from its track's prediction, if it is right against if it is false. A
/// neighbour that was out of sight for a third of a second may have turned by as much as its mirror pose, and the
/// filter's gate allows for that.
pub fn turn_log(found: &Alignment, predicted: &Isometry3<f64>) -> f64 {
    let turn_rad = found.camera_from_markers.rotation.angle_to(&predicted.rotation);
    // Two normal densities in three axes.
    let density = |sigma: f64| -3.0 * sigma.ln() - 0.5 * (turn_rad / sigma).powi(2);
    density(TURN_SIGMA_RAD) - density(FALSE_TURN_SIGMA_RAD)
}

/// What the tilt of a pose adds to its log odds; `is_within_limit`: `None` where no limit is known.
pub fn tilt_log(is_within_limit: Option<bool>) -> f64 {
    if is_within_limit == Some(false) { TILTED_LOG } else { 0.0 }
}

/// Whether the track's prediction supports a pose.
fn is_predicted(found: &Alignment, hypothesis: &Hypothesis) -> bool {
    hypothesis.turn_log.is_some_and(|turn| found.is_accepted_with_track_prior(turn))
}

/// Whether markers were decoded where a pose has them that is too weak alone.
fn is_marked(found: &Alignment, hypothesis: &Hypothesis) -> bool {
    // The prediction may speak against a marker's mirror pose. It does not make up for what the picture lacks.
    let prior_log_odds = hypothesis.turn_log.map_or(0.0, |turn| turn.min(0.0));
    hypothesis.is_marked && found.is_accepted_with_markers(prior_log_odds)
}

/// Whether a pose near a prediction needs no other beside it: it is precise, and likely by itself and by the prediction.
pub fn is_certain(hypothesis: &Hypothesis) -> bool {
    hypothesis.alignment().is_some_and(|found| {
        found.is_precise && found.is_accepted() && is_predicted(found, hypothesis)
    })
}

/// Decides about the pose that the prediction of a confirmed track alone led to.
pub fn of_direct_pass(tried: &Hypothesis) -> Decision {
    let mut decision = Decision::nothing(std::slice::from_ref(tried));
    if is_certain(tried) {
        decision.choose(0);
    } else if tried
        .alignment()
        .is_some_and(|found| found.is_accepted() && is_predicted(found, tried))
    {
        decision.give_reason(0, Verdict::Imprecise);
    }
    decision
}

/// Decides about poses of a body that a confirmed track predicts. The certain one is chosen. Where none is, it is the
/// likeliest that the prediction or decoded markers support, precise or not.
pub fn of_tracked(tried: &[Hypothesis]) -> Decision {
    let mut decision = Decision::nothing(tried);
    let mut best: Option<(f64, usize)> = None;
    for (index, hypothesis) in tried.iter().enumerate() {
        let (Some(found), Some(log_odds)) = (hypothesis.alignment(), hypothesis.log_odds()) else {
            continue;
        };
        if is_certain(hypothesis) {
            best = Some((log_odds, index));
            break;
        }
        if is_predicted(found, hypothesis) || is_marked(found, hypothesis) {
            decision.give_reason(index, Verdict::LessLikely);
            if best.is_none_or(|(most, _)| log_odds > most) {
                best = Some((log_odds, index));
            }
        }
    }
    best.into_iter().for_each(|(_, index)| decision.choose(index));
    decision
}

/// Whether no other start need be tried for an untracked body.
pub fn ends_competition(last: &Hypothesis, budget: TimeBudget) -> bool {
    let is_certain = |found: &Alignment| {
        found.is_accepted() && found.is_precise && found.evidence.is_unambiguous()
    };
    budget != TimeBudget::Unlimited && last.alignment().is_some_and(is_certain)
}

/// Whether a pose may be an untracked body's, apart from its precision.
fn is_likely(found: &Alignment, hypothesis: &Hypothesis) -> bool {
    found.is_accepted() || is_marked(found, hypothesis)
}

/// The likeliest precise pose of an untracked body. Its mirror pose is to be tried too.
pub fn likeliest(tried: &[Hypothesis]) -> Option<usize> {
    let may_win = |found: &Alignment, hypothesis: &Hypothesis| {
        found.is_precise && is_likely(found, hypothesis)
    };
    competitors(tried)
        .into_iter()
        .filter(|one| may_win(one.found, &tried[one.index]))
        .max_by(|one, other| one.log_odds.total_cmp(&other.log_odds))
        .map(|best| best.index)
}

/// A hypothesis with a pose, among others.
#[derive(Debug, Clone, Copy)]
struct Competitor<'t> {
    index: usize,
    found: &'t Alignment,
    log_odds: f64,
}

fn competitors(tried: &[Hypothesis]) -> Vec<Competitor<'_>> {
    let all = tried.iter().enumerate().filter_map(|(index, hypothesis)| {
        let (found, log_odds) = (hypothesis.alignment()?, hypothesis.log_odds()?);
        Some(Competitor { index, found, log_odds })
    });
    all.collect()
}

/// Decides about poses of a body that no confirmed track predicts. The [`likeliest`] one is chosen if it is much likelier
/// than all others together. Where one facet alone may not decide yet (`needs_facets`), several must tell it.
pub fn of_untracked(
    tried: &[Hypothesis],
    likeliest: Option<usize>,
    needs_facets: bool,
) -> Decision {
    let mut decision = Decision::nothing(tried);
    let all = competitors(tried);
    for one in &all {
        if is_likely(one.found, &tried[one.index]) {
            let verdict =
                if one.found.is_precise { Verdict::LessLikely } else { Verdict::Imprecise };
            decision.give_reason(one.index, verdict);
        }
    }
    let Some(best) = all.iter().find(|one| Some(one.index) == likeliest) else { return decision };
    let mut rivals: Vec<&Competitor<'_>> =
        all.iter().filter(|other| !is_same(best.found, other.found)).collect();
    rivals.sort_by(|one, other| other.log_odds.total_cmp(&one.log_odds));
    // Starts that led to the same pose are one rival: the most likely of them.
    let mut distinct: Vec<&Competitor<'_>> = Vec::new();
    for rival in rivals {
        if !distinct.iter().any(|other| is_same(other.found, rival.found)) {
            distinct.push(rival);
        }
    }
    let together: f64 = distinct.iter().map(|rival| (rival.log_odds - best.log_odds).exp()).sum();
    let has_lead = together <= (-least_lead()).exp();
    decision.rivals = distinct.iter().map(|rival| rival.index).collect();
    if !has_lead {
        distinct.iter().for_each(|rival| decision.give_reason(rival.index, Verdict::Rival));
        decision.give_reason(best.index, Verdict::Rivals(-together.ln()));
    } else if needs_facets && !best.found.evidence.is_unambiguous() {
        decision.give_reason(best.index, Verdict::OneFacetAlone);
    } else {
        decision.choose(best.index);
    }
    decision
}

/// Whether two poses are the same for whoever uses them: neither is false if the other one is true.
fn is_same(one: &Alignment, other: &Alignment) -> bool {
    !is_false(&one.camera_from_markers, &other.camera_from_markers)
}

/// Whether nothing need be searched for round the prediction: a precise pose is chosen.
pub fn is_precise(decision: &Decision, tried: &[Hypothesis]) -> bool {
    decision.chosen_of(tried).is_some_and(|found| found.is_precise)
}

/// Decides again when the last hypothesis is what a search round the prediction found: the likelier one of that and of
/// what was chosen before.
pub fn with_search(
    mut decision: Decision,
    tried: &[Hypothesis],
    predicted: &Isometry3<f64>,
) -> Decision {
    let Some((last, searched)) = tried.iter().enumerate().next_back() else { return decision };
    let Some(searched) = searched.alignment() else {
        decision.reasons.push(Verdict::NothingFound);
        return decision;
    };
    decision.reasons.push(Verdict::LessLikely);
    let likelihood = |found: &Alignment| found.evidence.log_odds + turn_log(found, predicted);
    let before = decision.hypothesis().zip(decision.chosen_of(tried));
    match before {
        Some((_, before)) if likelihood(before) > likelihood(searched) => {}
        Some((index, _)) => {
            decision.give_reason(index, Verdict::LessLikely);
            decision.choose(last);
        }
        None => decision.choose(last),
    }
    decision
}

/// Whether a pose that the corners give would do as a measurement: if enough of them agree and it is certain enough. With
/// a confirmed track `min_markers` must agree.
pub fn of_corners(
    solution: &PoseSolution,
    is_confirmed: bool,
    min_markers: usize,
) -> CornerVerdict {
    let wanted = if is_confirmed { min_markers } else { MARKERS_WITHOUT_TRACK };
    if solution.inlier_markers.len() < wanted {
        return CornerVerdict::TooFewMarkers { wanted };
    }
    let covariance = solution.inflated_covariance();
    if is_precise_by_corners(&covariance) {
        return CornerVerdict::Enough;
    }
    let PoseDeviations { position_m, rotation_rad } = PoseDeviations::of(&covariance);
    CornerVerdict::TooUncertain { position_m, rotation_rad }
}

/// Decides between the picture and the corners alone: a precise pose comes first, then one of the picture.
pub fn with_corners(
    decision: Decision,
    tried: &[Hypothesis],
    corner_poses: &[CornerPose],
) -> Decision {
    let of_use = |pose: &CornerPose| {
        let is_enough = !matches!(pose.verdict, CornerVerdict::TooFewMarkers { .. });
        pose.is_chosen
            && is_enough
            && pose.solution.inflated_covariance().iter().all(|x| x.is_finite())
    };
    let Some(index) = corner_poses.iter().position(of_use) else { return decision };
    let are_corners_precise = corner_poses[index].verdict == CornerVerdict::Enough;
    let by_picture = is_precise(&decision, tried) || !are_corners_precise;
    match decision.chosen {
        Some(_) if by_picture => decision,
        _ => Decision { chosen: Some(Choice::Corners(index)), ..decision },
    }
}

/// The measurement that was chosen, with so many markers decoded.
pub fn measurement(
    decision: &Decision,
    tried: &[Hypothesis],
    corner_poses: &[CornerPose],
    markers: u32,
) -> Option<Measurement> {
    match decision.chosen? {
        Choice::Hypothesis(index) => {
            Some(Measurement::aligned(tried.get(index)?.alignment()?, markers))
        }
        Choice::Corners(index) => {
            let CornerPose { solution, verdict, .. } = corner_poses.get(index)?;
            let camera_from_markers = solution.camera_from_markers;
            let covariance = solution.inflated_covariance();
            Some(Measurement {
                pose: PoseEstimate { camera_from_markers, covariance },
                measured_by: MeasuredBy::Decoded,
                markers,
                is_precise: *verdict == CornerVerdict::Enough,
            })
        }
    }
}

/// Whether a chosen pose owes nothing to a track's prediction, so that it may start a track.
pub fn is_independent(decision: &Decision, tried: &[Hypothesis], is_confirmed: bool) -> bool {
    let chosen = decision.hypothesis().and_then(|index| tried.get(index));
    !is_confirmed && chosen.is_some_and(|hypothesis| hypothesis.source != Source::Search)
}
