//! Each step that can decide, on frames that are made up.

#![allow(clippy::unwrap_used)]

mod decided;

use flockeye_config::{Pipeline, Resolved};
use flockeye_contract::{
    BodyTruth, DetectedMarker, DetectionHeader, FrameEnd, MeasuredBy, NONE, PlanHeader,
    PlannedView, Search, StopReason, Track, TrackHeader, TrackState, TruthHeader, ViewHeader,
    ViewKind,
};
use flockeye_convert::{pose, xyzw};
use flockeye_geometry::filter;
use flockeye_geometry::pose::PoseEstimate;
use flockeye_geometry::view::View;
use flockeye_imaging::align::{AlignError, Alignment};
use flockeye_recording::ContractMessage;
use nalgebra::{Isometry3, Matrix6, Vector3};

use super::explanation::{DecisiveStep, FrameExplanation};
use super::gathered::StageMessages;
use super::known::{FrameKnowledge, ReplayOutcome, TrackBefore};
use super::{facts, text};
use crate::fixtures::{self, facing_markers, measurement, stamp};
use crate::recorded::FlightMessage;
use flockeye_fusion::Record;
use flockeye_fusion::TimeBudget;
use flockeye_fusion::TrackPrior;
use flockeye_fusion::{
    AccountEntry, CornerPose, CornerVerdict, Decision, Hypothesis, NotRun, Outcome, Pass,
    PoseIndex, StartSource, Trial, Verdict,
};

/// The frame that is asked about.
const FRAME: u64 = 7;

/// The pose of alpha, `camera_from_markers`: ahead.
fn there() -> Isometry3<f64> {
    Isometry3::translation(1.5, 0.2, 0.1)
}

fn resolved() -> Resolved {
    Resolved::of(Pipeline::default()).unwrap()
}

/// A frame in which the target was predicted and nothing was looked at; `by` adds to it.
fn known(by: impl FnOnce(&mut FrameKnowledge)) -> FrameKnowledge {
    let mut known = FrameKnowledge {
        target: 0,
        stamp: stamp(FRAME),
        at_s: 0.2,
        gathered: StageMessages::of(stamp(FRAME), 0),
        before: Some(TrackBefore {
            state: Some(filter::TrackState::Confirmed),
            predicted: Some((there(), Matrix6::identity() * 1e-6)),
        }),
        decisions: Vec::new(),
        replay: ReplayOutcome::Same,
        lost: Vec::new(),
    };
    by(&mut known);
    known
}

fn explained(known: &FrameKnowledge) -> FrameExplanation {
    facts::explanation("flight.mcap".as_ref(), &resolved(), known)
}

/// The step that decided, and what is said of it.
fn judged(by: impl FnOnce(&mut FrameKnowledge)) -> (DecisiveStep, String) {
    let explanation = explained(&known(by));
    let said = text::of(&explanation);
    assert!(said.starts_with("alpha in frame 7 at 0.200 s: "), "{said}");
    (explanation.step, explanation.why)
}

fn towards(direction: &Vector3<f64>) -> View {
    View::looking_at(&nalgebra::Unit::new_normalize(*direction), 0.6, 200)
}

fn ahead() -> View {
    towards(&there().translation.vector)
}

fn behind() -> View {
    towards(&-there().translation.vector)
}

fn view(index: u32, kind: ViewKind, view: &View) -> ViewHeader {
    let is_region = kind == ViewKind::Roi;
    ViewHeader {
        stamp: stamp(FRAME),
        plan_id: 3,
        view_index: index,
        kind: kind.code(),
        tile: if is_region { NONE } else { 4 },
        target: if is_region { 0 } else { NONE },
        camera_from_view: xyzw(&view.camera_from_view),
        focal_px: view.focal_px,
        size_px: view.size_px,
        stride: view.size_px,
        search: Search::AllWindows.code(),
        ..ViewHeader::default()
    }
}

fn cut(known: &mut FrameKnowledge, header: ViewHeader) {
    known.gathered.on(&FlightMessage::Header(header));
}

fn planned(known: &mut FrameKnowledge, views: &[(ViewKind, View)]) {
    let planned = |(kind, at): &(ViewKind, View)| {
        let header = view(0, *kind, at);
        PlannedView {
            camera_from_view: header.camera_from_view,
            reference_ns: stamp(FRAME).exposure_ns,
            focal_px: header.focal_px,
            size_px: header.size_px,
            kind: header.kind,
            tile: header.tile,
            target: header.target,
            ..PlannedView::default()
        }
    };
    let header = PlanHeader { plan_id: 3, ..PlanHeader::default() };
    let views = views.iter().map(planned).collect();
    known.gathered.on(&FlightMessage::Plan(header, views, ContractMessage::default()));
}

