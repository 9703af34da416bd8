//! Tests of the core with events, without a process.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use super::*;
use crate::cadence::Cadence;
use crate::virtual_budget::VirtualBudget;
use flockeye_config::{Costs, Pipeline};
use flockeye_contract::{FrameStamp, ViewKind};
use flockeye_geometry::partition::Partition;

const MS: i64 = 1_000_000;

fn core(flow: Flow, clock: FrameClock, workers: usize) -> Core<()> {
    let views = Partition::icosahedron().views(0.1, 600.0).unwrap();
    let camera = Camera::equirectangular(3840, 1920);
    let overdue = Duration::from_millis(500);
    let resolved = Resolved::of(Pipeline::parse("", &[], "a test").unwrap()).unwrap();
    let dispatcher = Dispatcher::new(workers, 2, overdue / 2);
    let tiles = (0..).zip(views).collect();
    let usual = Core::of(&resolved, 3, 0).unwrap();
    Core { flow, workers, overdue, camera, clock, dispatcher, tiles, ..usual }
}

fn flying(workers: usize) -> Core<()> {
    core(Flow::Latest, FrameClock::Live(Cadence::default()), workers)
}

fn stamp(sequence: u64) -> FrameStamp {
    FrameStamp { sequence, exposure_ns: 33 * MS * sequence as i64, ..FrameStamp::default() }
}

fn frame(sequence: u64) -> Event<()> {
    Event::Frame(FrameHeader { stamp: stamp(sequence), ..FrameHeader::default() }, ())
}

/// A plan of these views, made at `made_ns`.
fn plan(plan_id: u64, kinds: &[ViewKind], made_ns: i64) -> Event<()> {
    let rule = StopRule::Deadline;
    let header = PlanHeader {
        plan_id,
        made_ns,
        stop_rule: rule.code(),
        view_budget: 3,
        ..PlanHeader::default()
    };
    let view = |kind: &ViewKind| PlannedView {
        camera_from_view: [0.0, 0.0, 0.0, 1.0],
        focal_px: 600.0,
        size_px: 1000,
        kind: kind.code(),
        ..PlannedView::default()
    };
    Event::Plan(header, kinds.iter().map(view).collect())
}

#[test]
fn views_have_the_response_of_the_frame_or_of_the_plan() {
    for gamma in [0.0, 1.25] {
        let mut core = flying(1);
        let Event::Plan(header, views) = plan(1, &[ViewKind::Partition], 0) else { unreachable!() };
        core.on(Event::Plan(PlanHeader { gamma, ..header }, views), 0);
        core.on(frame(1), MS);
        let view = next_cut(&mut core, MS).header;
        let curve = if gamma > 0.0 { Transfer::Gamma } else { Transfer::Srgb };
        assert_eq!((view.transfer, view.gamma), (curve.code(), gamma));
    }
}

fn answer(order: &CutOrder) -> Event<()> {
    let ViewHeader { stamp, view_index, worker, attempt, .. } = order.header;
    Event::Answer(DetectionHeader {
        stamp,
        view_index,
        worker,
        attempt,
        ..DetectionHeader::default()
    })
}

fn published(order: &CutOrder) -> Event<()> {
    Event::Published { header: order.header, took_ns: MS }
}

/// Cuts and answers views at once until there is nothing to do: how many of each frame, and the
/// ends.
fn run(core: &mut Core<()>, now_ns: i64) -> (Vec<CutOrder>, Vec<FrameEnd>) {
    let (mut orders, mut ends) = (Vec::new(), Vec::new());
    loop {
        match core.step(now_ns) {
            Action::TakeUp { .. } => {}
            Action::Cut(order) => {
                core.on(published(&order), now_ns);
                core.on(answer(&order), now_ns);
                orders.push(order);
            }
            Action::End(end) => ends.push(end),
            Action::Look { .. } => panic!("no proposals are planned"),
            Action::Wait(_) => return (orders, ends),
        }
        assert!(orders.len() < 1000);
    }
}

