//! What the core does with events, without any process.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "of the drawings")]

use super::*;
use crate::decide::{Decision, PoseIndex};
use crate::fixtures::*;
use crate::frame::frames::Keeping;
use crate::hypothesis::{Hypothesis, StartSource};
use crate::measure::background::BackgroundSlot;
use crate::output::Cause;
use crate::schedule::VirtualClock;
use flockeye_config::Costs;
use flockeye_contract::{DetectionHeader, ViewKind};
use flockeye_convert::RadianceCache;
use flockeye_geometry::filter::TrackState;
use flockeye_geometry::search::StopRule;

const DEADLINE_NS: i64 = 1_000_000_000;

fn core(schedule: Schedule) -> Core<Vec<u8>> {
    core_with(schedule, false)
}

fn core_with(schedule: Schedule, keeps_places: bool) -> Core<Vec<u8>> {
    let is_limited = !matches!(schedule, Schedule::Unlimited);
    let mut tracker = tracker_of(vec![alpha()], 1);
    if is_limited {
        tracker.background = Some(BackgroundSlot::default());
    }
    let lights = RadianceCache::new(None).unwrap();
    let keeping = Keeping {
        deadline_ns: DEADLINE_NS,
        max_unanswered: 4,
        max_best: 4,
        keeps_pixels: true,
        keeps_regions: schedule.has_direct_pass(),
        keeps_places,
    };
    Core::new(
        schedule,
        Frames::new(keeping, 1),
        PictureReader::new(lights, PIXELS_PER_RADIAN, None),
        tracker,
        planner(),
    )
}

fn virtual_clock(costs: Costs) -> Schedule {
    Schedule::Virtual(VirtualClock::new(costs))
}

/// All that a core has to say until it is idle.
fn drain(core: &mut Core<Vec<u8>>, now_ns: i64) -> Vec<Outputs> {
    let mut all = Vec::new();
    loop {
        let outputs = core.step(now_ns);
        if outputs.is_idle && outputs.notices.is_empty() {
            return all;
        }
        all.push(outputs);
        assert!(all.len() < 100, "it is never idle");
    }
}

/// View 0 of the plan `plan_id`: the region of alpha, which stands at `pose(0.9)`.
fn region(sequence: u64, plan_id: u64) -> Event<Vec<u8>> {
    Event::View(region_view(sequence, plan_id), shown().1.clone())
}

/// Its record, with alpha's markers at `pose(0.9)`.
fn searched(sequence: u64, plan_id: u64) -> Event<Vec<u8>> {
    searched_at(sequence, plan_id, &pose(0.9))
}

/// The same with alpha's markers at another pose.
fn searched_at(
    sequence: u64,
    plan_id: u64,
    camera_from_markers: &nalgebra::Isometry3<f64>,
) -> Event<Vec<u8>> {
    Event::Searched(region_record(sequence, plan_id, camera_from_markers))
}

fn frame_end(sequence: u64, plan_id: u64, views_issued: u32) -> Event<Vec<u8>> {
    Event::FrameEnd(region_end(sequence, plan_id, views_issued))
}

/// A core that has measured alpha in frames 0 to 2, and the number of its last plan.
fn tracking(schedule: Schedule) -> (Core<Vec<u8>>, u64) {
    let mut core = core(schedule);
    let mut plan_id = drain(&mut core, 0)[0].plan.as_ref().expect("the first plan").0.plan_id;
    for sequence in 0..3 {
        // A plan that this process did not make: the view itself says what it is.
        for event in [region(sequence, 0), searched(sequence, 0), frame_end(sequence, 0, 1)] {
            core.on(event, 0);
        }
        let said = drain(&mut core, 0);
        assert_eq!(poses(&said).len(), 1, "frame {sequence}");
        plan_id =
            said.iter().filter_map(|outputs| outputs.plan.as_ref()).next_back().unwrap().0.plan_id;
    }
    (core, plan_id)
}

