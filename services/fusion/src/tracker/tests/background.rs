//! What is left to the background pass, and what becomes of its answers.

use super::*;
use nalgebra::Translation3;

/// So far beside the truth a fine start does not converge, and a rough one does, metres.
const OFF_M: f64 = 0.013;

const BUDGET: TimeBudget = TimeBudget::OneFrame;

fn beside(truth: &Isometry3<f64>, off_m: f64) -> Isometry3<f64> {
    Translation3::new(-0.5 * off_m, 0.7 * off_m, 0.5 * off_m) * truth
}

/// A tracker with a background pass that predicts alpha `off_m` beside where it is.
fn misled(truth: &Isometry3<f64>, off_m: f64) -> Tracking {
    following(&beside(truth, off_m)).with_background()
}

/// The corner pass over alpha's region of interest, in which no marker was found.
fn region_pass(
    tracker: &mut Tracking,
    time: FrameTime,
    view: &BestView<'_>,
    budget: TimeBudget,
) -> Vec<Update> {
    let empty = empty_record(time.order.2);
    let (answered, best_views) = ([of_region(&empty)], BestViews::from([(0, *view)]));
    let (tracker, parts) = tracker.at(time.order.2);
    tracker.region_pass(time, parts, &answered, &best_views, budget)
}

/// Runs the background pass that was asked for.
fn run(tracker: &mut Tracking) -> Option<Update> {
    let answer = tracker.take_job()?.run(&tracker.aligner);
    let order = tracker.under_way()?;
    let (tracker, parts) = tracker.open_parts(order.2);
    tracker.background_answer(*answer, parts).map(|(_, update)| update)
}

fn predicted(tracker: &Tracker, at_s: f64) -> Isometry3<f64> {
    tracker.prediction(0, at_s).expect("it is tracked").camera_from_markers
}

fn assert_tracked_at(tracker: &Tracker, truth: &Isometry3<f64>, at_s: f64) {
    let error_m = error_m(&predicted(tracker, at_s), truth);
    assert!(error_m < 2e-3, "{error_m} m");
}

#[test]
fn the_background_pass_finds_what_a_fine_start_misses() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut tracker = misled(&truth, OFF_M);
        let updates = region_pass(&mut tracker, time(3), view, BUDGET);
        assert!(updates.is_empty(), "a fine start does not converge");
        assert_eq!(tracker.awaited(), Some(stamp(3).order()));
        let (target, estimate) = run(&mut tracker).expect("it is there");
        let (measured, by) = estimate.measured.expect("it is inside the gate");
        assert_eq!((target, by), (0, MeasuredBy::Aligned));
        let error_m = error_m(&measured.camera_from_markers, &truth);
        assert!(error_m < 2e-3, "{error_m} m");
        assert_eq!(tracker.awaited(), None);
        assert!(end(&mut tracker, 3).is_empty(), "its pose has left already");
    });
}

#[test]
fn a_late_answer_corrects_the_track() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut tracker = misled(&truth, OFF_M);
        region_pass(&mut tracker, time(3), view, BUDGET);
        let coasted = end(&mut tracker, 3);
        assert!(coasted[0].1.measured.is_none());
        assert!(run(&mut tracker).is_some());
        assert_tracked_at(&tracker, &truth, at_s(3));
        assert_eq!(tracker.targets[0].state(), Some(TrackState::Confirmed));
    });
}

#[test]
fn a_late_answer_means_nothing_to_a_track_that_has_gone_on_or_ended() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        // Measured for more than a second since.
        let mut tracker = misled(&truth, OFF_M);
        let beside = predicted(&tracker, at_s(3));
        region_pass(&mut tracker, time(3), view, BUDGET);
        end(&mut tracker, 3);
        let mut track_id = 0;
        for sequence in 4..40 {
            track_id = see(&mut tracker, sequence, &beside)[0].1.track_id;
            end(&mut tracker, sequence);
        }
        assert!(run(&mut tracker).is_none());
        assert_eq!(tracker.targets[0].state(), Some(TrackState::Confirmed));
        assert_eq!(see(&mut tracker, 40, &beside)[0].1.track_id, track_id);
        // Lost since.
        let mut tracker = misled(&truth, OFF_M);
        region_pass(&mut tracker, time(3), view, BUDGET);
        for sequence in 3..60 {
            end(&mut tracker, sequence);
        }
        assert!(!tracker.targets[0].is_tracked());
        assert!(run(&mut tracker).is_none());
        assert!(!tracker.targets[0].is_tracked());
    });
}

