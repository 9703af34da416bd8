//! Passes over frames whose parts come late, early, and in another order.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "of the drawings")]

use std::collections::BTreeMap;
use std::ops::{Deref, DerefMut};

use super::*;
use crate::aligner::BestView;
use crate::fixtures::*;
use crate::frame::parts::parts_of;
use crate::policy::SUSPENDED_FRAMES;
use crate::record::Record;
use flockeye_contract::MeasuredBy;
use flockeye_geometry::filter::TrackState;
use flockeye_geometry::pose::PoseEstimate;
use flockeye_geometry::search::Purpose;
use nalgebra::{Isometry3, Matrix6};

mod ambiguous;
mod background;
mod hidden;

/// A tracker, with the parts of its targets in frames that have not ended.
struct Tracking {
    tracker: Tracker,
    parts: BTreeMap<u64, Vec<Part>>,
}

impl Tracking {
    fn of(tracker: Tracker) -> Self {
        Self { tracker, parts: BTreeMap::new() }
    }

    fn with_background(mut self) -> Self {
        self.tracker.background = Some(BackgroundSlot::default());
        self
    }

    /// The tracker, with the parts of its targets in a frame.
    fn at(&mut self, sequence: u64) -> (&mut Tracker, &mut Vec<Part>) {
        let targets = self.tracker.targets().len();
        let parts = self.parts.entry(sequence).or_insert_with(|| parts_of(targets, |_| false));
        (&mut self.tracker, parts)
    }

    /// The parts of a frame, if it has not ended.
    fn open_parts(&mut self, sequence: u64) -> (&mut Tracker, Option<&mut Vec<Part>>) {
        (&mut self.tracker, self.parts.get_mut(&sequence))
    }

    fn take_in(
        &mut self,
        time: FrameTime,
        target: usize,
        measurement: &PoseMeasurement,
    ) -> Option<Update> {
        let (tracker, parts) = self.at(time.order.2);
        tracker.take_in(time, target, parts.get_mut(target), *measurement).0
    }
}

impl Deref for Tracking {
    type Target = Tracker;

    fn deref(&self) -> &Tracker {
        &self.tracker
    }
}

impl DerefMut for Tracking {
    fn deref_mut(&mut self) -> &mut Tracker {
        &mut self.tracker
    }
}

fn time(sequence: u64) -> FrameTime {
    FrameTime { order: stamp(sequence).order(), at_s: at_s(sequence) }
}

/// A record of alpha's region of interest.
fn of_region(record: &Record) -> AnsweredView<'_> {
    AnsweredView { record, purpose: Some(Purpose::Roi(0)), view: None }
}

/// A record of a tile.
fn of_tile(record: &Record) -> AnsweredView<'_> {
    AnsweredView { record, purpose: Some(Purpose::Partition(0)), view: None }
}

/// The corner pass over alpha's region, in which its markers were found at `pose`.
fn see(tracker: &mut Tracking, sequence: u64, pose: &Isometry3<f64>) -> Vec<Update> {
    let record = record(sequence, pose);
    let (answered, views) = ([of_region(&record)], BestViews::new());
    let (tracker, parts) = tracker.at(sequence);
    tracker.region_pass(time(sequence), parts, &answered, &views, TimeBudget::Unlimited)
}

/// Ends a frame of which nothing more is known.
fn end(tracking: &mut Tracking, sequence: u64) -> Vec<Update> {
    let (time, views) = (time(sequence), BestViews::new());
    let (tracker, parts) = tracking.at(sequence);
    let updates = tracker.final_pass(time, parts, &[], &views, TimeBudget::Unlimited);
    tracker.end_frame(time.order, time.at_s, parts);
    tracking.parts.remove(&sequence);
    updates
}

/// A tracker that has measured alpha in frames 0 to 2.
fn following(pose: &Isometry3<f64>) -> Tracking {
    let mut tracker = Tracking::of(tracker_of(vec![alpha()], 1));
    for sequence in 0..3 {
        assert_eq!(see(&mut tracker, sequence, pose).len(), 1);
        assert!(end(&mut tracker, sequence).is_empty(), "its pose has left already");
    }
    tracker
}

fn direct(tracker: &mut Tracking, sequence: u64, view: &BestView<'_>) -> Option<Update> {
    let (tracker, parts) = tracker.at(sequence);
    tracker.direct_pass(time(sequence), parts, &[(0, *view)]).pop()
}

