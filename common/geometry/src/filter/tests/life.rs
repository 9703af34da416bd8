//! The life of a track: when it is believed, coasts and is lost, in whatever order frames come.

use super::*;

/// A pose that the picture alone does not prove.
fn found(pose: Isometry3<f64>) -> FrameMeasurement {
    FrameMeasurement { pose: super::found(pose), rival: None, is_proven: false, jump: None }
}

fn frame(k: i32) -> f64 {
    10.0 + f64::from(k) * 0.1
}

#[test]
fn a_neighbour_is_believed_coasts_and_is_lost() {
    let pose = Isometry3::translation(1.0, 0.0, 0.0);
    let mut life = life();
    assert_eq!((life.state(), life.unseen(frame(0), &still())), (None, None));
    assert_eq!(life.measured(frame(0), &found(pose), &still()).unwrap(), Happened::Started);
    assert_eq!(life.state(), Some(TrackState::Tentative));
    assert_eq!(life.unseen(frame(1), &still()), Some(TrackState::Tentative));
    life.measured(frame(2), &found(pose), &still()).unwrap();
    assert_eq!(life.state(), Some(TrackState::Tentative));
    let third = life.measured(frame(3), &found(pose), &still()).unwrap();
    assert!(matches!(third, Happened::Updated));
    assert_eq!(life.state(), Some(TrackState::Confirmed));
    for k in 4..13 {
        assert_eq!(life.unseen(frame(k), &still()), Some(TrackState::Coasting));
        assert!(life.predict(frame(k), &still()).is_some());
    }
    life.measured(frame(13), &found(pose), &still()).unwrap();
    assert_eq!(life.state(), Some(TrackState::Confirmed));
    assert_eq!(life.unseen(frame(24), &still()), Some(TrackState::Lost));
    assert_eq!(life.unseen(frame(25), &still()), Some(TrackState::Lost));
    assert!(life.track().is_none() && life.predict(frame(25), &still()).is_none());
    assert_eq!((life.started_s(), life.last_seen_s()), (Some(frame(0)), Some(frame(13))));
    assert_eq!(life.measured(frame(26), &found(pose), &still()).unwrap(), Happened::Started);
    assert_eq!((life.state(), life.started_s()), (Some(TrackState::Tentative), Some(frame(26))));
    life.forget();
    assert_eq!(life.state(), None);
}

#[test]
fn a_stale_track_begins_anew_from_a_proven_pose() {
    let (pose, other) =
        (Isometry3::translation(1.0, 0.0, 0.0), Isometry3::translation(-9.0, 0.0, 0.0));
    let proven = FrameMeasurement { is_proven: true, ..found(other) };
    for unseen in 0..6 {
        let mut life = life();
        (0..5).for_each(|k| {
            let _ = life.measured(frame(k), &found(pose), &still()).unwrap();
        });
        (5..5 + unseen).for_each(|k| {
            let _ = life.unseen(frame(k), &still());
        });
        let is_stale = unseen >= STALE_AFTER_FRAMES as i32;
        assert_eq!(life.is_stale(), is_stale, "{unseen}");
        let mut gated = life.clone();
        let now = frame(5 + unseen);
        assert!(!gated.accepts(now, &found(other), &still()));
        assert_eq!(gated.measured(now, &found(other), &still()).unwrap(), Happened::Gated);
        let expected = if is_stale { Happened::Restarted } else { Happened::Gated };
        assert_eq!(life.accepts(now, &proven, &still()), is_stale, "{unseen}");
        assert_eq!(life.measured(now, &proven, &still()).unwrap(), expected, "{unseen}");
        // What contradicted the track once does not protect it.
        if is_stale {
            let next = gated.measured(frame(6 + unseen), &proven, &still()).unwrap();
            assert_eq!(next, Happened::Restarted);
        }
    }
}

#[test]
fn a_single_sighting_is_soon_forgotten() {
    let mut life = life();
    life.measured(frame(0), &found(Isometry3::translation(1.0, 0.0, 0.0)), &still()).unwrap();
    let states: Vec<_> = (1..6).map(|k| life.unseen(frame(k), &still()).unwrap()).collect();
    assert_eq!(states[..4], [TrackState::Tentative; 4]);
    assert_eq!(states[4], TrackState::Lost);
}

