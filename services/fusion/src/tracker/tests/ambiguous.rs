//! Targets that may have either of two poses.

use super::*;
use flockeye_geometry::body::plate;
use flockeye_geometry::filter::RivalPose;
use flockeye_geometry::pose::is_false;
use nalgebra::UnitQuaternion;

/// Two poses of alpha, mirrored as those of a flat marker.
fn two_poses() -> [Isometry3<f64>; 2] {
    [0.5, -0.5].map(|tilt_rad| pose(0.9) * UnitQuaternion::from_euler_angles(tilt_rad, 0.0, 0.0))
}

/// A measurement that does not exclude the second pose.
fn either([first, second]: [Isometry3<f64>; 2]) -> PoseMeasurement {
    let rival = RivalPose { pose: measurement(&second).pose, lead: 2.0 };
    PoseMeasurement { rival: Some(rival), ..measurement(&first) }
}

#[test]
fn an_ambiguous_target_has_both_poses_until_a_frame_decides() {
    let poses = two_poses();
    let mut tracker = untracked();
    for sequence in 0..5 {
        let update = tracker.take_in(time(sequence), 0, &either(poses));
        let (_, estimate) = update.expect("it begins and continues a track");
        assert_eq!(estimate.measured, None, "it may have the other pose");
        let rival = estimate.rival.expect("it is possible");
        assert!(!is_false(&rival.pose.camera_from_markers, &poses[1]));
        assert!(!is_false(&estimate.pose.camera_from_markers, &poses[0]));
        assert!(end(&mut tracker, sequence).is_empty());
    }
    assert_eq!(tracker.targets()[0].state(), Some(TrackState::Confirmed));
    let prior = tracker.prior(0, at_s(5));
    assert!(prior.confirmed().is_none(), "it supports neither pose");
    assert!(prior.rival().is_some_and(|rival| !is_false(rival, &poses[1])));
    with_view(&poses[0], |view| {
        assert!(direct(&mut tracker, 5, view).is_none(), "a direct pass has one start");
    });
    let (_, estimate) = tracker.take_in(time(5), 0, &measurement(&poses[1])).expect("it decides");
    assert!(estimate.measured.is_some() && estimate.rival.is_none());
    assert!(!is_false(&estimate.pose.camera_from_markers, &poses[1]));
}

#[test]
fn a_frame_without_the_target_keeps_both_poses() {
    let mut tracker = untracked();
    (0..5).for_each(|sequence| {
        tracker.take_in(time(sequence), 0, &either(two_poses()));
        end(&mut tracker, sequence);
    });
    let updates = end(&mut tracker, 5);
    let [(0, estimate)] = updates.as_slice() else { panic!("{updates:?}") };
    assert_eq!(estimate.state, Some(TrackState::Coasting));
    assert!(estimate.measured.is_none() && estimate.rival.is_some());
}

/// At 1.8 m perspective does not tell the marker from its mirror pose, at 0.3 m it does.
#[test]
fn one_marker_far_away_is_ambiguous_and_decided_when_it_comes_near() {
    let body = plate("plate", 0.07, 0.05, 3);
    let mut tracker = Tracking::of(tracker_of(vec![body.clone()], 1));
    let mut see = |sequence: u64, range_m: f64| {
        let truth = facing(&body, range_m);
        let markers = facing_markers(&body, &truth, 1);
        let record = Record { markers, ..empty_record(sequence) };
        let answered = [of_region(&record)];
        let budget = TimeBudget::Unlimited;
        let updates = with_view_of(&body, &truth, |view| {
            let best_views = BestViews::from([(0, *view)]);
            let (tracker, parts) = tracker.at(sequence);
            tracker.final_pass(time(sequence), parts, &answered, &best_views, budget)
        });
        let [(0, estimate)] = updates.as_slice() else { panic!("{updates:?}") };
        let is_right = |found: &PoseEstimate| !is_false(&found.camera_from_markers, &truth);
        let rival = estimate.rival.map(|rival| rival.pose);
        let right = [Some(estimate.pose), rival].into_iter().flatten().filter(is_right).count();
        (estimate.measured.map(|(found, _)| is_right(&found)), rival.is_some(), right)
    };
    for sequence in 0..4 {
        assert_eq!(see(sequence, 1.8), (None, true, 1), "one of two is right");
    }
    let decided: Vec<_> = (4..8).map(|sequence| see(sequence, 0.3)).collect();
    assert!(decided.iter().all(|(measured, ..)| *measured != Some(false)), "{decided:?}");
    assert_eq!(decided[3], (Some(true), false, 1));
}
