//! When frames are complete, and what they hold until then.

#![allow(clippy::unwrap_used, clippy::expect_used)]
use super::*;
use crate::fixtures::plan;
use flockeye_contract::{DetectionHeader, ViewKind};

const KEEPING: Keeping = Keeping {
    deadline_ns: 1000,
    max_unanswered: 8,
    max_best: 8,
    keeps_pixels: true,
    keeps_regions: true,
    keeps_places: true,
};

/// Counts who holds it.
type Hold = std::rc::Rc<[u8]>;

fn stamp(sequence: u64) -> FrameStamp {
    FrameStamp { sequence, ..FrameStamp::default() }
}

fn record(sequence: u64, view_index: u32) -> Record {
    let header = DetectionHeader {
        stamp: stamp(sequence),
        plan_id: 1,
        view_index,
        ..DetectionHeader::default()
    };
    Record { header, markers: Vec::new() }
}

fn end(sequence: u64, views_issued: u32) -> FrameEnd {
    FrameEnd { stamp: stamp(sequence), plan_id: 1, views_issued, ..FrameEnd::default() }
}

fn view(sequence: u64, view_index: u32, kind: ViewKind) -> ViewHeader {
    ViewHeader {
        stamp: stamp(sequence),
        view_index,
        kind: kind.code(),
        target: 0,
        tile: 0,
        ..ViewHeader::default()
    }
}

/// Frames of two targets, after the first plan.
fn planned(keeping: Keeping) -> Frames<Hold> {
    let mut frames = Frames::new(keeping, 2);
    frames.note_plan(1, &plan());
    frames
}

/// Completes the oldest frame and ends it, if it need not wait any more. Says whether it is
/// overdue.
fn take(frames: &mut Frames<Hold>, now_ns: i64) -> Option<(OpenFrame<Hold>, bool)> {
    let Work::CompleteFrame { order, is_overdue } = frames.next_work(now_ns)? else { return None };
    frames.complete(order);
    assert_eq!(frames.next_work(now_ns), Some(Work::MeasureFrame { order }));
    frames.end(order).map(|frame| (frame, is_overdue))
}

fn has_none(frames: &mut Frames<Hold>, now_ns: i64) -> bool {
    take(frames, now_ns).is_none()
}

#[test]
fn old_plans_are_forgotten() {
    let mut frames = planned(KEEPING);
    let plan = plan();
    (1..=100).for_each(|plan_id| frames.note_plan(plan_id, &plan));
    assert_eq!(frames.plans.len(), REMEMBERED_PLANS);
    assert_eq!(frames.plans[&100].views[0].purpose, Purpose::Partition(0));
    assert_eq!((frames.views_of_plan(1), frames.newest_plan), (None, 100));
}

#[test]
fn a_frame_is_complete_when_all_its_views_are_in() {
    let mut frames = planned(KEEPING);
    assert!(frames.add_record(record(0, 1), 0).is_some());
    frames.add_end(end(0, 2), 0);
    assert!(has_none(&mut frames, 1));
    assert_eq!(frames.get(stamp(0).order()).unwrap().records.len(), 1);
    assert!(frames.add_record(record(0, 0), 2).is_some());
    assert!(frames.add_record(record(0, 0), 2).is_none(), "a second answer counts for nothing");
    let (frame, is_overdue) = take(&mut frames, 2).expect("complete");
    assert_eq!((is_overdue, frame.records.len()), (false, 2));
    assert_eq!((frame.stamp.sequence, frame.phase), (0, Phase::Complete));
    assert!(frames.add_record(record(0, 5), 3).is_none(), "the frame takes nothing more");
}

#[test]
fn frames_are_complete_in_order() {
    let mut frames = planned(KEEPING);
    frames.add_end(end(7, 1), 0);
    frames.add_end(end(8, 0), 0);
    assert!(has_none(&mut frames, 1), "8 is whole but 7 is older");
    frames.add_record(record(7, 0), 1);
    assert_eq!(take(&mut frames, 1).expect("7").0.stamp.sequence, 7);
    assert_eq!(take(&mut frames, 1).expect("8").0.stamp.sequence, 8);
}

#[test]
fn a_dead_stage_holds_a_frame_only_to_its_deadline() {
    let mut frames = planned(KEEPING);
    frames.add_record(record(0, 0), 5);
    assert_eq!(frames.next_deadline_ns(), Some(1005));
    assert!(has_none(&mut frames, 1004));
    assert!(take(&mut frames, 1005).expect("overdue").1);
}

#[test]
fn what_came_before_this_process_began_is_not_waited_for() {
    let mut frames = planned(KEEPING);
    let of_predecessor = |mut record: Record| {
        record.header.plan_id = 24;
        record
    };
    assert!(frames.add_record(of_predecessor(record(6, 3)), 0).is_some());
    frames.add_end(FrameEnd { plan_id: 24, ..end(6, 4) }, 0);
    assert!(frames.add_record(record(7, 0), 1).is_some());
    assert!(has_none(&mut frames, 2), "its records may still come");
    frames.add_end(end(7, 1), 3);
    let left = [(); 2].map(|()| take(&mut frames, 4).expect("both are complete"));
    let left = left.map(|(frame, is_overdue)| (frame.stamp.sequence, frame.is_whole(), is_overdue));
    assert_eq!(left, [(6, false, false), (7, true, false)]);
    // What follows its own plan is waited for, whoever else is complete.
    assert!(frames.add_record(record(8, 1), 5).is_some());
    frames.add_end(end(8, 2), 5);
    frames.add_end(end(9, 0), 5);
    assert!(has_none(&mut frames, 6));
}

