//! What is left to the thread for second looks, and what is not.

use super::*;

/// So far beside the truth a fine start leads nowhere, and a rough one there, metres.
const OFF_M: f64 = 0.013;

fn beside(truth: &Isometry3<f64>, off_m: f64) -> Isometry3<f64> {
    Translation3::new(-0.5 * off_m, 0.7 * off_m, 0.5 * off_m) * truth
}

/// A swarm that believes its neighbour `off_m` beside where it is, with a thread for second looks.
fn misled(truth: &Isometry3<f64>, off_m: f64) -> Swarm {
    let mut swarm = following(&beside(truth, off_m)).with_second_looks().expect("a thread");
    swarm.hurry(Pace::Live);
    swarm
}

/// Looks at a neighbour's gaze view in which no marker was found.
fn glance_at(swarm: &mut Swarm, sequence: u64, view: &BestView<'_>) -> Vec<Update> {
    glance_when(swarm, sequence, at_s(sequence), view)
}

fn glance_when(swarm: &mut Swarm, sequence: u64, at_s: f64, view: &BestView<'_>) -> Vec<Update> {
    let nothing = nothing(sequence);
    let seen = Seen { record: &nothing, purpose: Some(Purpose::Gaze(0)), view: None };
    let best_views = BestViews::from([(0, *view)]);
    swarm.glance(stamp(sequence).order(), at_s, &[seen], &best_views)
}

/// Waits until the second look that is under way is over.
fn second_look(swarm: &mut Swarm) -> Option<Update> {
    let until = std::time::Instant::now() + std::time::Duration::from_secs(60);
    while swarm.awaited().is_some() {
        if let Some((_, update)) = swarm.take_second_look().expect("the thread lives") {
            return Some(update);
        }
        assert!(std::time::Instant::now() < until, "it is never over");
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    None
}

#[test]
fn what_the_first_look_misses_a_second_one_finds() {
    let truth = pose(0.9);
    // The one from a rough start, the other by searching, for which it is its turn.
    for off_m in [OFF_M, 2.0 * OFF_M] {
        with_view(&truth, |view| {
            let mut swarm = misled(&truth, off_m);
            assert!(swarm.frames.is_multiple_of(SEARCH_EVERY_FRAMES));
            assert!(glance_at(&mut swarm, 3, view).is_empty(), "a fine start does not lead there");
            assert_eq!(swarm.awaited(), Some(stamp(3).order()));
            let (target, known) = second_look(&mut swarm).expect("it is there");
            let (measured, by) = known.measured.expect("the filter expects it");
            assert_eq!((target, by), (0, MeasuredBy::Aligned));
            let error = measured.camera_from_markers.translation.vector - truth.translation.vector;
            assert!(error.norm() < 2e-3, "{off_m} m: {} m", error.norm());
            assert_eq!(swarm.awaited(), None);
            assert!(finish(&mut swarm, 3).is_empty(), "it was said already");
        });
    }
}

#[test]
fn who_is_not_searched_for_is_not_found_so_far_off() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut swarm = misled(&truth, 2.0 * OFF_M);
        finish(&mut swarm, 3);
        glance_at(&mut swarm, 4, view);
        assert_eq!(swarm.awaited(), Some(stamp(4).order()));
        assert!(second_look(&mut swarm).is_none());
    });
}

#[test]
fn a_second_look_that_comes_late_corrects_the_track() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut swarm = misled(&truth, OFF_M);
        glance_at(&mut swarm, 3, view);
        let coasted = finish(&mut swarm, 3);
        assert!(coasted[0].1.measured.is_none());
        assert!(second_look(&mut swarm).is_some());
        let known = swarm.neighbours[0].predict(at_s(3)).unwrap().observer_from_target;
        let error = (known.translation.vector - truth.translation.vector).norm();
        assert!(error < 2e-3, "{error} m");
        assert!(swarm.neighbours[0].is_measured());
        finish(&mut swarm, 4);
        assert!(swarm.looked.is_empty(), "nothing is kept of frames that ended");
    });
}

