//! Targets that come out elsewhere after something hid them.

use super::*;
use nalgebra::{UnitQuaternion, Vector3};

/// Alpha upside down, half a turn round the camera from `pose(0.9)`.
fn elsewhere() -> Isometry3<f64> {
    let opposite = UnitQuaternion::from_scaled_axis(Vector3::z() * std::f64::consts::PI);
    let over = UnitQuaternion::from_scaled_axis(Vector3::x() * std::f64::consts::PI);
    opposite * pose(0.9) * over
}

/// What the tracker says of alpha in each of these frames, in which it is at `at` or not seen.
fn follow(
    tracker: &mut Tracking,
    frames: std::ops::Range<u64>,
    at: Option<&Isometry3<f64>>,
) -> Vec<TargetEstimate> {
    let estimate = |sequence| {
        let seen = at.map(|at| see(tracker, sequence, at)).unwrap_or_default();
        seen.into_iter().chain(end(tracker, sequence)).map(|(_, estimate)| estimate)
    };
    frames.flat_map(estimate).collect()
}

fn is_at(estimate: &TargetEstimate, at: &Isometry3<f64>) -> bool {
    let found = &estimate.pose.camera_from_markers;
    error_m(found, at) < 0.02 && found.rotation.angle_to(&at.rotation) < 0.05
}

/// Behind a pillar for five seconds, then upside down on the other side, twice.
#[test]
fn a_target_that_was_hidden_for_long_begins_anew_where_it_comes_out() {
    let (here, there) = (pose(0.9), elsewhere());
    let mut tracker = following(&here);
    for (round, at) in [&there, &here].into_iter().enumerate() {
        let first = 3 + 160 * round as u64;
        let hidden = follow(&mut tracker, first..first + 150, None);
        assert!(hidden.iter().all(|estimate| estimate.measured.is_none()));
        let lost = hidden.iter().filter(|estimate| estimate.state == Some(TrackState::Lost));
        assert_eq!(lost.count(), 1, "its track ends");
        let seen = follow(&mut tracker, first + 150..first + 160, Some(at));
        assert_eq!(seen.len(), 10);
        assert!(seen.iter().all(|estimate| is_at(estimate, at) && estimate.measured.is_some()));
        assert!(seen.iter().all(|estimate| estimate.track_id == 2 + round as u32));
        assert_eq!(seen[9].state, Some(TrackState::Confirmed));
    }
}

/// Behind a pillar for a third of a second only: the track may be right, and what contradicts it
/// may be wrong.
#[test]
fn a_target_that_comes_out_elsewhere_soon_is_ambiguous_before_its_track_is_replaced() {
    let (here, there) = (pose(0.9), elsewhere());
    let mut tracker = following(&here);
    follow(&mut tracker, 3..13, None);
    let seen = follow(&mut tracker, 13..20, Some(&there));
    let at = |estimate: &TargetEstimate| match estimate.measured {
        Some(_) => 'm',
        None if estimate.rival.is_some() => 'a',
        None => 'c',
    };
    assert_eq!(seen.iter().map(at).collect::<String>(), "cammmmm");
    assert!(seen.iter().all(|estimate| is_at(estimate, &here) || is_at(estimate, &there)));
    assert!(is_at(&seen[2], &there) && seen[2].track_id == 2);
}