fn untracked() -> Tracking {
    Tracking::of(tracker_of(vec![alpha()], 1))
}

/// A last corner pass for alpha alone.
fn final_corner_pass(
    tracker: &mut Tracking,
    sequence: u64,
    record: &Record,
    view: BestView<'_>,
    budget: TimeBudget,
) -> Vec<Update> {
    let (answered, best_views) = ([of_tile(record)], BestViews::from([(0, view)]));
    let tried = [(0, answered.as_slice())];
    let (pass, (tracker, parts)) = (Pass::Complete, tracker.at(sequence));
    tracker.corner_pass(time(sequence), parts, &tried, &best_views, pass, budget)
}

#[test]
fn a_frame_need_not_wait_for_the_one_before() {
    let truth = pose(0.9);
    let mut tracker = following(&truth);
    // Frame 4 is searched while frame 3 waits for a tile, in which nothing is found.
    let updates = see(&mut tracker, 4, &truth);
    assert!(updates[0].1.measured.is_some());
    let late = end(&mut tracker, 3);
    assert_eq!(late.len(), 1);
    assert!(late[0].1.measured.is_none(), "frame 3 did not show it");
    assert_eq!(tracker.prediction(0, at_s(5)).map(|p| p.stamp_s), Some(at_s(5)));
    assert_eq!(tracker.targets[0].state(), Some(TrackState::Confirmed), "frame 4 did");
    assert!(end(&mut tracker, 4).is_empty(), "its pose has left already");
}

#[test]
fn a_late_frame_is_put_where_it_belongs_in_time() {
    let truth = pose(0.9);
    let mut tracker = following(&truth);
    assert_eq!(see(&mut tracker, 4, &truth).len(), 1);
    let late = see(&mut tracker, 3, &truth);
    assert!(late[0].1.measured.is_some());
    assert_eq!(late[0].1.state, Some(TrackState::Confirmed));
}

#[test]
fn a_confirmed_target_is_measured_before_its_region_is_searched() {
    let truth = pose(0.9);
    let mut tracker = following(&truth);
    with_view(&truth, |view| {
        let (target, estimate) = direct(&mut tracker, 3, view).expect("it is there");
        let (measured, by) = estimate.measured.expect("it is measured");
        assert_eq!((target, by, estimate.markers), (0, MeasuredBy::Aligned, 0));
        let error_m = error_m(&measured.camera_from_markers, &truth);
        assert!(error_m < 2e-3, "{error_m} m");
        // Its view in this frame need not be held any more, that in the next one is.
        let shown = [3, 4].map(|sequence| unpublished(tracker.at(sequence).1).count());
        assert_eq!(shown, [0, 1]);
        // The markers that are found later agree, and there is nothing to add.
        assert!(see(&mut tracker, 3, &truth).is_empty());
        assert!(direct(&mut tracker, 3, view).is_none(), "once is enough");
        assert!(!tracker.needs_no_markers(0), "frame 3 has not ended");
        assert!(end(&mut tracker, 3).is_empty());
        assert!(tracker.needs_no_markers(0));
        assert!(direct(&mut tracker, 4, view).is_some());
        // Frame 5 does not show it, so its markers are searched again.
        end(&mut tracker, 4);
        end(&mut tracker, 5);
        assert!(!tracker.needs_no_markers(0));
    });
}

#[test]
fn a_failed_attempt_is_repeated_only_with_new_inputs() {
    let truth = pose(0.9);
    let mut tracker = following(&truth);
    end(&mut tracker, 3);
    let empty = empty_record(4);
    let mut measure = |view: BestView<'_>| {
        final_corner_pass(&mut tracker, 4, &empty, view, TimeBudget::Unlimited).len()
    };
    with_view(&pose(2.4), |elsewhere| assert_eq!(measure(*elsewhere), 0));
    with_view(&truth, |view| {
        // It would be found, were it aligned again.
        assert_eq!(measure(*view), 0);
        assert_eq!(measure(BestView { view_index: 1, ..*view }), 1);
    });
}

