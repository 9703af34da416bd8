//! Two poses that a neighbour may have: both are kept until evidence decides.

use super::*;
use crate::pose::{is_false, least_lead};

fn frame(k: i32) -> f64 {
    10.0 + f64::from(k) / 30.0
}

/// A flat marker's pose, and its mirror pose, of a neighbour that flies by.
fn two_poses(k: i32) -> [Isometry3<f64>; 2] {
    let at = Translation3::new(1.0 + 0.01 * f64::from(k), 0.2, 0.0);
    [0.4, -0.4].map(|tilt_rad| {
        Isometry3::from_parts(at, UnitQuaternion::from_euler_angles(0.0, tilt_rad, 0.1))
    })
}

/// One pose alone, which the picture does not prove.
fn one(pose: Isometry3<f64>) -> FrameMeasurement {
    FrameMeasurement { pose: found(pose), rival: None, is_proven: false, jump: None }
}

/// Two poses, the first one likelier by `lead`.
fn two([pose, rival]: [Isometry3<f64>; 2], lead: f64) -> FrameMeasurement {
    FrameMeasurement { rival: Some(RivalPose { pose: found(rival), lead }), ..one(pose) }
}

/// The better pose's number, and its lead, if the other one is still possible.
fn ambiguity(life: &LifeCycle, k: i32) -> Option<(usize, f64)> {
    let best = life.predict(frame(k), &still()).unwrap().camera_from_markers;
    let rival = life.predict_rival(frame(k), &still())?;
    let poses = two_poses(k);
    let number = |pose: &Isometry3<f64>| poses.iter().position(|one| !is_false(pose, one)).unwrap();
    let (first, second) = (number(&best), number(&rival.pose.camera_from_markers));
    assert_eq!(first + second, 1);
    Some((first, rival.lead))
}

/// A track of `frames` frames, in each of which the first pose leads by 1.
fn ambiguous(frames: i32) -> LifeCycle {
    let mut life = life();
    for k in 0..frames {
        life.measured(frame(k), &two(two_poses(k), 1.0), &still()).unwrap();
    }
    life
}

#[test]
fn frames_that_do_not_decide_keep_both_poses() {
    let life = ambiguous(60);
    assert_eq!(life.state(), Some(TrackState::Confirmed));
    assert_eq!(ambiguity(&life, 60), Some((0, 1.0)), "their errors are shared: they do not add up");
}

#[test]
fn the_clearest_picture_counts() {
    let mut life = ambiguous(5);
    let [pose, mirror] = two_poses(5);
    life.measured(frame(5), &two([mirror, pose], 3.0), &still()).unwrap();
    let (best, lead) = ambiguity(&life, 6).unwrap();
    assert_eq!((best, lead), (1, 3.0), "the frames before said less");
    for k in 6..30 {
        life.measured(frame(k), &two(two_poses(k), 1.0), &still()).unwrap();
        assert_eq!(ambiguity(&life, k + 1), Some((1, 3.0)), "weak frames do not add up");
    }
    life.measured(frame(30), &two(two_poses(30), 4.0), &still()).unwrap();
    assert_eq!(ambiguity(&life, 31), Some((0, 4.0)));
}

/// A marker comes into sight far from where the track predicts it.
#[test]
fn two_poses_that_contradict_a_track_stay_two_when_they_replace_it() {
    let mut life = life();
    let before = Isometry3::translation(-5.0, 0.0, 0.0);
    (0..10).for_each(|k| {
        let _ = life.measured(frame(k), &one(before), &still()).unwrap();
    });
    for k in 10..20 {
        life.measured(frame(k), &two(two_poses(k), 1.0), &still()).unwrap();
        assert_eq!(life.accepts(frame(k), &one(two_poses(k)[1]), &still()), k > 10);
    }
    assert_eq!(ambiguity(&life, 20), Some((0, 1.0)));
}

/// Late or imprecise measurements may support a rival as well as the best branch.
#[test]
fn a_measurement_of_either_pose_is_accepted() {
    let life = ambiguous(5);
    for pose in two_poses(5) {
        assert!(life.accepts(frame(5), &one(pose), &still()));
    }
    let elsewhere = one(Isometry3::translation(-5.0, 0.0, 0.0));
    assert!(!life.accepts(frame(5), &elsewhere, &still()));
}