#[test]
fn a_successor_goes_on_with_the_tracks() {
    let (old, _) = tracking(Schedule::Flight);
    let bytes = old.snapshot().to_bytes().unwrap();
    let mut successor = core(Schedule::Flight);
    assert_eq!(successor.resume(Snapshot::from_bytes(&bytes).unwrap()), ["alpha"]);
    assert_eq!(successor.snapshot(), old.snapshot(), "it could be handed on at once");
    let plan_id = drain(&mut successor, 0)[0].plan.as_ref().unwrap().0.plan_id;
    // What the old one has ended is not ended again.
    for event in [region(2, 0), frame_end(2, 0, 1)] {
        successor.on(event, 0);
    }
    assert!(drain(&mut successor, 2 * DEADLINE_NS).iter().all(|outputs| outputs.tracks.is_empty()));
    // It measures alpha before its markers are searched for, as part of the same track.
    successor.on(region(3, plan_id), 0);
    let said = drain(&mut successor, 0);
    assert_eq!(poses(&said), [0]);
    let (_, estimate) = &said[0].tracks[0].updates[0].0;
    assert_eq!((estimate.track_id, estimate.state), (1, Some(TrackState::Confirmed)));
    assert!((estimate.age_s - 3.0 * INTERVAL_S).abs() < 1e-9, "{} s", estimate.age_s);
}

#[test]
fn a_pose_that_has_left_does_not_leave_again_when_its_process_is_killed() {
    let (mut old, plan_id) = tracking(Schedule::Flight);
    old.on(region(3, plan_id), 0);
    assert_eq!(poses(&drain(&mut old, 0)), [0]);
    let mut successor = core(Schedule::Flight);
    successor.resume(old.snapshot());
    drain(&mut successor, 0);
    for event in [region(3, plan_id), searched(3, plan_id), frame_end(3, plan_id, 1)] {
        successor.on(event, 0);
    }
    let said = drain(&mut successor, 0);
    assert!(is_ended(&said));
    let updates = said.iter().flat_map(|outputs| &outputs.tracks).map(|track| track.updates.len());
    assert_eq!(updates.sum::<usize>(), 0);
}

/// Two frames are open, and the pose has left in both: in the older one first. However long ago
/// that was.
#[test]
fn poses_of_all_open_frames_leave_once() {
    let (mut old, plan_id) = tracking(Schedule::Flight);
    for sequence in [3, 4] {
        old.on(region(sequence, plan_id), 0);
        assert_eq!(poses(&drain(&mut old, 0)), [0], "frame {sequence}");
    }
    let snapshot = old.snapshot();
    for (snapshot, tracks) in [(snapshot.clone(), 1), (snapshot.without_tracks(), 0)] {
        let mut successor = core(Schedule::Flight);
        assert_eq!(successor.resume(snapshot).len(), tracks);
        drain(&mut successor, 0);
        for sequence in [3, 4] {
            for event in [
                region(sequence, plan_id),
                searched(sequence, plan_id),
                frame_end(sequence, plan_id, 1),
            ] {
                successor.on(event, 0);
            }
            let said = drain(&mut successor, 0);
            assert!(is_ended(&said), "frame {sequence}");
            assert!(poses(&said).is_empty(), "frame {sequence}, {tracks} tracks");
        }
    }
}

#[test]
fn the_next_track_of_a_lost_target_has_a_new_number_in_the_successor_too() {
    let (mut old, _) = tracking(Schedule::Flight);
    for sequence in 3..60 {
        old.on(frame_end(sequence, 0, 0), 0);
        drain(&mut old, 0);
    }
    assert!(!old.tracker().targets()[0].is_tracked(), "it was lost");
    let mut successor = core(Schedule::Flight);
    assert!(successor.resume(old.snapshot()).is_empty());
    drain(&mut successor, 0);
    for event in [region(60, 0), searched(60, 0)] {
        successor.on(event, 0);
    }
    let said = drain(&mut successor, 0);
    let mut updates =
        said.iter().flat_map(|outputs| &outputs.tracks).flat_map(|track| &track.updates);
    assert_eq!(updates.next().map(|((_, estimate), _)| estimate.track_id), Some(2));
}