#[test]
fn a_wrong_track_begins_anew_from_what_contradicts_it() {
    let (pose, other) =
        (Isometry3::translation(1.0, 0.0, 0.0), Isometry3::translation(-9.0, 0.0, 0.0));
    let mut life = life();
    for k in 0..5 {
        life.measured(frame(k), &found(pose), &still()).unwrap();
    }
    for k in 5..7 {
        assert!(life.accepts(frame(k), &found(pose), &still()));
        assert!(!life.accepts(frame(k), &found(other), &still()));
        let happened = life.measured(frame(k), &found(other), &still()).unwrap();
        assert!(matches!(happened, Happened::Gated));
        assert_eq!(life.state(), Some(TrackState::Coasting));
    }
    assert!(life.accepts(frame(7), &found(other), &still()), "the track is ambiguous now");
    assert_eq!(life.measured(frame(7), &found(other), &still()).unwrap(), Happened::Restarted);
    assert_eq!(life.state(), Some(TrackState::Confirmed), "it was measured three times");
    let track = life.track().unwrap();
    assert!((track.camera_from_markers.translation.vector.x - -9.0).abs() < 1e-6);
}

#[test]
fn a_tentative_track_begins_anew_from_what_contradicts_it() {
    let (pose, other) =
        (Isometry3::translation(1.0, 0.0, 0.0), Isometry3::translation(-9.0, 0.0, 0.0));
    let mut life = life();
    assert_eq!(life.measured(frame(0), &found(pose), &still()).unwrap(), Happened::Started);
    assert_eq!(life.measured(frame(1), &found(other), &still()).unwrap(), Happened::Restarted);
    assert_eq!(life.state(), Some(TrackState::Tentative));
    assert_eq!(life.track().unwrap().camera_from_markers, other);
}

#[test]
fn a_life_survives_jumps_of_the_clock() {
    let pose = Isometry3::translation(1.0, 0.0, 0.0);
    let mut life = life();
    for k in 0..5 {
        life.measured(frame(k), &found(pose), &still()).unwrap();
    }
    let before = life.clone();
    let late = life.measured(frame(-2), &found(pose), &still());
    assert!(matches!(late, Err(FilterError::Past { .. })));
    assert_eq!(life.unseen(frame(-2), &still()), Some(TrackState::Confirmed));
    assert!(life.measured(f64::NAN, &found(pose), &still()).is_err());
    assert_eq!(life.unseen(f64::NAN, &still()), Some(TrackState::Confirmed));
    assert_eq!(life, before);
    // A second and more back, the source has begun anew; so it has after a long silence.
    assert_eq!(life.measured(1.0, &found(pose), &still()).unwrap(), Happened::Restarted);
    assert_eq!(life.measured(1e6, &found(pose), &still()).unwrap(), Happened::Started);
    assert_eq!(life.unseen(5.0, &still()), Some(TrackState::Lost));
}

/// What a frame says, and how much later than exposed it comes, seconds.
#[derive(Debug, Clone)]
struct Report {
    measured: Option<Isometry3<f64>>,
    late_s: f64,
}

/// Frames of a neighbour that flies by: measured, not seen, or measured quite elsewhere.
fn reports(latest_s: f64) -> impl Strategy<Value = Vec<Report>> {
    let report = (0..10, any::<u64>(), 0.0..latest_s);
    prop::collection::vec(report, 2..60).prop_map(|reports| {
        let all = reports.into_iter().zip(0..).map(|((kind, seed, late_s), k)| {
            let truth = Isometry3::translation(1.0 + 0.02 * f64::from(k), 0.0, 0.0);
            let pose = measure(&truth, &mut Chance::new(seed));
            let measured = match kind {
                0..7 => Some(pose),
                7 => Some(Isometry3::translation(-1.0, 0.0, 0.0) * pose),
                _ => None,
            };
            Report { measured, late_s }
        });
        all.collect()
    })
}

fn tell(life: &mut LifeCycle, k: usize, report: &Report) {
    let stamp_s = 10.0 + k as f64 / 30.0;
    match &report.measured {
        Some(pose) => assert!(life.measured(stamp_s, &found(*pose), &still()).is_ok()),
        None => assert_eq!(life.unseen(stamp_s, &still()), life.state()),
    }
}

