//! Bodies in drawn pictures are found, and only where they are.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "of the drawings")]

use super::*;
use crate::decide::{PoseIndex, Verdict};
use crate::drawn_body::{Drawing, draw};
use crate::fixtures::{PIXELS_PER_RADIAN, aligner, alignment, alpha, bravo, facing};
use flockeye_geometry::body::{Body, plate};
use flockeye_geometry::pose::least_lead;
use flockeye_imaging::align::{least_log_odds_anywhere, least_log_odds_predicted};
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::{Matrix6, Translation3, UnitQuaternion, Vector3, Vector6};

fn pose(range_m: f64, turn: f64) -> Isometry3<f64> {
    Isometry3::from_parts(
        Translation3::from(Vector3::new(0.8, 0.5, 0.33).normalize() * range_m),
        UnitQuaternion::from_euler_angles(0.3, -0.2, turn),
    )
}

/// Gives `by` an aligner for one body, and a picture of the body.
fn with_picture<T>(truth: &Isometry3<f64>, by: impl FnOnce(&Aligner, &Picture<'_>) -> T) -> T {
    with_picture_of(&alpha(), truth, by)
}

/// The same for any body.
fn with_picture_of<T>(
    body: &Body,
    truth: &Isometry3<f64>,
    by: impl FnOnce(&Aligner, &Picture<'_>) -> T,
) -> T {
    let aligner = aligner(&Bodies::new("DICT_5X5_250".into(), vec![body.clone()]).unwrap());
    let drawing: Drawing = draw(body, truth, PIXELS_PER_RADIAN, 0.9, 0.004);
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
    let (image, view) = (drawing.image(), drawing.view);
    let picture = Picture::still(image, view, &light, PIXELS_PER_RADIAN);
    by(&aligner, &picture)
}

/// Looks for the body of an aligner for one.
fn initiate(
    aligner: &Aligner,
    picture: &Picture<'_>,
    starts: &[Start],
    budget: TimeBudget,
) -> Option<Alignment> {
    let starts = with_sources(starts);
    let sought = Sought { target: 0, picture, starts: &starts, budget };
    let mut tried = Vec::new();
    let decision = aligner.initiate(&sought, |_| false, &mut tried);
    decision.chosen_of(&tried).filter(|_| decision.lead.is_none()).cloned()
}

fn confirm(
    aligner: &Aligner,
    picture: &Picture<'_>,
    starts: &[Start],
    predicted: &Isometry3<f64>,
    budget: TimeBudget,
    is_marked: impl Fn(&Isometry3<f64>) -> bool,
) -> Option<Alignment> {
    let starts = with_sources(starts);
    let sought = Sought { target: 0, picture, starts: &starts, budget };
    let mut tried = Vec::new();
    let decision = aligner.confirm(&sought, &known_at(predicted), is_marked, &mut tried);
    decision.chosen_of(&tried).cloned()
}

/// A track's prediction, certain to 5 cm and 6 degrees.
fn known_at(pose: &Isometry3<f64>) -> PoseEstimate {
    let covariance = Matrix6::from_diagonal(&Vector6::new(2.5, 2.5, 2.5, 10.0, 10.0, 10.0)) * 1e-3;
    PoseEstimate { camera_from_markers: *pose, covariance }
}

fn with_sources(starts: &[Start]) -> Vec<(StartSource, Start)> {
    starts.iter().map(|start| (StartSource::Prediction, start.clone())).collect()
}

#[test]
fn of_several_starts_the_right_one_initiates_a_track() {
    for range_m in [0.8, 1.6, 2.4] {
        let truth = pose(range_m, 0.9);
        let starts = [pose(range_m, 2.0), pose(range_m, -0.6), truth].map(Start::Fine);
        let found = with_picture(&truth, |aligner, picture| {
            initiate(aligner, picture, &starts, TimeBudget::Unlimited)
        });
        let found = found.expect("one of them is right").camera_from_markers;
        assert!(found.rotation.angle_to(&truth.rotation) < 0.02, "{range_m} m");
        let error = found.translation.vector - truth.translation.vector;
        assert!(error.norm() < 0.01, "{range_m} m: {} m", error.norm());
    }
}

#[test]
fn wrong_attitudes_neither_initiate_nor_confirm_a_track() {
    for range_m in [0.8, 1.6, 2.4, 3.2] {
        let truth = pose(range_m, 0.9);
        with_picture(&truth, |aligner, picture| {
            for turn in [1.6, 2.3, 3.1, 3.9, 4.7, 5.4] {
                let predicted = pose(range_m, 0.9 + turn);
                let starts = [Start::Fine(predicted)];
                let found = [
                    initiate(aligner, picture, &starts, TimeBudget::Unlimited),
                    confirm(aligner, picture, &starts, &predicted, TimeBudget::Unlimited, |_| {
                        false
                    }),
                ];
                for found in found.into_iter().flatten() {
                    // It may find its way to the truth, and nowhere else.
                    let rotation = found.camera_from_markers.rotation;
                    assert!(rotation.angle_to(&truth.rotation) < 0.05, "{range_m} m, {turn} rad");
                }
            }
        });
    }
}

/// Near by, perspective tells one marker alone from its mirror pose. Far away it does not, even
/// though alignment starts from the right pose.
#[test]
fn a_single_facet_initiates_a_track_where_perspective_excludes_its_mirror_pose() {
    let body = plate("plate", 0.07, 0.05, 3);
    for (range_m, is_found) in [(0.3, true), (0.4, true), (1.8, false)] {
        let truth = facing(&body, range_m);
        with_picture_of(&body, &truth, |aligner, picture| {
            let turned_rad = |begun: Isometry3<f64>| {
                let starts = [Start::Fine(begun)];
                initiate(aligner, picture, &starts, TimeBudget::Unlimited)
                    .map(|found| found.camera_from_markers.rotation.angle_to(&truth.rotation))
            };
            let turned = turned_rad(truth);
            assert_eq!(turned.is_some(), is_found, "{range_m} m");
            assert!(turned.is_none_or(|turned| turned < 0.02), "{range_m} m: {turned:?}");
            // Begun from its mirror pose it may find its way to the truth, and nowhere else.
            let mirrored = aligner.prints[0].mirrored(0, &truth).unwrap();
            assert!(mirrored.rotation.angle_to(&truth.rotation) > 0.5);
            let turned = turned_rad(mirrored);
            assert!(turned.is_none_or(|turned| turned < 0.02), "{range_m} m: {turned:?}");
        });
    }
}

/// A marker that lies flat is seen from above. Its mirror pose stands on edge.
#[test]
fn a_single_facet_far_away_initiates_a_track_where_its_mirror_pose_is_tilted_too_far() {
    // Another one below, which is not seen.
    let top = plate("plate", 0.07, 0.05, 3);
    let mut below = top.markers[0].clone();
    below.id = 4;
    below.corners.reverse();
    below.corners.iter_mut().for_each(|corner| corner.z = -0.02);
    let body = Body::new("tablet", vec![top.markers[0].clone(), below]);
    let bodies = Bodies::new("DICT_5X5_250".into(), vec![body.clone()]).unwrap();
    let towards = Vector3::new(0.6, 0.3, -0.7).normalize();
    let turn = UnitQuaternion::from_euler_angles(0.1, -0.05, 0.7);
    let truth = Isometry3::from_parts(Translation3::from(towards * 1.8), turn);
    with_picture_of(&body, &truth, |aligner, picture| {
        let mirrored = aligner.prints[0].mirrored(0, &truth).unwrap();
        let found = |aligner: &Aligner, starts: &[Isometry3<f64>]| {
            let starts: Vec<Start> = starts.iter().copied().map(Start::Fine).collect();
            initiate(aligner, picture, &starts, TimeBudget::Unlimited)
                .map(|found| found.camera_from_markers.rotation.angle_to(&truth.rotation))
        };
        let limited = |camera: &Isometry3<f64>, max_deg: f64| {
            aligner.clone().with_max_tilt(&bodies, camera, max_deg.to_radians())
        };
        let level = limited(&Isometry3::identity(), 45.0);
        for starts in [[truth, mirrored], [mirrored, truth]] {
            assert_eq!(found(aligner, &starts), None, "no tilt limit is known");
            assert_eq!(found(&limited(&Isometry3::identity(), 0.0), &starts), None);
            assert!(found(&level, &starts).is_some_and(|turned| turned < 0.05));
        }
        // A single marker may be stuck on a wall.
        let single = Bodies::new("DICT_5X5_250".into(), vec![top.clone()]).unwrap();
        let single = aligner.clone().with_max_tilt(&single, &Isometry3::identity(), 0.8);
        assert_eq!(found(&single, &[truth, mirrored]), None);
        // A camera that hangs on its side sees what is level tilted: where it is mounted counts.
        let on_its_side = Isometry3::rotation(Vector3::x() * 1.6);
        let turned = found(&limited(&on_its_side, 45.0), &[truth, mirrored]);
        assert!(turned.is_none_or(|turned| turned > 0.5), "{turned:?}");
    });
}

#[test]
fn a_track_is_confirmed_farther_away_than_it_is_initiated() {
    let truth = pose(4.6, 0.9);
    let starts = [Start::Fine(truth)];
    with_picture(&truth, |aligner, picture| {
        assert!(initiate(aligner, picture, &starts, TimeBudget::Unlimited).is_none());
        let found = confirm(aligner, picture, &starts, &truth, TimeBudget::Unlimited, |_| false);
        let found = found.expect("it is where it was expected");
        let error = found.camera_from_markers.translation.vector - truth.translation.vector;
        assert!(error.norm() < 0.05, "{} m", error.norm());
        // A few facets may be others' mirror poses: then it must not have turned far.
        assert!(!found.evidence.is_unambiguous(), "{:?}", found.evidence);
        assert!(
            confirm(aligner, picture, &starts, &pose(4.6, 1.5), TimeBudget::Unlimited, |_| false)
                .is_none()
        );
    });
}

/// The marker of a plate lies at the same place in its mirror pose, so it supports both.
#[test]
fn a_decoded_marker_does_not_support_a_pose_that_the_track_excludes() {
    let body = plate("plate", 0.07, 0.05, 3);
    let truth = facing(&body, 0.9);
    with_picture_of(&body, &truth, |aligner, picture| {
        let mirrored = aligner.prints[0].mirrored(0, &truth).unwrap();
        let follow = |start: Isometry3<f64>| {
            let starts = [Start::Fine(start)];
            confirm(aligner, picture, &starts, &truth, TimeBudget::Unlimited, |_| true)
        };
        assert!(follow(truth).is_some());
        let found = aligner.align(0, picture, &Start::Fine(mirrored)).unwrap();
        let turned = found.camera_from_markers.rotation.angle_to(&truth.rotation);
        assert!(turned > 0.5 && found.is_accepted_with_markers(0.0), "{turned}, {found:?}");
        assert!(follow(mirrored).is_none());
    });
}

#[test]
fn an_untracked_target_that_the_first_start_misses_is_found_with_any_budget() {
    let truth = pose(0.8, 0.9);
    let wrong = Start::Fine(pose(0.8, 4.0));
    with_picture(&truth, |aligner, picture| {
        for budget in [TimeBudget::Unlimited, TimeBudget::OneFrame, TimeBudget::Overspent] {
            let find = |starts: &[Start]| initiate(aligner, picture, starts, budget);
            assert!(find(std::slice::from_ref(&wrong)).is_none(), "{budget:?}");
            let found =
                find(&[wrong.clone(), Start::Fine(truth)]).expect("the second one is right");
            let error = found.camera_from_markers.translation.vector - truth.translation.vector;
            assert!(error.norm() < 0.01, "{budget:?}: {} m", error.norm());
        }
    });
}

#[test]
fn with_a_spent_budget_only_the_first_start_counts() {
    let truth = pose(0.8, 0.9);
    let starts = [Start::Fine(pose(0.8, 4.0)), Start::Fine(truth)];
    with_picture(&truth, |aligner, picture| {
        let follow = |budget| confirm(aligner, picture, &starts, &truth, budget, |_| false);
        assert!(follow(TimeBudget::Unlimited).is_some() && follow(TimeBudget::OneFrame).is_some());
        assert!(follow(TimeBudget::Overspent).is_none());
    });
}

/// The tilt prior favours a mirror pose that stands upright. Several facets outweigh it.
#[test]
fn a_body_on_its_side_is_found_as_it_lies() {
    let bodies = Bodies::new("DICT_5X5_250".into(), vec![alpha()]).unwrap();
    let lying = UnitQuaternion::from_scaled_axis(Vector3::y() * 1.5);
    let on_the_ground = Vector3::new(0.8, 0.5, -0.7).normalize() * 1.2;
    let truth = Isometry3::from_parts(on_the_ground.into(), lying);
    with_picture(&truth, |aligner, picture| {
        let level = aligner.clone().with_max_tilt(&bodies, &Isometry3::identity(), 0.8);
        let mirrors = (0..).map_while(|facet| level.prints[0].mirrored(facet, &truth));
        let starts: Vec<Start> = mirrors.chain([truth]).map(Start::Fine).collect();
        let found = initiate(&level, picture, &starts, TimeBudget::Unlimited);
        let found = found.expect("several facets show it").camera_from_markers;
        assert!(found.rotation.angle_to(&truth.rotation) < 0.03);
    });
}

/// A mirror on the wall turns left and right of a marker. No rotation does that.
#[test]
fn a_body_in_a_mirror_is_nowhere() {
    let body = alpha();
    let (aligner, truth) =
        (aligner(&Bodies::new("DICT_5X5_250".into(), vec![body.clone()]).unwrap()), pose(0.9, 0.9));
    let mut drawing: Drawing = draw(&body, &truth, PIXELS_PER_RADIAN, 0.9, 0.004);
    let width = drawing.view.size_px as usize;
    drawing.pixels.chunks_exact_mut(width).for_each(<[u8]>::reverse);
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
    let picture = Picture::still(drawing.image(), drawing.view, &light, PIXELS_PER_RADIAN);
    let mut tried = 0;
    for (axis, step) in (0..3).flat_map(|axis| (0..24).map(move |step| (axis, step))) {
        let turn = Vector3::ith(axis, f64::from(step) * 0.262);
        let rotation = UnitQuaternion::from_scaled_axis(turn) * truth.rotation;
        let start = Isometry3::from_parts(truth.translation, rotation);
        for start in [Start::Fine(start), Start::Rough(start)] {
            let starts = with_sources(&[start]);
            let budget = TimeBudget::Unlimited;
            let sought = Sought { target: 0, picture: &picture, starts: &starts, budget };
            let decision = aligner.initiate(&sought, |_| false, &mut Vec::new());
            assert_eq!(decision.chosen, None, "axis {axis}, step {step}");
            tried += 1;
        }
    }
    assert_eq!(tried, 144);
    // Without the mirror it is found.
    with_picture(&truth, |aligner, picture| {
        let starts = [Start::Rough(truth)];
        assert!(initiate(aligner, picture, &starts, TimeBudget::Unlimited).is_some());
    });
}

/// What was decided of each hypothesis, and the hypotheses.
fn decided(
    picture: &Picture<'_>,
    starts: &[Start],
    by: impl Fn(&Sought<'_>, &mut Vec<Hypothesis>) -> Decision,
) -> (Vec<Verdict>, Vec<Hypothesis>) {
    let starts = with_sources(starts);
    let sought = Sought { target: 0, picture, starts: &starts, budget: TimeBudget::Unlimited };
    let mut tried = Vec::new();
    let decision = by(&sought, &mut tried);
    let is_chosen = |reason: &Verdict| matches!(reason, Verdict::Accepted | Verdict::Rivals(_));
    let accepted = decision.reasons.iter().position(is_chosen);
    assert_eq!(decision.chosen, accepted.map(PoseIndex::Hypothesis));
    assert_eq!(decision.reasons.len(), tried.len());
    (decision.reasons, tried)
}

#[test]
fn each_hypothesis_has_its_reason() {
    let truth = pose(0.8, 0.9);
    with_picture(&truth, |aligner, picture| {
        let confirm = |sought: &Sought<'_>, tried: &mut Vec<Hypothesis>| {
            aligner.confirm(sought, &known_at(&truth), |_| false, tried)
        };
        let behind = Start::Fine(Isometry3::translation(-1.0, 0.0, 0.0));
        let starts = [behind, Start::Fine(pose(0.8, 4.0)), Start::Fine(truth)];
        let (verdicts, list) = decided(picture, &starts, confirm);
        assert_eq!(verdicts, [Verdict::NotAligned, Verdict::BelowThreshold, Verdict::Accepted]);
        assert!(list[2].turn_log.is_some_and(|turn| turn > 2.0), "it has hardly turned");
        let (anywhere, predicted) = (least_log_odds_anywhere(), least_log_odds_predicted());
        let log_odds = |k: usize| list[k].log_odds().unwrap();
        assert!(log_odds(2) > anywhere && log_odds(1) < predicted);
        // What comes after a pose that is accepted by itself is not tried.
        let (verdicts, _) = decided(picture, &[Start::Fine(truth), Start::Fine(truth)], confirm);
        assert_eq!(verdicts, [Verdict::Accepted]);
        let initiate = |sought: &Sought<'_>, tried: &mut Vec<Hypothesis>| {
            aligner.initiate(sought, |_| false, tried)
        };
        let starts = [Start::Fine(pose(0.8, 4.0)), Start::Fine(truth), Start::Rough(truth)];
        let (verdicts, list) = decided(picture, &starts, initiate);
        // Both lead to the body, and the last one is its mirror pose.
        assert_eq!(list.last().unwrap().source, StartSource::Mirror);
        assert_eq!(verdicts[0], Verdict::BelowThreshold);
        assert!(verdicts[1..3].contains(&Verdict::Accepted), "{verdicts:?}");
        assert!(verdicts[1..3].contains(&Verdict::LessLikely), "{verdicts:?}");
        assert_eq!(list[0].turn_log, None);
    });
}

#[test]
fn rivals_are_named_with_their_lead() {
    let body = plate("plate", 0.07, 0.05, 3);
    let truth = facing(&body, 1.8);
    with_picture_of(&body, &truth, |aligner, picture| {
        let (verdicts, list) = decided(picture, &[Start::Fine(truth)], |sought, tried| {
            aligner.initiate(sought, |_| false, tried)
        });
        let [Verdict::Rivals(lead), Verdict::Rival] = verdicts[..] else { panic!("{verdicts:?}") };
        assert!((0.0..least_lead()).contains(&lead.abs()), "{lead}");
        assert_eq!(list[1].source, StartSource::Mirror);
    });
}

#[test]
fn the_mirror_pose_of_one_facet_is_tried_unless_the_track_excludes_it() {
    let body = plate("plate", 0.07, 0.05, 3);
    let truth = facing(&body, 1.8);
    let decide = |deviation_rad: f64| {
        let mut predicted = known_at(&truth);
        predicted.covariance.fixed_view_mut::<3, 3>(3, 3).fill_diagonal(deviation_rad.powi(2));
        with_picture_of(&body, &truth, |aligner, picture| {
            decided(picture, &[Start::Fine(truth)], |sought, tried| {
                aligner.confirm(sought, &predicted, |_| false, tried)
            })
        })
    };
    let (verdicts, _) = decide(0.02);
    assert_eq!(verdicts, [Verdict::Accepted]);
    let (verdicts, list) = decide(1.0);
    assert!(matches!(verdicts[..], [Verdict::Rivals(_), Verdict::Rival]), "{verdicts:?}");
    assert_eq!(list[1].source, StartSource::Mirror);
    assert!(list[1].turn_log.is_some());
}

#[test]
fn a_body_is_found_at_a_rough_place_and_another_is_not() {
    let truth = pose(2.6, 0.9);
    let position = truth.translation.vector;
    let off = Vector3::new(-0.5, 0.8, 0.0).normalize() * 0.04;
    let place = Place { direction_in_camera: (position + off).normalize(), range_m: 2.3 };
    let mut list = Vec::new();
    let decision =
        with_picture(&truth, |aligner, picture| aligner.find_at(0, picture, &place, &mut list));
    let found = decision.chosen_of(&list).expect("it is there").camera_from_markers;
    assert!(found.rotation.angle_to(&truth.rotation) < 0.05);
    assert!((found.translation.vector - position).norm() < 0.02);
    let accepted = decision.hypothesis().map(|index| list[index].source);
    assert_eq!(accepted, Some(StartSource::Place));

    let aligner = aligner(&Bodies::new("DICT_5X5_250".into(), vec![bravo()]).unwrap());
    with_picture(&truth, |_, picture| {
        let decision = aligner.find_at(0, picture, &place, &mut Vec::new());
        assert_eq!(decision.chosen, None);
    });
}

/// What alignment has led to `along_x_m` from where the body is, with these log odds and this
/// deviation.
fn led_to(truth: &Isometry3<f64>, along_x_m: f64, log_odds: f64, sigma_m: f64) -> Alignment {
    alignment(Translation3::new(along_x_m, 0.0, 0.0) * truth, log_odds, sigma_m)
}

#[test]
fn the_likeliest_pose_counts_and_not_the_most_precise_one() {
    let truth = pose(2.5, 0.4);
    let (precise, likely) = (led_to(&truth, -0.1, 4.0, 0.01), led_to(&truth, 0.0, 6.0, 0.03));
    assert!(precise.is_precise && !likely.is_precise);
    let chosen = |starts: &[&Alignment]| {
        let starts: Vec<Start> =
            starts.iter().map(|&found| Start::Tried(Ok(Box::new(found.clone())))).collect();
        let found = with_picture(&truth, |aligner, picture| {
            confirm(aligner, picture, &starts, &truth, TimeBudget::OneFrame, |_| false)
        });
        found.map(|found| found.evidence.log_odds)
    };
    assert_eq!(chosen(&[&precise]), Some(4.0));
    assert_eq!(chosen(&[&precise, &likely]), Some(6.0));
    assert_eq!(chosen(&[&likely, &precise]), Some(6.0));
}