#[test]
fn a_snapshot_of_another_fusion_is_refused_or_counts_as_far_as_it_fits() {
    let (old, _) = tracking(Schedule::Flight);
    let snapshot = old.snapshot();
    let bytes = snapshot.to_bytes().unwrap();
    let other_version = [&[9], &bytes[1..]].concat();
    let refused = Snapshot::from_bytes(&other_version).unwrap_err().to_string();
    assert_eq!(refused, "it has version 9; this program reads version 5");
    for cut in [0, 1, bytes.len() / 2, bytes.len() - 1] {
        assert!(Snapshot::from_bytes(&bytes[..cut]).is_err(), "{cut} bytes");
    }
    let mut other = snapshot.clone();
    other.targets[0].body = "zulu".to_owned();
    assert!(core(Schedule::Flight).resume(other).is_empty(), "this process does not know it");
    let mut other = snapshot;
    other.planning.interval_s = f64::NAN;
    let mut successor = core(Schedule::Flight);
    assert_eq!(successor.resume(other), ["alpha"]);
    assert_eq!(successor.snapshot().planning.frames, 0, "the search begins anew");
}

#[test]
fn what_cannot_be_true_is_refused_by_name_and_costs_nothing_else() {
    const NOW_NS: i64 = 10_100_000_000;
    let mut core = core(Schedule::Flight).guarded(1);
    let plan = drain(&mut core, NOW_NS)[0].plan.as_ref().expect("the first plan").0.clone();
    let (plan_id, planned) = (plan.plan_id, plan.plan.views.len() as u32);
    let refused = |core: &mut Core<Vec<u8>>, event| {
        core.on(event, NOW_NS);
        let said = drain(core, NOW_NS);
        let notices = said.iter().flat_map(|outputs| &outputs.notices);
        notices
            .filter_map(|notice| match notice {
                Notice::Refused(refusal) => Some(refusal.to_string()),
                _ => None,
            })
            .collect::<Vec<_>>()
            .join("; ")
    };
    let record = |change: &dyn Fn(&mut DetectionHeader)| {
        let Event::Searched(mut record) = searched(0, plan_id) else { unreachable!() };
        change(&mut record.header);
        Event::Searched(record)
    };
    assert_eq!(refused(&mut core, region(0, plan_id)), "");
    let of_no_frame = refused(&mut core, record(&|header| header.stamp.sequence = 1));
    assert_eq!(of_no_frame, "a record of frame 1, of which no view has been cut");
    let of_nobody = refused(&mut core, record(&|header| header.worker = 7));
    assert_eq!(of_nobody, "a record of worker 7; there are 1, counted from 0");
    let unplanned = refused(&mut core, record(&|header| header.view_index = planned));
    assert!(unplanned.ends_with("does not have"), "{unplanned}");
    let of_later = refused(&mut core, record(&|header| header.stamp.sequence = u64::MAX));
    assert!(of_later.starts_with("a record of frame 18446744073709551615"), "{of_later}");
    let Event::FrameEnd(mut end) = frame_end(0, plan_id, 0) else { unreachable!() };
    end.stamp.sequence = u64::MAX;
    let far_off = refused(&mut core, Event::FrameEnd(end));
    assert_eq!(far_off, "frame 18446744073709551615 too soon after frame 0");
    let Event::View(mut view, pixels) = region(0, plan_id) else { unreachable!() };
    view.stamp.sequence = 1000;
    assert_eq!(refused(&mut core, Event::View(view, pixels)), "frame 1000 too soon after frame 0");
    let false_end = refused(&mut core, frame_end(0, plan_id, planned + 1));
    assert!(false_end.starts_with("the end of a frame with"), "{false_end}");
    // None of this has opened a frame, or ended one.
    for event in [record(&|_| {}), frame_end(0, plan_id, 1)] {
        core.on(event, NOW_NS);
    }
    let said = drain(&mut core, NOW_NS);
    assert_eq!(poses(&said), [0]);
    assert!(is_ended(&said));
}

/// The targets of all estimates with a measurement, in the order in which they leave.
fn poses(said: &[Outputs]) -> Vec<usize> {
    let messages = said.iter().flat_map(|outputs| &outputs.tracks);
    let updates = messages.flat_map(|message| &message.updates);
    updates
        .filter(|((_, known), _)| known.measured.is_some())
        .map(|((target, _), _)| *target)
        .collect()
}

fn is_ended(said: &[Outputs]) -> bool {
    said.iter().flat_map(|outputs| &outputs.tracks).any(|message| message.is_last)
}