#[test]
fn a_target_that_was_measured_meanwhile_cancels_its_background_pass() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut tracker = misled(&truth, OFF_M);
        region_pass(&mut tracker, time(3), view, BUDGET);
        let beside = predicted(&tracker, at_s(3));
        assert!(tracker.take_in(time(3), 0, &measurement(&beside)).is_some());
        assert_eq!(tracker.awaited(), None);
        let known = predicted(&tracker, at_s(3));
        assert!(run(&mut tracker).is_none());
        assert_eq!(predicted(&tracker, at_s(3)), known);
        // The next frame may ask again.
        let later = FrameTime { order: stamp(5).order(), ..time(4) };
        region_pass(&mut tracker, later, view, BUDGET);
        assert_eq!(tracker.awaited(), Some(stamp(5).order()));
    });
}

#[test]
fn no_background_pass_is_asked_for_without_need() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        // Found at once, or without time.
        let mut tracker = misled(&truth, 0.0);
        assert_eq!(region_pass(&mut tracker, time(3), view, BUDGET).len(), 1);
        assert_eq!(tracker.awaited(), None);
        let mut tracker = misled(&truth, OFF_M);
        region_pass(&mut tracker, time(3), view, TimeBudget::Overspent);
        assert_eq!(tracker.awaited(), None);
        // With unlimited time everything is done at once.
        assert_eq!(region_pass(&mut tracker, time(4), view, TimeBudget::Unlimited).len(), 1);
        assert_eq!(tracker.awaited(), None);
    });
}

#[test]
fn a_single_target_without_a_region_is_measured_at_once() {
    let truth = pose(0.9);
    let mut tracker = misled(&truth, OFF_M);
    with_view(&truth, |view| {
        let updates = final_corner_pass(&mut tracker, 3, &empty_record(3), *view, BUDGET);
        assert_eq!(updates.len(), 1);
        assert_eq!(tracker.awaited(), None);
    });
}

/// A tracker with a background pass that tracks bravo.
fn tracking_bravo() -> Tracking {
    let mut tracker = Tracking::of(tracker_of(vec![alpha(), bravo()], 1)).with_background();
    let pose = Isometry3::translation(-1.0, 0.0, 0.0);
    assert!(tracker.take_in(time(0), 1, &measurement(&pose)).is_some());
    tracker
}

/// A tracker that tracks bravo, and alpha tentatively, so far beside where it is that only a rough
/// start leads back.
fn tentative(truth: &Isometry3<f64>) -> Tracking {
    let mut tracker = tracking_bravo();
    tracker.take_in(time(0), 0, &measurement(&beside(truth, OFF_M)));
    tracker
}

fn measure_alpha(tracker: &mut Tracking, sequence: u64, view: &BestView<'_>) -> Vec<Update> {
    final_corner_pass(tracker, sequence, &empty_record(sequence), *view, BUDGET)
}

#[test]
fn a_tentative_track_holds_up_no_other_target() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut tracker = tentative(&truth);
        assert!(measure_alpha(&mut tracker, 1, view).is_empty());
        assert_eq!(tracker.awaited(), Some(stamp(1).order()));
        assert!(run(&mut tracker).is_some());
        assert_tracked_at(&tracker, &truth, at_s(1));
    });
}

#[test]
fn a_late_answer_may_start_a_track() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut tracker = tentative(&truth);
        measure_alpha(&mut tracker, 1, view);
        (1..10).for_each(|sequence| drop(end(&mut tracker, sequence)));
        assert!(run(&mut tracker).is_some());
        assert_tracked_at(&tracker, &truth, at_s(1));
        // Not if the frame is too old.
        let mut tracker = tentative(&truth);
        measure_alpha(&mut tracker, 1, view);
        (1..30).for_each(|sequence| drop(end(&mut tracker, sequence)));
        assert!(run(&mut tracker).is_none());
        // Nor if it is a frame of another source, whose clock may be another.
        let mut tracker = tentative(&truth);
        measure_alpha(&mut tracker, 1, view);
        (1..10).for_each(|sequence| drop(end(&mut tracker, sequence)));
        let (source, epoch, _) = stamp(1).order();
        tracker.ended = Some(((source, epoch + 1, 0), at_s(1)));
        assert!(run(&mut tracker).is_none());
        // Nor in place of a track that another frame started meanwhile.
        let mut tracker = tentative(&truth);
        measure_alpha(&mut tracker, 1, view);
        (1..10).for_each(|sequence| drop(end(&mut tracker, sequence)));
        assert!(!tracker.targets[0].is_tracked());
        let elsewhere = beside(&truth, 0.5);
        tracker.take_in(time(10), 0, &measurement(&elsewhere));
        assert!(run(&mut tracker).is_none());
        assert!(error_m(&predicted(&tracker, at_s(10)), &elsewhere) < 1e-6);
    });
}