fn searched(known: &mut FrameKnowledge, index: u32, markers: Vec<DetectedMarker>, failed: u32) {
    let header = DetectionHeader {
        stamp: stamp(FRAME),
        plan_id: 3,
        view_index: index,
        failed,
        ..DetectionHeader::default()
    };
    known.gathered.on(&FlightMessage::Searched(Record { header, markers }));
}

fn ended(known: &mut FrameKnowledge, reason: StopReason) {
    let end =
        FrameEnd { stamp: stamp(FRAME), plan_id: 3, reason: reason.code(), ..FrameEnd::default() };
    known.gathered.on(&FlightMessage::FrameEnd(end));
    said(known, &[], true);
}

fn said(known: &mut FrameKnowledge, tracks: &[Track], is_last: bool) {
    let header =
        TrackHeader { stamp: stamp(FRAME), is_last: u32::from(is_last), ..TrackHeader::default() };
    known.gathered.on(&FlightMessage::Tracks(header, tracks.to_vec(), ContractMessage::default()));
}

fn track(measured_by: MeasuredBy) -> Track {
    Track {
        observer_from_target: pose(&there()),
        measured_observer_from_target: pose(&there()),
        name: "alpha".into(),
        state: TrackState::Confirmed.code(),
        measured_by: measured_by.code(),
        ..bytemuck::Zeroable::zeroed()
    }
}

fn markers() -> Vec<DetectedMarker> {
    let body = resolved().bodies.get(0).unwrap().clone();
    facing_markers(&body, &there(), 2)
}

fn alignment(log_odds: f64) -> Alignment {
    fixtures::alignment(there(), log_odds, 1e-3)
}

/// The decision that gives hypotheses these verdicts.
fn decision(verdicts: &[Verdict]) -> Decision {
    let accepted = verdicts.iter().position(|verdict| *verdict == Verdict::Accepted);
    let chosen = accepted.map(PoseIndex::Hypothesis);
    Decision { chosen, reasons: verdicts.to_vec(), ..Decision::default() }
}

/// A pass over the region that found poses of these verdicts, and led to something.
fn trial(outcome: Outcome, verdicts: &[(f64, Verdict)]) -> AccountEntry {
    let hypothesis = |(log_odds, _): &(f64, Verdict)| Hypothesis {
        turn_log: Some(1.0),
        ..Hypothesis::of(StartSource::Prediction, Ok(alignment(*log_odds)))
    };
    let covariance = Matrix6::identity() * 1e-4;
    let predicted = PoseEstimate { camera_from_markers: there(), covariance };
    let prior = TrackPrior::Tentative { predicted, rival: None };
    AccountEntry::Ran(Trial {
        hypotheses: verdicts.iter().map(hypothesis).collect(),
        decision: decision(&verdicts.iter().map(|(_, verdict)| *verdict).collect::<Vec<_>>()),
        view_index: Some(0),
        outcome,
        ..Trial::of(Pass::Region, &prior, TimeBudget::OneFrame)
    })
}

/// The target's region was cut and searched in vain.
fn looked_at(known: &mut FrameKnowledge, entry: AccountEntry) {
    cut(known, view(0, ViewKind::Roi, &ahead()));
    searched(known, 0, Vec::new(), 0);
    known.decisions.push(entry);
    ended(known, StopReason::Budget);
}

#[test]
fn what_was_not_looked_at_is_told_by_its_first_step() {
    let (step, why) = judged(|known| {
        planned(known, &[(ViewKind::Partition, behind())]);
        cut(known, view(0, ViewKind::Partition, &behind()));
        searched(known, 0, Vec::new(), 0);
        ended(known, StopReason::Newer);
    });
    assert_eq!(step, DecisiveStep::OutsideViews, "{why}");
    assert!(why.contains("no view of this frame shows the place where its track predicts it"));

    let (step, why) = judged(|known| {
        planned(known, &[(ViewKind::Roi, ahead())]);
        ended(known, StopReason::Newer);
    });
    assert_eq!(step, DecisiveStep::Abandoned, "{why}");
    assert!(why.contains("the region of alpha was planned"), "{why}");
    assert!(why.contains("because a newer frame had come or was due"), "{why}");

    let (step, why) = judged(|known| {
        planned(known, &[(ViewKind::Partition, ahead())]);
        ended(known, StopReason::Budget);
        // Three frames later it is.
        let later = ViewHeader { stamp: stamp(FRAME + 3), ..view(0, ViewKind::Roi, &ahead()) };
        known.gathered.on(&FlightMessage::Header(later));
    });
    assert_eq!(step, DecisiveStep::NotItsTurn, "{why}");
    assert!(why.contains("not searched yet: tile 4"), "{why}");
    assert!(why.contains("the next view of the place comes 3 frames later"), "{why}");

    let region = || view(0, ViewKind::Roi, &ahead());
    let (step, why) = judged(|known| {
        cut(known, region());
        ended(known, StopReason::Complete);
    });
    assert_eq!(step, DecisiveStep::Unanswered, "{why}");
    let (step, why) = judged(|known| {
        cut(known, region());
        searched(known, 0, Vec::new(), 1);
        ended(known, StopReason::Complete);
    });
    assert_eq!(step, DecisiveStep::SearchFailed, "{why}");
    let (step, why) = judged(|known| cut(known, region()));
    assert_eq!(step, DecisiveStep::NotEnded, "{why}");
}