/// The next view to be cut.
fn next_cut(core: &mut Core<()>, now_ns: i64) -> CutOrder {
    loop {
        match core.step(now_ns) {
            Action::TakeUp { .. } => {}
            Action::Cut(order) => return order,
            other => panic!("{other:?}"),
        }
    }
}

fn reason(end: &FrameEnd) -> StopReason {
    StopReason::try_from(end.reason).unwrap()
}

use ViewKind::{Partition as Tile, Roi};

#[test]
fn a_frame_without_a_plan_is_swept_from_where_the_last_one_stopped() {
    let mut core = flying(2);
    core.on(frame(0), 0);
    for _ in 0..4 {
        let order = next_cut(&mut core, 0);
        core.on(published(&order), 0);
        core.on(answer(&order), 0);
    }
    assert!(!core.on(frame(1), MS), "none waited");
    assert!(matches!(core.step(MS), Action::End(end) if reason(&end) == StopReason::Newer));
    let order = next_cut(&mut core, MS);
    assert_eq!((order.header.plan_id, order.header.view_index, order.header.tile), (0, 0, 4));
    assert_eq!(core.outstanding(), 0);
}

#[test]
fn the_newest_frame_waits_and_the_others_are_dropped() {
    let mut core = flying(2);
    assert!(!core.on(frame(0), 0) && core.on(frame(1), 1) && core.on(frame(2), 2));
    assert!(matches!(core.step(3), Action::TakeUp { frame: (0, 0, 2), .. }));
    assert!(core.waiting.is_none());
}

#[test]
fn a_plan_is_followed_until_it_is_stale() {
    let mut core = flying(2);
    core.on(plan(7, &[Roi, Tile], 0), 0);
    core.on(frame(0), 0);
    let (orders, ends) = run(&mut core, 0);
    assert_eq!((orders.len(), ends[0].plan_id, ends[0].generation), (2, 7, 3));
    assert_eq!(reason(&ends[0]), StopReason::Complete);
    core.on(frame(1), STALE_PLAN_NS);
    assert_eq!(run(&mut core, STALE_PLAN_NS).1[0].plan_id, 0, "fusion has died since");
    let mut lossless = self::core(Flow::Lossless, FrameClock::Unlimited, 2);
    lossless.on(plan(7, &[Roi, Tile, Tile, Tile], 0), 0);
    lossless.on(frame(1), STALE_PLAN_NS);
    let (orders, ends) = run(&mut lossless, STALE_PLAN_NS);
    assert_eq!((orders.len(), ends[0].plan_id), (3, 7), "its budget is three views");
    assert_eq!(reason(&ends[0]), StopReason::Budget);
}

#[test]
fn regions_are_cut_at_once_and_tiles_one_at_a_time() {
    let mut core = flying(2);
    core.on(plan(1, &[Roi, Roi, Tile, Tile], 0), 0);
    core.on(frame(0), 0);
    let cut = |core: &mut Core<()>| {
        let order = next_cut(core, 0);
        core.on(published(&order), 0);
        order
    };
    let orders = [cut(&mut core), cut(&mut core)];
    assert_eq!(
        orders.each_ref().map(|order| (order.header.view_index, order.header.worker)),
        [(0, 0), (1, 1)]
    );
    assert!(matches!(core.step(0), Action::Wait(Some(_))), "one worker stays free of tiles");
    core.on(answer(&orders[0]), 0);
    assert!(matches!(core.step(0), Action::Wait(Some(_))));
    core.on(answer(&orders[1]), 0);
    assert_eq!(cut(&mut core).header.view_index, 2);
    assert!(matches!(core.step(0), Action::Wait(Some(_))));
}