proptest! {
    /// However late and in whatever order frames come, as long as none is later than the history.
    #[test]
    fn the_order_of_arrival_does_not_matter_within_the_history(reports in reports(0.49)) {
        let mut in_order = life();
        let mut arrivals: Vec<_> = reports.iter().enumerate().collect();
        arrivals.iter().for_each(|(k, report)| tell(&mut in_order, *k, report));
        arrivals.sort_by(|(j, a), (k, b)| {
            (*j as f64 / 30.0 + a.late_s).total_cmp(&(*k as f64 / 30.0 + b.late_s))
        });
        let mut as_it_came = life();
        arrivals.iter().for_each(|(k, report)| tell(&mut as_it_came, *k, report));
        prop_assert_eq!(as_it_came.state(), in_order.state());
        prop_assert_eq!(as_it_came.track(), in_order.track());
        prop_assert_eq!(as_it_came.started_s(), in_order.started_s());
    }
}

proptest! {
    /// Wherever a track changes hands, it is as if one process had kept it, late frames included.
    #[test]
    fn a_saved_track_goes_on_as_it_was(reports in reports(0.49), handed_over in 0usize..60) {
        let mut kept = life();
        let mut handed = life();
        for (k, report) in reports.iter().enumerate() {
            if k == handed_over {
                let mut successor = life();
                successor.resume(handed.saved(), &still()).unwrap();
                handed = successor;
            }
            tell(&mut kept, k, report);
            tell(&mut handed, k, report);
        }
        prop_assert_eq!(kept, handed);
    }
}

#[test]
fn a_late_measurement_takes_its_place() {
    let pose = |k: i32| Isometry3::translation(1.0 + 0.05 * f64::from(k), 0.0, 0.0);
    let (mut in_time, mut late) = (life(), life());
    for k in 0..8 {
        in_time.measured(frame(k), &found(pose(k)), &still()).unwrap();
        if k == 5 {
            // Nothing is known of it yet, and that is said.
            late.unseen(frame(k), &still());
        } else {
            late.measured(frame(k), &found(pose(k)), &still()).unwrap();
        }
    }
    let without = late.track().unwrap().clone();
    assert!(matches!(
        late.measured(frame(5), &found(pose(5)), &still()).unwrap(),
        Happened::Updated
    ));
    assert_eq!(late.track(), in_time.track());
    assert_eq!((late.state(), late.last_seen_s()), (in_time.state(), Some(frame(7))));
    assert!(in_time.track().unwrap().covariance[(6, 6)] < without.covariance[(6, 6)]);
    // What was seen stays seen.
    assert_eq!(late.unseen(frame(5), &still()), Some(TrackState::Confirmed));
    assert_eq!(late, in_time);
    // A prediction for a time within the history uses what was known up to then.
    let then = late.predict(frame(5), &still()).unwrap();
    assert_eq!(then.stamp_s, frame(5));
    assert!(late.predict(frame(0), &still()).is_none());
}

/// A body that comes before another lens of the camera jumps in all pictures from there on.
#[test]
fn a_track_follows_a_jump_that_is_announced() {
    let [before, after] = [1.0, 1.15].map(|x| Isometry3::translation(x, 0.0, 0.0));
    let mut life = life();
    for k in 0..20 {
        life.measured(frame(k), &found(before), &still()).unwrap();
    }
    assert!(!life.accepts(frame(20), &found(after), &still()), "it is beyond the gate");
    let jump = Some(Matrix6::identity() * 0.1f64.powi(2));
    let announced = FrameMeasurement { jump, ..found(after) };
    assert_eq!(life.measured(frame(20), &announced, &still()).unwrap(), Happened::Updated);
    life.refilter(0.0, &still());
    let there = life.predict(frame(20), &still()).unwrap().camera_from_markers;
    assert!((there.translation.vector - after.translation.vector).norm() < 2e-2, "{there}");
}

#[test]
fn a_corrected_track_is_where_its_measurements_are_now() {
    let mut life = life();
    for k in 0..20 {
        life.measured(frame(k), &found(Isometry3::translation(1.0, 0.0, 0.0)), &still()).unwrap();
    }
    let moved = |pose: &PoseEstimate| PoseEstimate {
        camera_from_markers: Isometry3::translation(0.0, 0.5, 0.0) * pose.camera_from_markers,
        ..*pose
    };
    life.correct(moved, &still());
    let track = life.track().unwrap();
    let off = track.camera_from_markers.translation.vector - Vector3::new(1.0, 0.5, 0.0);
    assert!(off.norm() < 1e-9 && track.velocity.norm() < 1e-9, "{off} {}", track.velocity);
    assert_eq!(life.state(), Some(TrackState::Confirmed));
}
