//! Decisions about poses that are made up.

#![allow(clippy::panic, reason = "of the patterns")]

use super::*;
use crate::fixtures::{alignment, pose};
use crate::hypothesis::StartSource;
use flockeye_imaging::align::{AlignError, Evidence};
use nalgebra::{Matrix6, Translation3, UnitQuaternion, Vector3};

/// A pose with these log odds, precise or not, `along_m` from the body's place.
fn tried(along_m: f64, log_odds: f64, is_precise: bool) -> Hypothesis {
    let at = Translation3::new(along_m, 0.0, 0.0) * pose(0.9);
    let found = alignment(at, log_odds, if is_precise { 1e-3 } else { 0.03 });
    Hypothesis::of(StartSource::Prediction, Ok(found))
}

fn predicted(along_m: f64, log_odds: f64, is_precise: bool) -> Hypothesis {
    Hypothesis { turn_log: Some(0.0), ..tried(along_m, log_odds, is_precise) }
}

fn nothing() -> Hypothesis {
    Hypothesis::of(StartSource::Prediction, Err(AlignError::Nothing))
}

fn told_by_facets(hypothesis: Hypothesis) -> Hypothesis {
    let found = hypothesis.found.map(|found| {
        let evidence = Evidence { log_odds_of_others: 9.0, ..found.evidence };
        Alignment { evidence, ..found }
    });
    Hypothesis { found, ..hypothesis }
}

#[test]
fn the_direct_pass_asks_for_a_pose_that_is_certain() {
    for (hypothesis, reason) in [
        (predicted(0.0, 9.0, true), Verdict::Accepted),
        (predicted(0.0, 9.0, false), Verdict::Imprecise),
        (predicted(0.0, 5.5, true), Verdict::BelowThreshold),
        (nothing(), Verdict::NotAligned),
    ] {
        let decision = of_direct_pass(&[hypothesis]);
        assert_eq!(decision.reasons, [reason]);
        assert_eq!(decision.chosen.is_some(), reason == Verdict::Accepted);
    }
    let refused = of_direct_pass(&[predicted(0.0, 9.0, true)]).refused(Verdict::OutsideGate);
    assert_eq!((refused.chosen, refused.reasons), (None, vec![Verdict::OutsideGate]));
    let mirrored = of_direct_pass(&[predicted(0.0, 9.0, true), predicted(0.5, 6.0, true)]);
    assert_eq!((mirrored.chosen, mirrored.lead), (None, None), "markers may decide");
}

#[test]
fn of_poses_that_a_track_supports_the_likeliest_counts() {
    let all = [nothing(), predicted(0.0, 6.0, true), predicted(0.1, 7.0, false)];
    let decision = of_tracked(&all);
    assert_eq!(decision.chosen, Some(PoseIndex::Hypothesis(2)));
    let reasons = [Verdict::NotAligned, Verdict::LessLikely, Verdict::Accepted];
    assert_eq!(decision.reasons, reasons);
    // What is certain ends the search, even if something likelier was found before.
    let certain = [predicted(0.0, 9.0, false), predicted(0.0, 8.0, true)];
    assert_eq!(of_tracked(&certain).chosen, Some(PoseIndex::Hypothesis(1)));
    // The prediction makes up for a weak picture, unless it speaks against the pose.
    let weak = |turn_log| Hypothesis { turn_log: Some(turn_log), ..tried(0.0, 6.0, true) };
    assert!(of_tracked(&[weak(0.0)]).chosen.is_some());
    assert!(of_tracked(&[weak(-3.0)]).chosen.is_none());
    // Markers make up for a weak picture, unless the prediction speaks against the pose.
    let marked = |turn_log| Hypothesis {
        turn_log: Some(turn_log),
        is_marked: true,
        ..tried(0.0, 2.0, true)
    };
    assert!(of_tracked(&[marked(0.0)]).chosen.is_some());
    assert!(of_tracked(&[marked(-3.0)]).chosen.is_none());
}

#[test]
fn the_same_pose_twice_is_chosen_once() {
    let twice = [predicted(0.0, 6.0, true), predicted(0.0, 6.0, true)];
    let decision = of_tracked(&twice);
    assert_eq!(decision.chosen, Some(PoseIndex::Hypothesis(0)));
    assert_eq!(decision.reasons, [Verdict::Accepted, Verdict::LessLikely]);
    let twice = [tried(0.0, 9.0, true), tried(0.0, 9.0, true)];
    let decision = of_untracked(&twice, likeliest(&twice));
    assert_eq!(decision.chosen, Some(PoseIndex::Hypothesis(1)));
    assert_eq!(decision.reasons, [Verdict::LessLikely, Verdict::Accepted]);
}

