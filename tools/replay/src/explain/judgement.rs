//! Finds the step of the pipeline that decided the result: the first one that failed, as a
//! sentence.

use flockeye_contract::{MeasuredBy, StopReason, ViewKind};
use flockeye_fusion::{AccountEntry, CornerVerdict, Hypothesis, Outcome, Pass, Verdict};

use super::explanation::{DecisiveStep, FrameExplanation, ViewFacts};
use super::known::FrameKnowledge;
use super::passes::{decided, pass_name};
use super::poses::TargetPlace;

/// Largest angle between a hypothesis and the body's expected direction, radians. The view of a
/// proposal for a body at 2 m is narrower.
const ELSEWHERE_RAD: f64 = 0.1;

/// The step that decided the result, and its description.
pub(super) fn of(
    known: &FrameKnowledge,
    explanation: &FrameExplanation,
    place: Option<&TargetPlace>,
) -> (DecisiveStep, String) {
    let (step, mut why) = decisive(known, explanation, place);
    if let (true, Some(other)) = (step != DecisiveStep::Measured, &explanation.hidden_by) {
        why.push_str(&format!(". {other} is in front of it and may hide it"));
    }
    (step, why)
}

fn decisive(
    known: &FrameKnowledge,
    explanation: &FrameExplanation,
    place: Option<&TargetPlace>,
) -> (DecisiveStep, String) {
    if let Some(measured) = measured(known, explanation) {
        return (DecisiveStep::Measured, measured);
    }
    if let Some(said) = by_outcome(known) {
        return said;
    }
    if !known.gathered.has_ended() {
        let why =
            "the recording has no end of this frame: it was given up, or its recording was cut off";
        return (DecisiveStep::NotEnded, why.to_owned());
    }
    // Markers elsewhere belong to other bodies.
    let has_decoded = explanation.markers.iter().any(|marker| marker.is_at_place != Some(false));
    match place {
        _ if has_decoded => {}
        Some(place) => {
            if let Some(said) = of_views(explanation, place) {
                return said;
            }
        }
        None => return (DecisiveStep::NoPlaceKnown, no_place(known, explanation)),
    }
    if let Some(said) = by_hypotheses(known, place) {
        return said;
    }
    if let Some(said) = by_corners(known) {
        return said;
    }
    if !has_decoded {
        return (DecisiveStep::NothingFound, searched(explanation));
    }
    let ids = ids(explanation);
    let why = format!("markers {ids} were decoded and led to no pose{}", untold(explanation));
    (DecisiveStep::Untold, why)
}

/// Explains, as the end of a sentence, why the reason is not known.
fn untold(explanation: &FrameExplanation) -> &'static str {
    match explanation.reliance.is_exact {
        true => "",
        false => "; why cannot be told without a replay",
    }
}

fn ids(explanation: &FrameExplanation) -> String {
    let at_place = explanation.markers.iter().filter(|marker| marker.is_at_place != Some(false));
    let mut ids: Vec<u32> = at_place.map(|marker| marker.id).collect();
    ids.sort_unstable();
    ids.dedup();
    ids.iter().map(u32::to_string).collect::<Vec<_>>().join(", ")
}

fn measured(known: &FrameKnowledge, explanation: &FrameExplanation) -> Option<String> {
    let result = explanation.result.as_ref()?;
    let by = match result.measured_by? {
        MeasuredBy::Nothing => return None,
        MeasuredBy::Decoded => "by the corners of its decoded markers",
        MeasuredBy::Aligned => "by aligning the whole body with the picture",
    };
    let mut said = format!("measured {by}");
    let published = known.trials().find(|trial| matches!(trial.outcome, Outcome::Published(_)));
    if let Some(trial) = published {
        let accepted = trial.decision.hypothesis().and_then(|index| trial.hypotheses.get(index));
        said.push_str(&format!(", in the pass '{}'", pass_name(trial.pass)));
        let accepted = accepted.filter(|_| result.measured_by == Some(MeasuredBy::Aligned));
        if let Some(log_odds) = accepted.and_then(Hypothesis::log_odds) {
            said.push_str(&format!(", with log odds {log_odds:.1}"));
        }
    }
    Some(said)
}