#[test]
fn after_some_frames_for_regions_only_a_tile_is_due() {
    let regions_only = |core: &mut Core<()>, sequence: u64| {
        let region = next_cut(core, 0);
        core.on(published(&region), 0);
        core.on(answer(&region), 0);
        core.on(frame(sequence + 1), 0);
        core.step(0)
    };
    let is_newer = |action| matches!(action, Action::End(end) if reason(&end) == StopReason::Newer);
    let mut core = flying(3);
    core.on(plan(1, &[Roi, Tile, Tile], 0), 0);
    core.on(frame(0), 0);
    assert!((0..4).all(|sequence| is_newer(regions_only(&mut core, sequence))));
    let Action::Cut(tile) = regions_only(&mut core, 4) else { panic!("a tile is due") };
    assert_eq!(tile.header.view_index, 1);
    core.on(published(&tile), 0);
    core.on(answer(&tile), 0);
    assert!(is_newer(core.step(0)), "one is enough");
    assert!(is_newer(regions_only(&mut core, 5)), "frames are counted anew");
    let mut core = flying(3);
    core.on(plan(1, &[Roi, ViewKind::Proposal], 0), 0);
    core.on(frame(0), 0);
    assert!((0..6).all(|sequence| is_newer(regions_only(&mut core, sequence))), "nothing else is");
}

#[test]
fn the_views_of_a_silent_worker_go_to_another() {
    let mut core = flying(2);
    core.on(plan(1, &[Roi, Roi], 0), 0);
    core.on(frame(0), 0);
    let mut orders = Vec::new();
    for _ in 0..2 {
        let order = next_cut(&mut core, 0);
        core.on(published(&order), 0);
        orders.push(order);
    }
    core.on(answer(&orders[0]), MS);
    assert!(matches!(core.step(MS), Action::End(_)));
    assert!(matches!(core.step(400 * MS), Action::Wait(Some(_))));
    let again = next_cut(&mut core, 500 * MS);
    let ViewHeader { view_index, worker, attempt, .. } = again.header;
    assert_eq!((view_index, worker, attempt), (1, 0, 1));
    core.on(published(&again), 500 * MS);
    assert!(core.frame((0, 0, 0)).is_some());
    core.on(answer(&again), 510 * MS);
    assert_eq!(core.step(510 * MS), Action::Wait(None), "the frame is released");
}

#[test]
fn a_frame_that_cannot_be_cut_ends_as_failed_and_the_next_goes_on() {
    let mut core = flying(2);
    core.on(plan(1, &[Roi, Roi], 0), 0);
    core.on(frame(0), 0);
    assert!(matches!(core.step(0), Action::TakeUp { .. }));
    core.on(Event::Failed((0, 0, 0)), 0);
    let (orders, ends) = run(&mut core, 0);
    assert!(orders.is_empty());
    assert_eq!((reason(&ends[0]), ends[0].views_issued), (StopReason::Failed, 0));
    core.on(frame(1), 0);
    let order = next_cut(&mut core, 0);
    core.on(Event::Failed(order.frame()), 0);
    assert!(matches!(core.step(0), Action::End(end) if reason(&end) == StopReason::Failed));
    core.on(frame(2), 0);
    assert_eq!(run(&mut core, 0).0.len(), 2);
}

#[test]
fn a_view_that_cannot_be_cut_again_releases_its_frame() {
    let mut core = flying(1);
    core.on(plan(1, &[Roi], 0), 0);
    core.on(frame(0), 0);
    let order = next_cut(&mut core, 0);
    core.on(published(&order), 0);
    assert!(matches!(core.step(0), Action::End(_)));
    // The worker is tried again after half of the time.
    assert!(matches!(core.step(500 * MS), Action::Wait(Some(_))));
    let again = next_cut(&mut core, 750 * MS);
    assert_eq!(again.header.attempt, 1);
    core.on(Event::Failed(again.frame()), 750 * MS);
    assert_eq!(core.step(750 * MS), Action::Wait(None), "its end is out already");
    assert_eq!((core.outstanding(), core.frame(order.frame()).is_none()), (0, true));
}