#[test]
fn an_untracked_pose_must_lead_its_rivals() {
    let decide = |all: &[Hypothesis]| of_untracked(all, likeliest(all));
    let alone = decide(&[tried(0.0, 14.0, true), tried(0.5, 8.0, true)]);
    assert_eq!((alone.chosen, alone.rivals), (Some(PoseIndex::Hypothesis(0)), vec![1]));
    assert_eq!(alone.lead, None);
    let two = [tried(0.5, 8.0, true), tried(0.0, 9.0, true)];
    let rivalled = decide(&two);
    assert_eq!((rivalled.chosen, &rivalled.rivals[..]), (Some(PoseIndex::Hypothesis(1)), &[0][..]));
    let both = measurement(&rivalled, &two, &[], 1).expect("both are possible");
    assert!(both.is_precise && !both.is_usable_alone() && !both.is_proven);
    let rival = both.rival.expect("it is possible");
    assert_eq!(Some(&rival.pose), two[0].alignment().map(Alignment::pose).as_ref());
    assert!((rival.lead - 1.0).abs() < 1e-9);
    let [third, fourth] = [tried(-0.5, 8.0, true), tried(-0.5, 2.0, true)];
    let three = decide(&[&two[..], &[third]].concat());
    assert_eq!((three.chosen, three.lead), (None, None), "a third one is possible");
    assert!(decide(&[&two[..], &[fourth]].concat()).chosen.is_some(), "a third one is unlikely");
    let [Verdict::Rival, Verdict::Rivals(lead)] = rivalled.reasons[..] else {
        panic!("{rivalled:?}")
    };
    assert!((lead - 1.0).abs() < 1e-9, "{lead}");
    let imprecise = decide(&[tried(0.0, 9.0, false)]);
    assert_eq!((imprecise.chosen, imprecise.reasons), (None, vec![Verdict::Imprecise]));
}

#[test]
fn a_tracked_pose_must_lead_its_rivals_too() {
    let lead = |log_odds: f64, is_precise: bool| {
        let all = [predicted(0.0, 9.0, true), predicted(0.5, log_odds, is_precise)];
        of_tracked(&all).lead
    };
    assert_eq!((lead(2.0, true), lead(7.0, true), lead(7.0, false)), (None, Some(2.0), Some(2.0)));
    // What nothing supports is no rival, but for the mirror pose.
    let weak = predicted(0.5, 4.5, true);
    let decide = |other: Hypothesis| of_tracked(&[predicted(0.0, 9.0, true), other]).lead;
    assert_eq!(decide(weak.clone()), None);
    assert_eq!(decide(Hypothesis { source: StartSource::Mirror, ..weak }), Some(4.5));
    // An imprecise pose is no measurement, and corrects the track.
    let vague = [predicted(0.0, 6.0, false), predicted(0.5, 5.0, true)];
    let decision = of_tracked(&vague);
    assert_eq!((decision.chosen, decision.lead), (Some(PoseIndex::Hypothesis(0)), None));
}

#[test]
fn a_vague_prediction_says_little_against_a_mirror_pose() {
    let turned = |rad: f64| pose(0.9) * UnitQuaternion::from_scaled_axis(Vector3::x() * rad);
    let with_deviation = |rad: f64| PoseEstimate {
        camera_from_markers: pose(0.9),
        covariance: Matrix6::identity() * rad.powi(2),
    };
    let excludes = |deviation_rad: f64| {
        excludes_mirror(&with_deviation(deviation_rad), &turned(0.0), &turned(1.0))
    };
    assert!(excludes(0.0) && excludes(0.15) && !excludes(0.3) && !excludes(1.0));
    let told =
        |rad: f64, deviation_rad: f64| turn_log(&turned(rad), &with_deviation(deviation_rad));
    assert!((told(0.0, 0.0) - 3.0 * 2f64.ln()).abs() < 1e-6);
    for deviation_rad in [0.0, 0.1, 0.3, 1.0] {
        assert!(told(0.0, deviation_rad) > told(0.5, deviation_rad));
        assert!(told(0.0, deviation_rad) <= told(0.0, 0.0));
    }
    assert!(told(1.5, 3.0).abs() < 0.2, "nothing is known of the attitude");
}