#[test]
fn the_first_step_makes_the_first_plan() {
    let mut core = core(Schedule::Flight);
    let said = drain(&mut core, 0);
    let (plan, after) = said[0].plan.as_ref().expect("the first plan");
    assert_eq!((said.len(), plan.plan_id, *after), (1, 1, None));
    assert_eq!(plan.plan.stop_rule, StopRule::Deadline);
}

#[test]
fn a_tracked_target_leaves_when_its_region_has_been_cut() {
    let (mut core, plan_id) = tracking(Schedule::Flight);
    core.on(region(3, plan_id), 0);
    let said = drain(&mut core, 0);
    assert_eq!(poses(&said), [0]);
    assert!(matches!(said[0].tracks[0].updates[0].1, Cause::View { .. }));
    // Its markers and the frame's end add no second pose.
    core.on(searched(3, plan_id), 0);
    core.on(frame_end(3, plan_id, 1), 0);
    let said = drain(&mut core, 0);
    assert!(poses(&said).is_empty());
    assert!(is_ended(&said));
    let last = said.last().unwrap();
    assert!(last.tracks.last().unwrap().is_last && last.plan.is_some());
}

#[test]
fn an_untracked_target_leaves_when_its_region_has_been_searched() {
    let mut core = core(Schedule::Flight);
    drain(&mut core, 0);
    core.on(region(0, 0), 0);
    assert!(poses(&drain(&mut core, 0)).is_empty(), "nothing predicts it");
    core.on(searched(0, 0), 0);
    let said = drain(&mut core, 0);
    assert_eq!(poses(&said), [0]);
    assert!(!is_ended(&said), "the frame is still open");
    assert!(matches!(said[0].tracks[0].updates[0].1, Cause::Record { .. }));
}

#[test]
fn where_order_must_not_count_nothing_leaves_before_the_frame_is_complete() {
    for schedule in [Schedule::Unlimited, virtual_clock(Costs::default())] {
        let (mut core, plan_id) = tracking(schedule);
        for event in [region(3, plan_id), searched(3, plan_id)] {
            core.on(event, 0);
            assert!(poses(&drain(&mut core, 0)).is_empty());
        }
        core.on(frame_end(3, plan_id, 1), 0);
        let said = drain(&mut core, 0);
        assert_eq!(poses(&said), [0]);
        assert!(is_ended(&said));
    }
}

#[test]
fn a_frame_whose_record_never_comes_ends_at_its_deadline() {
    let (mut core, plan_id) = tracking(Schedule::Flight);
    core.on(frame_end(3, plan_id, 1), 5);
    assert!(drain(&mut core, 5).is_empty());
    assert_eq!(core.frames.next_deadline_ns(), Some(5 + DEADLINE_NS));
    let said = drain(&mut core, 5 + DEADLINE_NS);
    assert!(is_ended(&said));
    assert!(said[0].notices.contains(&Notice::Incomplete { sequence: 3 }));
    // A record that comes later is counted, and says nothing.
    core.on(searched(3, plan_id), 6 + DEADLINE_NS);
    let said = drain(&mut core, 6 + DEADLINE_NS);
    assert!(poses(&said).is_empty());
    assert!(said.iter().any(|outputs| outputs.notices.contains(&Notice::LateRecord)));
}

#[test]
fn markers_whose_rays_disagree_with_their_corners_are_left_out() {
    let mut core = core(Schedule::Flight);
    drain(&mut core, 0);
    core.on(region(0, 0), 0);
    let Event::Searched(mut record) = searched(0, 0) else { unreachable!() };
    record.markers[0].rays_in_camera.swap(0, 2);
    let marker = record.markers[0].id;
    core.on(Event::Searched(record), 0);
    let said = drain(&mut core, 0);
    assert!(said[0].notices.contains(&Notice::RaysDisagree { worker: 0, marker }));
    assert!(poses(&said).is_empty());
}

