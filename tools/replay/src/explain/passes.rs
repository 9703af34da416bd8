//! The decisions of the replayed core as data.

use flockeye_config::Resolved;
use flockeye_geometry::pose::least_lead;
use flockeye_imaging::align::{
    least_log_odds_anywhere, least_log_odds_marked, least_log_odds_predicted,
};

use super::explanation::{CornerFacts, HypothesisFacts, LogOddsTerms, PassFacts};
use super::poses::{Mounting, deviations};
use flockeye_fusion::TimeBudget;
use flockeye_fusion::{
    AccountEntry, CornerPose, CornerVerdict, Hypothesis, NotRun, Outcome, Pass, StartSource, Trial,
    Verdict,
};

/// The passes of the decisions, in order.
pub(super) fn facts(
    resolved: &Resolved,
    target: usize,
    entries: &[AccountEntry],
) -> Vec<PassFacts> {
    let frames = Mounting { resolved, target };
    entries.iter().map(|entry| of_entry(&frames, entry)).collect()
}

fn of_entry(frames: &Mounting<'_>, entry: &AccountEntry) -> PassFacts {
    let nothing = |pass: &'static str| PassFacts {
        pass,
        not_run: None,
        view_index: None,
        is_late: false,
        is_deferred: false,
        decoded: Vec::new(),
        corner_poses: Vec::new(),
        hypotheses: Vec::new(),
        outcome: None,
    };
    match entry {
        AccountEntry::NotRun(pass, reason) => {
            PassFacts { not_run: Some(reason_of(*reason)), ..nothing(pass_name(*pass)) }
        }
        AccountEntry::Contradicted => PassFacts {
            outcome: Some(
                "its markers contradict the pose of the direct pass: it is suspended for half a second",
            ),
            ..nothing("check by markers")
        },
        AccountEntry::TakenImprecise(outcome) => {
            PassFacts { outcome: Some(said(outcome)), ..nothing("end of the frame") }
        }
        AccountEntry::Ran(trial) => of_trial(frames, trial),
    }
}

fn of_trial(frames: &Mounting<'_>, trial: &Trial) -> PassFacts {
    PassFacts {
        pass: pass_name(trial.pass),
        not_run: None,
        view_index: trial.view_index,
        is_late: trial.budget == TimeBudget::Overspent,
        is_deferred: trial.is_deferred,
        decoded: trial.decoded.clone(),
        corner_poses: trial
            .corner_poses
            .iter()
            .map(|pose| corner_facts(frames, trial, pose))
            .collect(),
        hypotheses: trial
            .decided()
            .map(|(hypothesis, verdict)| hypothesis_facts(frames, hypothesis, verdict))
            .collect(),
        outcome: Some(said(&trial.outcome)),
    }
}

fn corner_facts(frames: &Mounting<'_>, trial: &Trial, pose: &CornerPose) -> CornerFacts {
    let agreeing = &pose.solution.inlier_markers;
    CornerFacts {
        pose: frames.of_markers(&pose.solution.camera_from_markers),
        cost: pose.solution.cost,
        agreeing: agreeing.clone(),
        left_out: trial.decoded.iter().filter(|id| !agreeing.contains(id)).copied().collect(),
        is_chosen: pose.is_chosen,
        verdict: match pose.verdict {
            CornerVerdict::Enough => "enough without the picture".to_owned(),
            CornerVerdict::TooFewMarkers { wanted } => {
                format!("{} markers agree, {wanted} are needed without the picture", agreeing.len())
            }
            CornerVerdict::OneMarker => {
                "one marker alone, and the track is uncertain: it may only correct it".to_owned()
            }
            CornerVerdict::Ambiguous { lead } => {
                format!("ambiguous without the picture: its log odds against others are {lead:.1}")
            }
            CornerVerdict::TooUncertain { position_m, rotation_rad } => format!(
                "too uncertain without the picture: {:.0} mm, {:.1} degrees",
                position_m * 1e3,
                rotation_rad.to_degrees()
            ),
        },
    }
}

fn hypothesis_facts(
    frames: &Mounting<'_>,
    hypothesis: &Hypothesis,
    verdict: Verdict,
) -> HypothesisFacts {
    let found = hypothesis.found.as_ref().ok();
    HypothesisFacts {
        source: source_of(hypothesis.source),
        pose: found.map(|found| frames.of_markers(&found.camera_from_markers)),
        deviations: found.map(|found| deviations(&found.covariance)),
        log_odds: hypothesis.log_odds(),
        terms: found.map(|found| LogOddsTerms {
            picture: found.evidence.log_odds,
            picture_of_other_facets: found.evidence.log_odds_of_others,
            turn: hypothesis.turn_log,
            tilt: hypothesis.tilt_log,
            is_marked: hypothesis.is_marked,
        }),
        correlation: found.map(|found| found.evidence.correlation),
        agreeing_facets: found.map(|found| found.evidence.agreeing_facets),
        visible_share: found.map(|found| found.visible_share),
        verdict: verdict_of(verdict),
        decided: decided(hypothesis, verdict),
    }
}