#[test]
fn a_pose_that_several_facets_confirm_ends_the_comparison_in_flight() {
    let one = tried(0.0, 9.0, true);
    assert!(!ends_competition(&one, TimeBudget::OneFrame));
    let several = told_by_facets(one);
    assert!(ends_competition(&several, TimeBudget::OneFrame));
    assert!(!ends_competition(&several, TimeBudget::Unlimited));
}

#[test]
fn a_precise_pose_comes_first_then_one_of_the_picture() {
    let corners = |verdict| CornerPose {
        solution: PoseSolution {
            camera_from_markers: pose(0.9),
            covariance: nalgebra::Matrix6::identity(),
            cost: 1.0,
            reduced_chi_square: 1.0,
            inlier_markers: vec![3],
            inlier_corners: 4,
        },
        is_chosen: true,
        verdict,
    };
    let enough = [corners(CornerVerdict::Enough)];
    let uncertain = [corners(CornerVerdict::TooUncertain { position_m: 0.1, rotation_rad: 0.1 })];
    let too_few = [corners(CornerVerdict::TooFewMarkers { wanted: 2 })];
    let precise = [predicted(0.0, 9.0, true)];
    let imprecise = [predicted(0.0, 9.0, false)];
    let (by_picture, by_corners) = (Some(PoseIndex::Hypothesis(0)), Some(PoseIndex::Corners(0)));
    let two = [predicted(0.0, 9.0, true), predicted(0.5, 7.0, true)];
    for (tried, corner_poses, chosen) in [
        (&two[..], &enough, by_corners),
        (&precise[..], &enough, by_picture),
        (&imprecise[..], &enough, by_corners),
        (&imprecise[..], &uncertain, by_picture),
        (&imprecise[..], &too_few, by_picture),
        (&[][..], &uncertain, by_corners),
        (&[][..], &too_few, None),
    ] {
        let decision = with_corners(of_tracked(tried), tried, corner_poses);
        assert_eq!(decision.chosen, chosen, "{tried:?}, {corner_poses:?}");
        let measurement = measurement(&decision, tried, corner_poses, 1);
        let is_precise = chosen == by_corners && corner_poses == &enough
            || chosen == by_picture && tried == &precise[..];
        assert_eq!(measurement.map(|found| found.is_precise), chosen.map(|_| is_precise));
    }
}

#[test]
fn corners_with_a_likely_mirror_pose_are_no_measurement() {
    let solution = PoseSolution {
        camera_from_markers: pose(0.9),
        covariance: Matrix6::identity() * 1e-6,
        cost: 1.0,
        reduced_chi_square: 1.0,
        inlier_markers: vec![3],
        inlier_corners: 4,
    };
    let prior = |deviation: f64| PoseEstimate {
        camera_from_markers: solution.camera_from_markers,
        covariance: Matrix6::identity() * deviation.powi(2),
    };
    let decided = |lead: f64| of_corners(&solution, Some(&prior(0.01)), 1, lead);
    assert_eq!(decided(f64::INFINITY), CornerVerdict::Enough);
    let beside_vague_track = of_corners(&solution, Some(&prior(0.1)), 1, f64::INFINITY);
    assert_eq!(beside_vague_track, CornerVerdict::OneMarker);
    let two = PoseSolution { inlier_markers: vec![3, 4], ..solution.clone() };
    assert_eq!(of_corners(&two, Some(&prior(0.1)), 1, f64::INFINITY), CornerVerdict::Enough);
    assert_eq!(decided(1.0), CornerVerdict::Ambiguous { lead: 1.0 });
    let corners = [CornerPose { verdict: decided(1.0), is_chosen: true, solution }];
    assert_eq!(with_corners(Decision::default(), &[], &corners).chosen, None);
}

#[test]
fn several_facets_elsewhere_count_beside_a_track() {
    let elsewhere = Hypothesis { turn_log: Some(-18.0), ..tried(0.5, 9.0, true) };
    assert_eq!(of_tracked(std::slice::from_ref(&elsewhere)).chosen, None, "one facet may mislead");
    let several = told_by_facets(elsewhere);
    assert_eq!(of_tracked(&[several]).chosen, Some(PoseIndex::Hypothesis(0)));
}