#[test]
fn what_was_looked_at_in_vain_is_told_by_what_was_found() {
    let not_run = || AccountEntry::NotRun(Pass::Direct, NotRun::NotConfirmed);
    let (step, why) = judged(|known| looked_at(known, not_run()));
    assert_eq!(step, DecisiveStep::NothingFound, "{why}");
    assert!(why.contains("no outline of its markers was found in the region of alpha"), "{why}");

    let found = |markers: Vec<DetectedMarker>| {
        judged(|known| {
            cut(known, view(0, ViewKind::Roi, &ahead()));
            searched(known, 0, markers, 0);
            ended(known, StopReason::Complete);
        })
    };
    let (step, why) = found(markers());
    assert_eq!(step, DecisiveStep::Untold, "{why}");
    // Markers elsewhere are others'.
    let mut elsewhere = markers();
    for marker in &mut elsewhere {
        marker.rays_in_camera = marker.rays_in_camera.map(|[x, y, z]| [-x, y, z]);
    }
    let (step, why) = found(elsewhere);
    assert_eq!(step, DecisiveStep::NothingFound, "{why}");
}

#[test]
fn who_was_never_seen_and_is_nowhere_known_is_said_to_be_so() {
    let (step, why) = judged(|known| {
        known.before = Some(TrackBefore { state: None, predicted: None });
        cut(known, view(0, ViewKind::Partition, &ahead()));
        searched(known, 0, Vec::new(), 0);
        ended(known, StopReason::Complete);
    });
    assert_eq!(step, DecisiveStep::NoPlaceKnown, "{why}");
    assert!(why.contains("in the 1 views of this frame"), "{why}");
    // The source knows.
    let (step, why) = judged(|known| {
        known.before = Some(TrackBefore { state: None, predicted: None });
        let body = BodyTruth { camera_from_markers: pose(&there()), ..BodyTruth::default() };
        let truth = TruthHeader { stamp: stamp(FRAME), ..TruthHeader::default() };
        known.gathered.on(&FlightMessage::Truth(truth, vec![body]));
        cut(known, view(0, ViewKind::Partition, &behind()));
        searched(known, 0, Vec::new(), 0);
        ended(known, StopReason::Complete);
    });
    assert_eq!(step, DecisiveStep::OutsideViews, "{why}");
    assert!(why.contains("where it really is (no track predicts it)"), "{why}");
}

#[test]
fn poses_that_were_refused_are_told_with_what_was_asked_for() {
    let refused = |verdicts: &[(f64, Verdict)]| {
        judged(|known| looked_at(known, trial(Outcome::Nothing, verdicts)))
    };
    let (step, why) = refused(&[(-2.0, Verdict::BelowThreshold), (1.5, Verdict::BelowThreshold)]);
    assert_eq!(step, DecisiveStep::BelowThreshold, "{why}");
    assert!(why.contains("log odds 2.5 with the prediction, and 5.4 are asked for"), "{why}");
    // The direct pass asks for more than the prediction.
    let (step, why) = refused(&[(5.5, Verdict::BelowThreshold)]);
    assert_eq!(step, DecisiveStep::BelowThreshold, "{why}");
    assert!(why.contains("the picture alone has log odds 5.5, and 7.3 are asked for"), "{why}");
    let (step, why) = refused(&[(9.0, Verdict::Rivals(2.0)), (7.0, Verdict::Rival)]);
    assert_eq!(step, DecisiveStep::Rivals, "{why}");
    assert!(why.contains("leads its rivals by 2.0 only, and 4.8 are asked for"), "{why}");
    let (step, why) = refused(&[(9.0, Verdict::Imprecise)]);
    assert_eq!(step, DecisiveStep::Imprecise, "{why}");
    let (step, why) = judged(|known| {
        let mut decision = trial(Outcome::Nothing, &[]);
        if let AccountEntry::Ran(trial) = &mut decision {
            trial.hypotheses =
                vec![Hypothesis::of(StartSource::Prediction, Err(AlignError::NotInView))];
            trial.decision = self::decision(&[Verdict::NotAligned]);
        }
        looked_at(known, decision);
    });
    assert_eq!(step, DecisiveStep::NothingFound, "{why}");
}