/// A pose that was found, and was not published as the frame's measurement.
fn by_outcome(known: &FrameKnowledge) -> Option<(DecisiveStep, String)> {
    let at_end = known.decisions.iter().filter_map(|decision| match decision {
        AccountEntry::TakenImprecise(outcome) => Some(*outcome),
        _ => None,
    });
    let outcomes = known.trials().map(|trial| trial.outcome).chain(at_end);
    let said = |outcome: Outcome| match outcome {
        Outcome::Late(_) => Some((
            DecisiveStep::TooLate,
            "a pose was found when the frame had ended: it corrected the track and was not published",
        )),
        Outcome::Corrected(_) => Some((
            DecisiveStep::Imprecise,
            "the pose that was found is too imprecise to be published: it corrected the track",
        )),
        Outcome::Ambiguous(_) => {
            Some((DecisiveStep::Rivals, "two poses are possible, so none is published as measured"))
        }
        Outcome::OutsideGate(_) => Some((
            DecisiveStep::OutsideGate,
            "a pose was found and left out: it is not where the track can be",
        )),
        Outcome::Refused(_) => Some((
            DecisiveStep::OutsideGate,
            "a pose was found and left out: the track cannot use it",
        )),
        _ => None,
    };
    let (step, why) = outcomes.filter_map(said).last()?;
    Some((step, why.to_owned()))
}

/// Checks whether a view of the place was searched.
fn of_views(explanation: &FrameExplanation, place: &TargetPlace) -> Option<(DecisiveStep, String)> {
    let where_it_is = match place.is_predicted {
        true => "where its track predicts it",
        false => "where it really is (no track predicts it)",
    };
    let next = match explanation.next_search_in {
        Some(1) => "; the next frame looks there".to_owned(),
        Some(frames) => format!("; the next view of the place comes {frames} frames later"),
        None => {
            "; no later frame of the recording that was looked through has a view of it".to_owned()
        }
    };
    let there = || explanation.views.iter().filter(|view| view.shows_place == Some(true));
    if let Some(answered) = there().find(|view| view.is_answered && view.has_failed) {
        let why = format!("{} could not be searched", name_of(answered));
        return Some((DecisiveStep::SearchFailed, why));
    }
    // A region that is not searched for markers is used by alignment.
    if there().any(|view| view.is_answered) {
        return None;
    }
    if let Some(view) = there().find(|view| view.is_cut) {
        let why = format!("{} was cut {where_it_is}, and detection never answered", name_of(view));
        return Some((DecisiveStep::Unanswered, why));
    }
    let because = match explanation.frame.stopped {
        Some(StopReason::Newer) => "because a newer frame had come or was due",
        Some(StopReason::Budget) => "because the frame had all the views that it has time for",
        Some(StopReason::Hit) => "because another view held a marker",
        Some(StopReason::Overdue) => "because no worker answered in time",
        Some(StopReason::Failed) => "because views could not be cut",
        _ => "because rectification had ended the frame",
    };
    // Plans list all tiles; each frame has time for some of them.
    let mut regions = there().filter(|view| view.kind == Some(ViewKind::Roi));
    if let Some(region) = regions.next() {
        let name = name_of(region);
        let why = format!("{name} was planned {where_it_is} and abandoned, {because}{next}");
        return Some((DecisiveStep::Abandoned, why));
    }
    if there().next().is_some() {
        let names: Vec<String> = there().map(name_of).collect();
        let why = format!(
            "not searched yet: {} {where_it_is} had no turn in this frame, {because}{next}",
            names.join(" and ")
        );
        return Some((DecisiveStep::NotItsTurn, why));
    }
    let why = format!("no view of this frame shows the place {where_it_is}{next}");
    Some((DecisiveStep::OutsideViews, why))
}

fn no_place(known: &FrameKnowledge, explanation: &FrameExplanation) -> String {
    let answered = explanation.views.iter().filter(|view| view.is_answered);
    let places = match known.trials().filter(|trial| trial.pass == Pass::Place).count() {
        0 => String::new(),
        count => {
            format!("; it was looked for in any attitude at {count} places, and found at none")
        }
    };
    format!(
        "no track predicts it, and none of its markers was decoded in the {} views of this frame{places}",
        answered.count()
    )
}

/// The detections in the views that show the place, as text.
fn searched(explanation: &FrameExplanation) -> String {
    let there = explanation.views.iter().filter(|view| view.shows_place == Some(true));
    let (searched, unsearched): (Vec<_>, Vec<_>) =
        there.filter(|view| view.is_answered).partition(|view| view.is_searched);
    let names = |views: &[&ViewFacts]| {
        views.iter().map(|view| name_of(view)).collect::<Vec<_>>().join(", ")
    };
    match (searched.is_empty(), unsearched.is_empty()) {
        (true, false) => format!(
            "{} was not searched for markers in this frame, and alignment gave no pose{}",
            names(&unsearched),
            untold(explanation)
        ),
        _ => format!("no outline of its markers was found in {}", names(&searched)),
    }
}