/// The verdict about a hypothesis, as a sentence.
pub(super) fn decided(hypothesis: &Hypothesis, verdict: Verdict) -> String {
    match verdict {
        Verdict::Accepted => match &hypothesis.found {
            Ok(found) if !found.is_precise => {
                "accepted, but too imprecise to be a measurement by itself".to_owned()
            }
            _ => "accepted".to_owned(),
        },
        Verdict::LessLikely => "it would do, and another is likelier".to_owned(),
        Verdict::BelowThreshold => below(hypothesis),
        Verdict::Imprecise => "likely, but too imprecise to be a measurement by itself".to_owned(),
        Verdict::Rivals(lead) => format!(
            "likely, but it leads its rivals by {lead:.1} only, and {:.1} are asked for",
            least_lead()
        ),
        Verdict::Rival => "a rival of the likeliest".to_owned(),
        Verdict::OutsideGate => "likely, but not where the track can be".to_owned(),
        Verdict::NotAligned => match &hypothesis.found {
            Err(error) => error.to_string(),
            Ok(_) => "nothing could be compared".to_owned(),
        },
    }
}

/// The limit that a hypothesis did not reach, as text.
fn below(hypothesis: &Hypothesis) -> String {
    let Ok(found) = &hypothesis.found else { return "nothing could be compared".to_owned() };
    let (picture, turn) = (found.evidence.log_odds, hypothesis.turn_log);
    let (anywhere, predicted) = (least_log_odds_anywhere(), least_log_odds_predicted());
    let mut said = match turn {
        // The direct pass has two limits: for the picture alone, and together with the prediction.
        Some(turn) if picture + turn >= predicted => format!(
            "refused: the picture alone has log odds {picture:.1}, and {anywhere:.1} are asked for"
        ),
        Some(turn) => format!(
            "refused: log odds {:.1} with the prediction, and {predicted:.1} are asked for",
            picture + turn
        ),
        None => {
            format!("refused: log odds {picture:.1}, and {anywhere:.1} are asked for")
        }
    };
    if hypothesis.is_marked {
        said.push_str(&format!(" ({:.1} with its markers)", least_log_odds_marked()));
    }
    said
}

/// The name of a pass.
pub(super) fn pass_name(pass: Pass) -> &'static str {
    match pass {
        Pass::Direct => "direct",
        Pass::Region => "corners of the region",
        Pass::Complete => "corners of the frame",
        Pass::Background => "background",
        Pass::Place => "search of a place",
    }
}

fn reason_of(reason: NotRun) -> &'static str {
    match reason {
        NotRun::Published => "the frame's pose had left",
        NotRun::NotConfirmed => "it has no confirmed track",
        NotRun::Suspended => "its markers contradicted a direct pose some frames ago",
        NotRun::NothingKnown => "no marker was decoded, and no track predicts it",
        NotRun::NoView => "no marker was decoded, and no view of it is held",
    }
}

fn source_of(source: StartSource) -> &'static str {
    match source {
        StartSource::Corners => "decoded markers",
        StartSource::Prediction => "prediction",
        StartSource::RoughPrediction => "prediction, coarse first",
        StartSource::DirectPass => "prediction, as the direct pass found it",
        StartSource::Mirror => "mirror pose of the likeliest",
        StartSource::Place => "all attitudes at the place",
    }
}

fn verdict_of(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Accepted => "accepted",
        Verdict::LessLikely => "less_likely",
        Verdict::BelowThreshold => "below_threshold",
        Verdict::Imprecise => "imprecise",
        Verdict::Rivals(_) => "rivals",
        Verdict::Rival => "rival",
        Verdict::OutsideGate => "outside_gate",
        Verdict::NotAligned => "not_aligned",
    }
}

fn said(outcome: &Outcome) -> &'static str {
    match outcome {
        Outcome::Nothing => "no pose",
        Outcome::InBackground => "no pose yet: the background pass goes on",
        Outcome::Imprecise(_) => {
            "an imprecise pose, which waits for something better until the frame ends"
        }
        Outcome::Published(_) => "published as the frame's measurement",
        Outcome::Corrected(_) => "too imprecise to be published: it corrected the track",
        Outcome::Ambiguous(_) => "not published: another pose is possible",
        Outcome::OutsideGate(_) => "left out: it is not where the track can be",
        Outcome::Refused(_) => "left out: the track cannot use it",
        Outcome::Late(_) => {
            "too late to be published: the frame had ended. It corrected or began the track"
        }
        Outcome::Cancelled => "not needed: another pass had measured the target",
    }
}