#[test]
fn poses_that_were_found_and_not_published_are_told() {
    let found = measurement(&there());
    for (outcome, wanted) in [
        (Outcome::Late(found), DecisiveStep::TooLate),
        (Outcome::Corrected(found), DecisiveStep::Imprecise),
        (Outcome::OutsideGate(found), DecisiveStep::OutsideGate),
        (Outcome::Refused(found), DecisiveStep::OutsideGate),
    ] {
        let decision = trial(outcome, &[(9.0, Verdict::Accepted)]);
        let (step, why) = judged(|known| looked_at(known, decision));
        assert_eq!(step, wanted, "{why}");
    }
    let at_end = AccountEntry::TakenImprecise(Outcome::Corrected(found));
    let (step, why) = judged(|known| looked_at(known, at_end));
    assert_eq!(step, DecisiveStep::Imprecise, "{why}");
}

#[test]
fn corners_that_are_not_enough_are_told() {
    for verdict in [
        CornerVerdict::TooFewMarkers { wanted: 2 },
        CornerVerdict::OneMarker,
        CornerVerdict::TooUncertain { position_m: 0.1, rotation_rad: 0.2 },
    ] {
        let solution = flockeye_geometry::pose::PoseSolution {
            camera_from_markers: there(),
            covariance: Matrix6::identity(),
            cost: 1.0,
            reduced_chi_square: 1.0,
            inlier_markers: vec![3],
            inlier_corners: 4,
        };
        let (step, why) = judged(|known| {
            let mut decision = trial(Outcome::Nothing, &[]);
            if let AccountEntry::Ran(trial) = &mut decision {
                trial.corner_poses = vec![CornerPose { solution, is_chosen: true, verdict }];
            }
            cut(known, view(0, ViewKind::Roi, &ahead()));
            searched(known, 0, markers(), 0);
            known.decisions.push(decision);
            ended(known, StopReason::Complete);
        });
        assert_eq!(step, DecisiveStep::TooFewCorners, "{why}");
    }
}

#[test]
fn a_measured_pose_is_told_with_its_pass_and_its_error() {
    let known = known(|known| {
        let published = Outcome::Published(measurement(&there()));
        looked_at(known, trial(published, &[(9.0, Verdict::Accepted)]));
        said(known, &[track(MeasuredBy::Aligned)], false);
        let near = Isometry3::translation(0.003, 0.0, 0.0) * there();
        let body = BodyTruth {
            camera_from_markers: pose(&near),
            observer_from_target: pose(&near),
            ..BodyTruth::default()
        };
        let truth = TruthHeader { stamp: stamp(FRAME), ..TruthHeader::default() };
        known.gathered.on(&FlightMessage::Truth(truth, vec![body]));
    });
    let explanation = explained(&known);
    assert_eq!(explanation.step, DecisiveStep::Measured, "{}", explanation.why);
    assert!(explanation.why.contains("in the pass 'corners of the region', with log odds 10.0"));
    let error = explanation.truth.unwrap().error.unwrap();
    assert!((error.position_m - 0.003).abs() < 1e-9 && error.rotation_deg < 1e-6);
}

#[test]
fn another_body_in_front_is_named_and_losses_are_told() {
    let mut resolved = resolved();
    let bodies = vec![crate::fixtures::alpha(), crate::fixtures::bravo()];
    resolved.bodies = flockeye_geometry::body::Bodies::new("DICT_5X5_250".into(), bodies).unwrap();
    let known = known(|known| {
        looked_at(known, trial(Outcome::Nothing, &[(-3.0, Verdict::BelowThreshold)]));
        let nearer = Isometry3::translation(0.75, 0.1, 0.05);
        let bravo = Track {
            observer_from_target: pose(&nearer),
            name: "bravo".into(),
            target: 1,
            ..track(MeasuredBy::Nothing)
        };
        said(known, &[bravo], false);
        known.replay = ReplayOutcome::Different("header.is_last: 0 and 1".into());
        known.lost = vec![("flockeye/view".into(), 5)];
    });
    let explanation = facts::explanation("flight.mcap".as_ref(), &resolved, &known);
    assert_eq!(explanation.hidden_by.as_deref(), Some("bravo"));
    assert!(explanation.why.contains("bravo is in front of it"), "{}", explanation.why);
    let said = text::of(&explanation);
    assert!(said.contains("so this may not be what happened: header.is_last: 0 and 1"), "{said}");
    assert!(said.contains("lacks up to 5 messages of flockeye/view"), "{said}");
    assert!(!explanation.reliance.is_exact);
}