/// The name of a view for people.
pub(super) fn name_of(view: &ViewFacts) -> String {
    let tile = view.tile.map_or_else(String::new, |tile| format!(" {tile}"));
    match view.kind {
        Some(ViewKind::Partition) => format!("tile{tile}"),
        Some(ViewKind::HighResolution) => format!("high-resolution tile{tile}"),
        Some(ViewKind::Roi) => {
            format!("the region of {}", view.region_of.as_deref().unwrap_or("a target"))
        }
        Some(ViewKind::Proposal) => format!("proposal (view {})", view.view_index),
        None => format!("view {}", view.view_index),
    }
}

/// The best hypothesis, and the reason why it was not accepted.
fn by_hypotheses(
    known: &FrameKnowledge,
    place: Option<&TargetPlace>,
) -> Option<(DecisiveStep, String)> {
    // Most proposals show no body, so hypotheses far from the expected place are skipped.
    let mut all: Vec<(&Hypothesis, Verdict)> = Vec::new();
    for trial in known.trials() {
        let is_place = trial.pass == Pass::Place;
        all.extend(trial.decided().filter(|(it, _)| !is_place || is_at(it, place)));
    }
    let likeliest = |counts: &dyn Fn(Verdict) -> bool| {
        all.iter()
            .filter(|(_, verdict)| counts(*verdict))
            .filter_map(|(hypothesis, verdict)| Some((hypothesis.log_odds()?, hypothesis, verdict)))
            .max_by(|(one, ..), (other, ..)| one.total_cmp(other))
            .map(|(_, hypothesis, verdict)| (*hypothesis, decided(hypothesis, *verdict)))
    };
    let is_rivalled = |verdict| matches!(verdict, Verdict::Rivals(_));
    if let Some((_, rivalled)) = likeliest(&is_rivalled) {
        return Some((DecisiveStep::Rivals, format!("the likeliest pose: {rivalled}")));
    }
    if let Some((_, imprecise)) = likeliest(&|verdict| verdict == Verdict::Imprecise) {
        return Some((DecisiveStep::Imprecise, format!("the likeliest pose: {imprecise}")));
    }
    let (hypothesis, below) = likeliest(&|_| true)?;
    let hidden = match hypothesis.found.as_ref().map(|found| found.visible_share) {
        Ok(share) if share < 0.7 => {
            format!("; something is in front of {:.0} % of it", 100.0 * (1.0 - share))
        }
        _ => String::new(),
    };
    Some((DecisiveStep::BelowThreshold, format!("the likeliest pose: {below}{hidden}")))
}

/// Whether a hypothesis is near the expected place of the body.
fn is_at(hypothesis: &Hypothesis, place: Option<&TargetPlace>) -> bool {
    let (Ok(found), Some(place)) = (&hypothesis.found, place) else { return false };
    let [found, place] = [&found.camera_from_markers, &place.camera_from_markers];
    found.translation.vector.angle(&place.translation.vector) < ELSEWHERE_RAD
}

/// The reason why corners alone did not give a pose.
fn by_corners(known: &FrameKnowledge) -> Option<(DecisiveStep, String)> {
    let poses = known.trials().flat_map(|trial| &trial.corner_poses);
    let chosen = poses.filter(|pose| pose.is_chosen).last()?;
    let agreeing = chosen.solution.inlier_markers.len();
    let why = match chosen.verdict {
        CornerVerdict::Enough => return None,
        CornerVerdict::TooFewMarkers { wanted } => format!(
            "{agreeing} markers agree on a pose and {wanted} are needed, because the picture confirmed none"
        ),
        CornerVerdict::OneMarker => {
            "one marker agrees, its track is too uncertain for that, and the picture confirmed none"
                .to_owned()
        }
        CornerVerdict::Ambiguous { lead } => format!(
            "another pose explains its corners almost as well (log odds {lead:.1}), and the picture confirmed neither"
        ),
        CornerVerdict::TooUncertain { position_m, rotation_rad } => format!(
            "the corners of its markers leave the pose too uncertain ({:.0} mm, {:.1} degrees), and the picture confirmed none",
            position_m * 1e3,
            rotation_rad.to_degrees()
        ),
    };
    Some((DecisiveStep::TooFewCorners, why))
}