#[test]
fn a_flood_of_frames_is_bounded() {
    let mut frames = planned(Keeping { deadline_ns: i64::MAX / 2, ..KEEPING });
    for sequence in 0..100 {
        frames.add_record(record(sequence, 0), 0);
        while take(&mut frames, 0).is_some() {}
        assert!(frames.frames.len() <= MAX_OPEN_FRAMES);
    }
    let rotation = |sequence| Rotation { stamp: stamp(sequence), ..Rotation::default() };
    (0..200).for_each(|sequence| frames.add_rotation(rotation(sequence)));
    assert_eq!(frames.rotations.len(), MAX_ROTATIONS);
    let next = |frames: &mut Frames<Hold>, until: u64| frames.take_rotation(stamp(until).order());
    assert!(next(&mut frames, 135).is_none(), "the oldest are dropped");
    assert_eq!(next(&mut frames, 136).map(|rotation| rotation.stamp.sequence), Some(136));
}

/// What a view shows that is the first target's own region.
fn own(view_index: u32) -> Vec<(usize, ViewQuality)> {
    let quality = ViewQuality {
        is_own: true,
        is_followed: true,
        decoded: 0,
        focal_px: 1.0,
        off_centre: 0.0,
        view_index,
    };
    vec![(0, quality)]
}

#[test]
fn views_that_no_target_needs_are_released() {
    let mut frames = planned(Keeping { max_unanswered: 3, max_best: 2, ..KEEPING });
    let pixels = Hold::default();
    for (sequence, view_index) in [(0, 7), (0, 8), (1, 2), (1, 3), (1, 4)] {
        let header = view(sequence, view_index, ViewKind::Partition);
        assert!(frames.add_view(header, pixels.clone(), 0));
    }
    assert_eq!(Hold::strong_count(&pixels), 4, "three are unanswered");
    assert!(frames.is_full());
    let order = stamp(1).order();
    frames.answer(order, 2, Vec::new(), false);
    assert_eq!(Hold::strong_count(&pixels), 3, "it shows no target");
    assert!(!frames.is_full());
    frames.answer(order, 3, own(3), false);
    assert_eq!(Hold::strong_count(&pixels), 3, "it shows a target");
    frames.get_mut(order).unwrap().held.best.remove(&0);
    assert_eq!(Hold::strong_count(&pixels), 2, "the target is measured");
    drop(frames.end(order));
    assert_eq!(Hold::strong_count(&pixels), 1);
}

#[test]
fn newer_frames_give_way_to_the_oldest() {
    let mut frames = planned(Keeping { max_best: 2, ..KEEPING });
    for sequence in 1..5 {
        frames.add_view(view(sequence, 0, ViewKind::Partition), Hold::default(), 0);
        frames.answer(stamp(sequence).order(), 0, own(0), false);
    }
    let best = |sequence| frames.get(stamp(sequence).order()).unwrap().held.best.len();
    assert_eq!([1, 2, 3, 4].map(best), [1, 1, 0, 0]);
}

#[test]
fn a_flood_of_places_is_bounded_and_the_oldest_frame_keeps_its_own() {
    let mut frames = planned(KEEPING);
    for sequence in (0..3).rev() {
        for view_index in 0..100 {
            let header = view(sequence, view_index, ViewKind::Proposal);
            let search = flockeye_contract::Search::FineWindow.code();
            frames.add_view(ViewHeader { search, ..header }, Hold::default(), 0);
        }
    }
    let places = |sequence| frames.get(stamp(sequence).order()).unwrap().places.views.len();
    assert_eq!([0, 1, 2].map(places), [100, MAX_PLACES - 100, 0]);
}

#[test]
fn regions_are_measured_in_the_order_in_which_they_came() {
    let mut frames = planned(KEEPING);
    for (sequence, view_index) in [(4, 0), (4, 1), (4, 2), (3, 5), (4, 6)] {
        frames.add_view(view(sequence, view_index, ViewKind::Roi), Hold::default(), 0);
    }
    // A record that comes before the direct pass leaves its region held.
    let newer = stamp(4).order();
    frames.answer(newer, 2, own(2), true);
    assert!(frames.get(newer).unwrap().held.unanswered.contains_key(&2));
    let mut taken = Vec::new();
    while let Some(Work::MeasureRegions { order, .. }) = frames.next_work(0) {
        taken.push((order.2, frames.take_regions(order, 2)));
        frames.answer_seen(order);
    }
    assert_eq!(taken, [(4, vec![0, 1]), (4, vec![2]), (3, vec![5]), (4, vec![6])]);
    assert!(!frames.get(newer).unwrap().held.unanswered.contains_key(&2));
}

#[test]
fn a_pose_that_left_another_process_does_not_leave_again() {
    let mut frames = planned(KEEPING);
    frames.note_published_before(1, Some(stamp(4).order()));
    frames.note_published_before(9, Some(stamp(4).order()));
    for sequence in [3, 4, 5] {
        frames.add_record(record(sequence, 0), 0);
    }
    let left = |sequence| is_published(&frames.get(stamp(sequence).order()).unwrap().parts, 1);
    assert_eq!([3, 4, 5].map(left), [true, true, false]);
    assert_eq!([0, 1].map(|target| frames.last_published(target)), [None, Some(stamp(4).order())]);
}