#[test]
fn the_start_of_a_rejected_direct_pass_is_not_aligned_again() {
    let truth = pose(0.9);
    let mut tracker = following(&truth);
    let empty = empty_record(3);
    let answered = [of_region(&empty)];
    with_view(&pose(2.4), |elsewhere| assert!(direct(&mut tracker, 3, elsewhere).is_none()));
    let mut is_measured = |view: &BestView<'_>| {
        let best_views = BestViews::from([(0, *view)]);
        let budget = TimeBudget::OneFrame;
        let (tracker, parts) = tracker.at(3);
        let prior = tracker.prior(0, at_s(3));
        let begun = Trial { is_deferred: true, ..Trial::of(Pass::Complete, &prior, budget) };
        let part = parts.first().unwrap();
        let inputs = tracker.inputs(time(3), 0, part, &answered, &best_views, begun);
        inputs.expect("it was predicted").measure(&tracker.aligner).measurement().is_some()
    };
    with_view(&truth, |view| {
        assert!(!is_measured(view), "it would be found, were it aligned again");
        let other = BestView { view_index: 1, ..*view };
        assert!(is_measured(&other), "another view may show more");
    });
}

#[test]
fn markers_measure_a_frame_without_time() {
    let truth = pose(0.9);
    let mut tracker = following(&truth);
    let record = record(3, &truth);
    let (answered, views) = ([of_region(&record)], BestViews::new());
    let (tracker, parts) = tracker.at(3);
    let updates = tracker.region_pass(time(3), parts, &answered, &views, TimeBudget::Overspent);
    assert!(updates[0].1.measured.is_some());
}

#[test]
fn only_confirmed_targets_have_a_direct_pass() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut tracker = untracked();
        assert!(direct(&mut tracker, 0, view).is_none(), "it has no track");
        assert_eq!(see(&mut tracker, 0, &truth).len(), 1);
        assert!(direct(&mut tracker, 1, view).is_none(), "it was seen once");
        let mut tracker = following(&truth);
        end(&mut tracker, 3);
        assert!(direct(&mut tracker, 4, view).is_some(), "it coasts");
    });
    // A picture that does not show it is not accepted either.
    with_view(&pose(2.4), |view| assert!(direct(&mut following(&truth), 3, view).is_none()));
}

#[test]
fn markers_that_contradict_a_direct_pose_suspend_the_direct_pass() {
    let truth = pose(0.9);
    let mut tracker = following(&truth);
    with_view(&truth, |view| {
        assert!(direct(&mut tracker, 3, view).is_some());
        // Turned by one facet.
        see(&mut tracker, 3, &pose(0.9 + std::f64::consts::FRAC_PI_4));
        end(&mut tracker, 3);
        assert!(direct(&mut tracker, 4, view).is_none());
        for sequence in 4..4 + SUSPENDED_FRAMES {
            see(&mut tracker, sequence, &truth);
            end(&mut tracker, sequence);
        }
        assert!(direct(&mut tracker, 4 + SUSPENDED_FRAMES, view).is_some(), "it runs again");
    });
}

#[test]
fn direct_passes_on_several_threads_give_the_same() {
    let (here, there) = (pose(0.9), Isometry3::translation(-1.0, 0.2, 0.0));
    let measured = |threads| {
        let mut tracker = Tracking::of(tracker_of(vec![alpha(), bravo()], threads));
        for sequence in 0..3 {
            for (target, pose) in [(0, here), (1, there)] {
                tracker.take_in(time(sequence), target, &measurement(&pose));
            }
        }
        // Where bravo should be, its view shows nothing like it.
        with_view(&here, |view| {
            let regions = [0, 1].map(|target| (target, *view));
            let (tracker, parts) = tracker.at(3);
            tracker.direct_pass(time(3), parts, &regions)
        })
    };
    let alone = measured(1);
    assert_eq!(alone.iter().map(|(target, _)| *target).collect::<Vec<_>>(), [0]);
    assert_eq!(measured(2), alone);
    assert_eq!(measured(7), alone);
}

#[test]
fn regions_of_targets_that_do_not_exist_are_ignored() {
    let truth = pose(0.9);
    let mut tracker = following(&truth);
    let record = record(3, &truth);
    let answered = [AnsweredView { purpose: Some(Purpose::Roi(9)), ..of_region(&record) }];
    let ((tracker, parts), views) = (tracker.at(3), BestViews::new());
    let updates = tracker.region_pass(time(3), parts, &answered, &views, TimeBudget::Unlimited);
    assert!(updates.is_empty());
    with_view(&truth, |view| {
        let regions = [(9, *view)];
        assert!(tracker.direct_pass(time(3), parts, &regions).is_empty());
    });
}