#[test]
fn a_second_look_means_nothing_to_a_track_that_has_gone_on_without_it() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        // Measured for more than a second since...
        let mut swarm = misled(&truth, OFF_M);
        let beside = swarm.neighbours[0].predict(at_s(3)).unwrap().observer_from_target;
        glance_at(&mut swarm, 3, view);
        finish(&mut swarm, 3);
        let mut track = 0;
        for sequence in 4..40 {
            track = glance(&mut swarm, sequence, &beside)[0].1.track_id;
            finish(&mut swarm, sequence);
        }
        assert!(second_look(&mut swarm).is_none());
        assert!(swarm.neighbours[0].is_measured());
        assert_eq!(glance(&mut swarm, 40, &beside)[0].1.track_id, track);
        // ...or given up.
        let mut swarm = misled(&truth, OFF_M);
        glance_at(&mut swarm, 3, view);
        for sequence in 3..60 {
            finish(&mut swarm, sequence);
        }
        assert!(swarm.neighbours[0].predict(at_s(60)).is_none());
        assert!(second_look(&mut swarm).is_none());
        assert!(swarm.neighbours[0].predict(at_s(60)).is_none());
    });
}

#[test]
fn a_second_look_has_nothing_to_say_of_who_was_measured_meanwhile() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut swarm = misled(&truth, OFF_M);
        glance_at(&mut swarm, 3, view);
        let beside = swarm.neighbours[0].predict(at_s(3)).unwrap().observer_from_target;
        assert!(swarm.take_in(stamp(3).order(), at_s(3), 0, &sighting(&beside)).is_some());
        assert_eq!(swarm.awaited(), None);
        let known = swarm.neighbours[0].predict(at_s(3)).unwrap().observer_from_target;
        // It is over when the next one can be asked for.
        let until = std::time::Instant::now() + std::time::Duration::from_secs(60);
        let mut sequence = 4;
        while swarm.awaited().is_none() {
            assert!(swarm.take_second_look().expect("the thread lives").is_none());
            assert_eq!(swarm.neighbours[0].predict(at_s(3)).unwrap().observer_from_target, known);
            assert!(std::time::Instant::now() < until, "it is never over");
            // At one time, so that the track stays as young as it is.
            glance_when(&mut swarm, sequence, at_s(4), view);
            sequence += 1;
        }
    });
}

#[test]
fn there_is_no_second_look_without_need() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        // Found at once, or with newer frames waiting.
        let mut swarm = misled(&truth, 0.0);
        assert_eq!(glance_at(&mut swarm, 3, view).len(), 1);
        assert_eq!(swarm.awaited(), None);
        let mut swarm = misled(&truth, OFF_M);
        swarm.hurry(Pace::Behind);
        glance_at(&mut swarm, 3, view);
        assert_eq!(swarm.awaited(), None);
        // Where nothing is late, the first look does it all.
        swarm.hurry(Pace::Unhurried);
        assert_eq!(glance_at(&mut swarm, 4, view).len(), 1);
        assert_eq!(swarm.awaited(), None);
    });
}

#[test]
fn without_gaze_views_all_is_looked_at_when_the_frame_ends() {
    let truth = pose(0.9);
    let mut swarm = misled(&truth, OFF_M);
    let nothing = nothing(3);
    let seen = vec![Seen { record: &nothing, purpose: Some(Purpose::Partition(0)), view: None }];
    with_view(&truth, |view| {
        let (looks, best_views) = ([(0, seen.clone())], BestViews::from([(0, *view)]));
        let updates = swarm.settle(stamp(3).order(), at_s(3), &looks, &best_views, 1);
        assert_eq!(updates.len(), 1);
        assert_eq!(swarm.awaited(), None);
    });
}

/// A swarm that tracks another neighbour than alpha, with a thread for second looks.
fn swarm_with_bravo() -> Swarm {
    let bravo = squares("bravo", 0.0625, 0.05, 17);
    let mut swarm = swarm_of(vec![alpha(), bravo]).with_second_looks().expect("a thread");
    swarm.hurry(Pace::Live);
    let pose = Isometry3::translation(-1.0, 0.0, 0.0);
    assert!(swarm.take_in(stamp(0).order(), at_s(0), 1, &sighting(&pose)).is_some());
    swarm
}

fn sighting(pose: &Isometry3<f64>) -> Sighting {
    Sighting {
        pose: crate::neighbour::PoseEstimate {
            camera_from_markers: *pose,
            covariance: nalgebra::Matrix6::identity() * 1e-6,
        },
        measured_by: MeasuredBy::Decoded,
        markers: 2,
    }
}