#[test]
fn a_lossless_frame_is_cut_as_far_as_its_costs_allow_whatever_the_time() {
    let tiles = |late_ns: i64| {
        let costs = Costs {
            processors: 1.0,
            source_ms: 3.0,
            direct_pass_ms: 1.0,
            cut_ms_per_megapixel: 1.0,
            window_ms_per_megapixel: 2.0,
            ..Costs::default()
        };
        let clock = FrameClock::Virtual(VirtualBudget::new(costs, false));
        let mut core = core(Flow::Lossless, clock, 2);
        core.on(plan(1, &[&[Roi][..], &[Tile; 20][..]].concat(), 0), 0);
        let mut cut = Vec::new();
        for sequence in 0..3 {
            core.on(frame(sequence), late_ns * sequence as i64);
            let (views, ends) = run(&mut core, late_ns * sequence as i64);
            assert!(ends.iter().all(|end| reason(end) == StopReason::Budget), "{ends:?}");
            cut.push(views.len());
        }
        cut
    };
    // 33 ms less 3 for the source and 6 for the region; 5 ms for each tile.
    assert_eq!(tiles(0), [5, 5, 5]);
    assert_eq!(tiles(0), tiles(10_000 * MS));
}

/// A place that looks like a body, in a direction.
fn place(x: f64, y: f64) -> Proposal {
    let direction_in_camera = nalgebra::Unit::new_normalize(nalgebra::Vector3::new(x, y, 0.0));
    Proposal { direction_in_camera, side_rad: 0.02, score: 1.0 }
}

/// A core that is about to cut the first proposal of a frame, and has searched it for places.
fn looking() -> Core<()> {
    // Of three workers one is free for a proposal while the region is searched.
    let mut core = flying(3);
    core.on(plan(1, &[Roi, ViewKind::Proposal, ViewKind::Proposal], 0), 0);
    core.on(frame(0), 0);
    let region = next_cut(&mut core, 0);
    assert_eq!(region.header.view_index, 0);
    core.on(published(&region), 0);
    let looked = core.step(0);
    assert!(matches!(looked, Action::Look { frame: (0, 0, 0), .. }), "{looked:?}");
    core
}

#[test]
fn a_frame_is_searched_for_places_once_before_its_first_proposal() {
    let mut core = looking();
    let found = vec![place(1.0, 0.0), place(0.0, 1.0)];
    core.on(Event::Looked { frame: (0, 0, 0), found, took_ns: MS }, MS);
    // A frame that comes meanwhile does not undo what was decided.
    core.on(frame(1), MS);
    let first = next_cut(&mut core, MS);
    assert_eq!((first.header.view_index, first.ahead.len()), (1, 2), "the back end gets both");
    assert!(first.cut.view.direction_in_camera().x > 0.99);
    core.on(published(&first), MS);
    assert!(matches!(core.step(MS), Action::End(end) if reason(&end) == StopReason::Newer));
}

#[test]
fn a_search_for_places_that_fails_ends_its_frame() {
    let mut core = looking();
    core.on(Event::Failed((0, 0, 0)), MS);
    assert!(matches!(core.step(MS), Action::End(end) if reason(&end) == StopReason::Failed));
}

#[test]
fn silence_counts_from_the_last_frame_that_came() {
    let mut core = flying(1);
    assert_eq!(core.silence_ns(9), 9);
    core.on(frame(0), 10);
    assert_eq!(core.silence_ns(99), 0, "it waits");
    run(&mut core, 10);
    assert_eq!(core.silence_ns(30), 20);
}

#[test]
fn open_frames_are_ended_when_the_stage_stops() {
    let mut core = flying(1);
    core.on(frame(4), 0);
    assert!(matches!(core.step(0), Action::TakeUp { .. }));
    let ends = core.shut_down(1);
    assert_eq!((ends.len(), ends[0].stamp.sequence), (1, 4));
    assert_eq!(reason(&ends[0]), StopReason::Shutdown);
    assert!(core.shut_down(1).is_empty());
}