#[test]
fn one_pose_alone_decides_for_the_hypothesis_that_it_fits() {
    for right in [0, 1] {
        let mut life = ambiguous(5);
        let happened = life.measured(frame(5), &one(two_poses(5)[right]), &still()).unwrap();
        let expected = [Happened::Updated, Happened::Restarted][right];
        assert_eq!((happened, ambiguity(&life, 6)), (expected, None), "{right}");
        let best = life.predict(frame(5), &still()).unwrap().camera_from_markers;
        assert!(!is_false(&best, &two_poses(5)[right]));
        assert_eq!(life.state(), Some(TrackState::Confirmed));
    }
}

#[test]
fn a_measurement_of_neither_pose_does_not_decide_between_them() {
    let mut life = ambiguous(5);
    let elsewhere = Isometry3::translation(-5.0, 0.0, 0.0);
    assert_eq!(life.measured(frame(5), &one(elsewhere), &still()).unwrap(), Happened::Gated);
    assert_eq!(ambiguity(&life, 6), Some((0, 1.0)));
    let _ = life.measured(frame(6), &one(elsewhere), &still()).unwrap();
    let third = life.measured(frame(7), &one(elsewhere), &still()).unwrap();
    assert_eq!((third, life.predict_rival(frame(7), &still())), (Happened::Restarted, None));
}

#[test]
fn a_precise_track_decides_between_the_poses_of_a_frame() {
    let mut life = life();
    (0..10).for_each(|k| {
        let _ = life.measured(frame(k), &one(two_poses(k)[1]), &still()).unwrap();
    });
    // Even where the picture prefers the mirror pose.
    let happened = life.measured(frame(10), &two(two_poses(10), 3.0), &still()).unwrap();
    assert_eq!((happened, ambiguity(&life, 11)), (Happened::Updated, None));
    let best = life.predict(frame(10), &still()).unwrap().camera_from_markers;
    assert!(!is_false(&best, &two_poses(10)[1]));
}

#[test]
fn what_contradicts_a_track_twice_makes_it_ambiguous_and_then_replaces_it() {
    let mut life = life();
    let [pose, other] = [two_poses(0)[0], two_poses(0)[1]];
    (0..10).for_each(|k| {
        let _ = life.measured(frame(k), &one(pose), &still()).unwrap();
    });
    let mut tell = |k, pose| {
        let happened = life.measured(frame(k), &one(pose), &still()).unwrap();
        (happened, life.predict_rival(frame(k), &still()).map(|rival| rival.lead))
    };
    assert_eq!(tell(10, other), (Happened::Gated, None));
    let (happened, lead) = tell(11, other);
    assert_eq!(happened, Happened::Gated);
    assert!(lead.is_some_and(|lead| (0.0..least_lead()).contains(&lead)), "{lead:?}");
    assert_eq!(tell(12, other), (Happened::Restarted, None));
    assert_eq!(tell(13, other), (Happened::Updated, None));
    // A single contradiction, followed by a confirmation, is forgotten.
    assert_eq!(tell(14, pose), (Happened::Gated, None));
    assert_eq!(tell(15, other), (Happened::Updated, None));
    assert_eq!(tell(16, pose), (Happened::Gated, None));
}

proptest! {
    /// A late frame takes its place in an ambiguous track, too, and a successor continues it.
    #[test]
    fn an_ambiguous_track_does_not_depend_on_the_order_of_arrival(
        frames in prop::collection::vec((0..4, 0.0..3.0), 2..15),
        late in any::<prop::sample::Index>(),
    ) {
        let tell = |life: &mut LifeCycle, k: usize| {
            let [pose, mirror] = two_poses(k as i32);
            let (at_s, (kind, lead)) = (frame(k as i32), frames[k]);
            let measured = match kind {
                0 => two([pose, mirror], lead),
                1 => two([mirror, pose], lead),
                2 => one(pose),
                _ => {
                    life.unseen(at_s, &still());
                    return;
                }
            };
            life.measured(at_s, &measured, &still()).unwrap();
        };
        let late = late.index(frames.len());
        let (mut in_order, mut as_it_came) = (life(), life());
        (0..frames.len()).for_each(|k| tell(&mut in_order, k));
        (0..frames.len()).filter(|k| *k != late).for_each(|k| tell(&mut as_it_came, k));
        tell(&mut as_it_came, late);
        let mut successor = life();
        successor.resume(as_it_came.saved(), &still()).unwrap();
        prop_assert_eq!(&successor, &as_it_came);
        prop_assert_eq!(as_it_came, in_order);
    }
}