/// One square of alpha that was seen beside where it is, as far as only a rough start leads back from:
/// too little for a pose from corners.
fn probably_alpha(sequence: u64, truth: &Isometry3<f64>) -> Record {
    let mut record = record(sequence, &beside(truth, OFF_M));
    let first = record.markers[0];
    record.markers.iter_mut().for_each(|marker| marker.doubtful = 1);
    record.markers.push(first);
    record
}

fn settle(swarm: &mut Swarm, record: &Record, view: &BestView<'_>) -> Vec<Update> {
    let seen = Seen { record, purpose: Some(Purpose::Partition(0)), view: None };
    let (looks, best_views) = ([(0, vec![seen])], BestViews::from([(0, *view)]));
    let sequence = record.header.stamp.sequence;
    swarm.settle(stamp(sequence).order(), at_s(sequence), &looks, &best_views, 1)
}

fn assert_known(swarm: &Swarm, truth: &Isometry3<f64>) {
    let known = swarm.neighbours[0].predict(at_s(1)).expect("it is tracked").observer_from_target;
    let error = (known.translation.vector - truth.translation.vector).norm();
    assert!(error < 2e-3, "{error} m");
}

#[test]
fn a_newcomer_holds_up_nobody_who_is_tracked() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut swarm = swarm_with_bravo();
        assert!(settle(&mut swarm, &probably_alpha(1, &truth), view).is_empty());
        assert_eq!(swarm.awaited(), Some(stamp(1).order()));
        let (target, known) = second_look(&mut swarm).expect("it is there");
        assert_eq!((target, known.state), (0, Some(TrackState::Tentative)));
        assert_known(&swarm, &truth);
    });
}

#[test]
fn a_newcomer_is_looked_at_again_also_when_newer_frames_wait() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut swarm = swarm_with_bravo();
        swarm.hurry(Pace::Behind);
        assert!(settle(&mut swarm, &probably_alpha(1, &truth), view).is_empty());
        assert!(second_look(&mut swarm).is_some());
    });
}

#[test]
fn a_newcomer_that_nobody_waits_for_is_found_at_once() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut swarm = swarm().with_second_looks().expect("a thread");
        swarm.hurry(Pace::Live);
        assert_eq!(settle(&mut swarm, &probably_alpha(1, &truth), view).len(), 1);
        assert_eq!(swarm.awaited(), None);
        assert_known(&swarm, &truth);
    });
}

#[test]
fn a_newcomers_track_may_begin_when_its_frame_has_ended() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut swarm = swarm_with_bravo();
        settle(&mut swarm, &probably_alpha(1, &truth), view);
        (1..10).for_each(|sequence| drop(finish(&mut swarm, sequence)));
        assert!(second_look(&mut swarm).is_some());
        assert_known(&swarm, &truth);
        // Nor when it was long ago.
        let mut swarm = swarm_with_bravo();
        settle(&mut swarm, &probably_alpha(1, &truth), view);
        (1..30).for_each(|sequence| drop(finish(&mut swarm, sequence)));
        assert!(second_look(&mut swarm).is_none());
        // But not in the place of one that another frame began meanwhile.
        let mut swarm = swarm_with_bravo();
        settle(&mut swarm, &probably_alpha(1, &truth), view);
        finish(&mut swarm, 1);
        let elsewhere = beside(&truth, 0.5);
        swarm.take_in(stamp(2).order(), at_s(2), 0, &sighting(&elsewhere));
        assert!(second_look(&mut swarm).is_none());
        let known = swarm.neighbours[0].predict(at_s(2)).unwrap().observer_from_target;
        assert!((known.translation.vector - elsewhere.translation.vector).norm() < 1e-6);
    });
}

#[test]
fn a_tentative_track_holds_up_nobody_either() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut swarm = swarm_with_bravo();
        swarm.take_in(stamp(0).order(), at_s(0), 0, &sighting(&beside(&truth, OFF_M)));
        assert!(settle(&mut swarm, &nothing(1), view).is_empty());
        assert_eq!(swarm.awaited(), Some(stamp(1).order()));
        assert!(second_look(&mut swarm).is_some());
        assert_known(&swarm, &truth);
    });
}