/// Another drone with the same ids flies 40 degrees beside alpha.
#[test]
fn a_second_body_with_the_same_markers_is_noticed_and_not_averaged() {
    let turn = nalgebra::UnitQuaternion::from_euler_angles(0.0, 0.0, 0.7);
    let twin = turn * pose(0.9);
    let mut core = core(Schedule::Unlimited);
    drain(&mut core, 0);
    core.on(region(0, 0), 0);
    core.on(searched(0, 0), 0);
    let beside = region_record(0, 0, &pose(0.9));
    let header = DetectionHeader { view_index: 1, ..beside.header };
    let markers = record(0, &twin).markers;
    core.on(Event::Searched(Record { header, markers }), 0);
    core.on(frame_end(0, 0, 2), 0);
    let said = drain(&mut core, 0);
    let notices = said.iter().flat_map(|outputs| &outputs.notices);
    let twice = |notice: &&Notice| matches!(notice, Notice::SeenTwice { .. });
    assert_eq!(notices.filter(twice).count(), 1);
    let tracker = core.tracker();
    let found = tracker.prediction(0, at_s(0)).map(|found| found.camera_from_markers);
    let nearest = |found| [pose(0.9), twin].map(|one| error_m(&found, &one)).map(|m| m < 0.02);
    let found = found.expect("one of them is followed");
    assert!(nearest(found).contains(&true), "{found:?}");
}

#[test]
fn a_marker_of_no_body_is_noticed_and_ignored() {
    let mut core = core(Schedule::Flight);
    drain(&mut core, 0);
    core.on(region(0, 0), 0);
    let Event::Searched(mut record) = searched(0, 0) else { unreachable!() };
    record.markers.iter_mut().for_each(|marker| marker.id += 100);
    let marker = record.markers[0].id;
    core.on(Event::Searched(record), 0);
    let said = drain(&mut core, 0);
    assert!(said[0].notices.contains(&Notice::UnknownMarker { marker }));
    assert!(poses(&said).is_empty());
}

/// A core that tracks alpha and has asked for a background pass in frame 4, which shows nothing.
/// The answer says that alpha was found all the same.
fn answered_in_background(schedule: Schedule) -> (Core<Vec<u8>>, Box<Trial>) {
    let (mut core, plan_id) = tracking(schedule);
    core.keep_account(0);
    core.on(frame_end(3, plan_id, 0), 0);
    drain(&mut core, 0);
    let empty = Record {
        header: DetectionHeader { stamp: stamp(4), plan_id: 0, ..DetectionHeader::default() },
        markers: Vec::new(),
    };
    let Event::View(header, mut pixels) = region(4, 0) else { unreachable!() };
    pixels.fill(128);
    core.on(Event::View(header, pixels), 0);
    core.on(Event::Searched(empty), 0);
    if !core.schedule.is_flight() {
        core.on(frame_end(4, 0, 1), 0);
    }
    let mut job = None;
    while job.is_none() {
        let outputs = core.step(0);
        assert!(!outputs.is_idle, "a background pass is asked for");
        job = outputs.job;
    }
    let bodies = flockeye_geometry::body::Bodies::new("DICT_5X5_250".into(), vec![alpha()]);
    let mut answer = job.unwrap().run(&aligner(&bodies.unwrap()));
    assert!(answer.measurement().is_none(), "the picture is grey");
    answer.hypotheses =
        vec![Hypothesis::of(StartSource::RoughPrediction, Ok(alignment(pose(0.9), 9.0, 1e-3)))];
    answer.decision = Decision { chosen: Some(PoseIndex::Hypothesis(0)), ..Decision::default() };
    (core, answer)
}

#[test]
fn a_background_pass_that_is_over_in_time_publishes() {
    let (mut core, answer) = answered_in_background(Schedule::Flight);
    assert!(core.awaits_background());
    core.on(Event::Background(answer), 0);
    let said = drain(&mut core, 0);
    assert_eq!(poses(&said), [0]);
    assert!(!core.awaits_background());
}

#[test]
fn by_a_virtual_clock_a_background_pass_publishes_if_its_cost_fits_into_the_frame() {
    for (background_pass_ms, expected) in [(20.0, vec![0]), (50.0, vec![])] {
        let costs = Costs { background_pass_ms, ..Costs::default() };
        let (mut core, answer) = answered_in_background(virtual_clock(costs));
        core.on(Event::Background(answer), 0);
        let said = drain(&mut core, 0);
        assert_eq!(poses(&said), expected, "{background_pass_ms} ms of a frame's 33");
        assert!(is_ended(&said));
    }
}

mod accounts;
mod places;