/// Nearly all of a body is hidden, say: alignment tells little of where it is.
#[test]
fn an_imprecise_measurement_only_corrects_a_track_that_it_agrees_with() {
    let truth = pose(0.9);
    let imprecise = |camera_from_markers: &Isometry3<f64>| {
        let precise = measurement(camera_from_markers);
        let pose = PoseEstimate { covariance: Matrix6::identity() * 2e-3, ..precise.pose };
        PoseMeasurement { pose, is_precise: false, ..precise }
    };
    assert!(untracked().take_in(time(0), 0, &imprecise(&truth)).is_none(), "it starts no track");

    let mut tracker = following(&truth);
    let (_, estimate) = tracker.take_in(time(3), 0, &imprecise(&truth)).expect("it agrees");
    assert_eq!((estimate.measured, estimate.state), (None, Some(TrackState::Confirmed)));
    assert_eq!(estimate.unseen_s, 0.0, "the track goes on from it");
    assert!(end(&mut tracker, 3).is_empty(), "its pose has left already");

    let elsewhere = nalgebra::Translation3::new(0.0, 0.0, 1.0) * truth;
    for sequence in 4..8 {
        let found = tracker.take_in(time(sequence), 0, &imprecise(&elsewhere));
        assert!(found.is_none(), "however often it is repeated");
    }
}

/// Alpha 4 m away, where little is precise.
fn far_away() -> Isometry3<f64> {
    let near = pose(0.9);
    Isometry3::from_parts((near.translation.vector * 4.5).into(), near.rotation)
}

/// Frames 0 to 2, in which alpha was measured at `truth`, by whatever.
fn measured_at(tracker: &mut Tracking, truth: &Isometry3<f64>) {
    for sequence in 0..3 {
        assert!(tracker.take_in(time(sequence), 0, &measurement(truth)).is_some());
        assert!(end(tracker, sequence).is_empty());
    }
}

/// At 4 m, with 13.5 times the covariance: the picture shows that the body is there, but not how
/// far.
#[test]
fn what_is_imprecise_waits_until_nothing_better_can_come() {
    let truth = far_away();
    let bodies = Bodies::new("DICT_5X5_250".into(), vec![alpha()]).unwrap();
    let aligner = aligner(&bodies).with_covariance_scale(13.5);
    let filter = Some(TrackPolicy::default());
    let mut tracker = Tracking::of(Tracker::new(&bodies, filter, Arc::new(aligner), 1, None));
    measured_at(&mut tracker, &truth);
    with_view(&truth, |view| {
        let best_views = BestViews::from([(0, *view)]);
        let searched = empty_record(3);
        let answered = [of_region(&searched)];
        let budget = TimeBudget::Unlimited;
        assert!(direct(&mut tracker, 3, view).is_none());
        let (tracker, parts) = tracker.at(3);
        let updates = tracker.region_pass(time(3), parts, &answered, &best_views, budget);
        assert!(updates.is_empty(), "{updates:?}");
        let updates = tracker.final_pass(time(3), parts, &answered, &best_views, budget);
        let [(0, estimate)] = updates.as_slice() else { panic!("{updates:?}") };
        assert_eq!((estimate.measured, estimate.unseen_s), (None, 0.0));
        assert_eq!(estimate.state, Some(TrackState::Confirmed));
    });
}

/// At 4 m, corners that may be off by a thousandth of a radian.
#[test]
fn corners_that_leave_the_pose_uncertain_only_correct_a_track() {
    let truth = far_away();
    let passes = |tracker: &mut Tracking| {
        let mut record = record(3, &truth);
        record.markers.iter_mut().for_each(|marker| marker.deviations = [1e-3; 4]);
        let (answered, views) = ([of_region(&record)], BestViews::new());
        let budget = TimeBudget::Unlimited;
        let (tracker, parts) = tracker.at(3);
        let region = tracker.region_pass(time(3), parts, &answered, &views, budget);
        assert!(region.is_empty(), "{region:?}");
        tracker.final_pass(time(3), parts, &answered, &views, budget)
    };
    assert!(passes(&mut untracked()).is_empty(), "it starts no track");
    let mut tracker = untracked();
    measured_at(&mut tracker, &truth);
    let updates = passes(&mut tracker);
    let [(0, estimate)] = updates.as_slice() else { panic!("{updates:?}") };
    assert_eq!((estimate.measured, estimate.unseen_s), (None, 0.0));
    assert_eq!(estimate.state, Some(TrackState::Confirmed));
}
