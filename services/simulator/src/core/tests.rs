//! Tests of the core with times and drawn frames, without a process.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use super::*;
use crate::WorldParameters;
use crate::schedule::Times;
use flockeye_config::Pipeline;
use flockeye_geometry::camera::Camera;

const MS: i64 = 1_000_000;

/// A core with these settings, and its world.
fn core(overrides: &[&str]) -> (Core, World) {
    let overrides: Vec<String> = overrides.iter().map(|text| (*text).to_owned()).collect();
    let pipeline = Pipeline::parse("", &overrides, "a test").unwrap();
    let resolved = Resolved::of(pipeline).unwrap();
    let camera = Camera::equirectangular(256, 128);
    let world = World::empty(WorldParameters { camera, ..Default::default() }).unwrap();
    (Core::new(&resolved, &world, None, 3), world)
}

fn truth(world: &mut World, frame: u64) -> FrameTruth {
    world.render(frame, &mut [0; 256 * 128], 256).unwrap()
}

/// A frame that is handed over at `handover_ns`, the next one 33 ms later.
fn drawn(world: &mut World, frame: u64, handover_ns: i64) -> DrawOutcome {
    let exposure_ns = handover_ns - 2 * MS;
    let times = Times { exposure_ns, handover_ns, next_ns: handover_ns + 33 * MS };
    let (luma, truth) = (Vec::new(), truth(world, frame));
    DrawOutcome::Frame(Box::new(DrawnFrame { luma, truth, times, skipped: 0, took_ns: MS }))
}

#[test]
fn a_lossless_run_draws_each_frame_once_and_ends() {
    let (mut core, _) = core(&["profile=repeat", "simulator.frames=2"]);
    assert!(matches!(core.step(0), Action::Draw(0)));
    assert!(matches!(core.step(0), Action::Draw(1)));
    assert!(matches!(core.step(0), Action::Finish));
    assert!(matches!(core.step(0), Action::Finish));
}

#[test]
fn a_frame_drawn_ahead_is_handed_over_at_its_time() {
    let (mut core, mut world) = core(&[]);
    assert!(matches!(core.step(0), Action::Await));
    assert_eq!(core.on(DrawOutcome::NotYet), 0);
    assert!(matches!(core.step(0), Action::Await));
    core.on(drawn(&mut world, 0, 50 * MS));
    assert!(matches!(core.step(39 * MS), Action::WaitUntil(at_ns) if at_ns == 40 * MS));
    assert!(matches!(core.step(40 * MS), Action::HandOver(drawn) if drawn.truth.frame == 0));
    assert!(matches!(core.step(40 * MS), Action::Await));
}

#[test]
fn a_frame_is_left_out_once_the_next_one_is_due() {
    let (mut core, mut world) = core(&[]);
    core.on(drawn(&mut world, 7, 50 * MS));
    assert!(matches!(core.step(83 * MS), Action::LeaveOut(drawn) if drawn.truth.frame == 7));
    core.on(drawn(&mut world, 8, 83 * MS));
    assert!(matches!(core.step(83 * MS), Action::HandOver(drawn) if drawn.truth.frame == 8));
}

#[test]
fn frames_left_out_at_the_end_count_once() {
    let (mut core, _) = core(&["simulator.frames=9"]);
    assert_eq!(core.last_frame, 8);
    assert_eq!(core.on(DrawOutcome::Over { skipped: 4 }), 4);
    assert!(matches!(core.step(0), Action::Finish));
    assert!(matches!(core.step(0), Action::Finish), "nothing is awaited any more");
}

#[test]
fn stamps_follow_the_stream_in_a_lossless_run_and_the_schedule_in_flight() {
    let (mut core, mut world) = core(&[]);
    let truth = truth(&mut world, 6);
    let stream_ns = (truth.time_s * 1e9).round() as i64;
    let lossless = core.messages(&truth, None, 5).frame.stamp;
    assert_eq!((lossless.exposure_ns, lossless.stream_ns), (stream_ns, stream_ns));
    let flown = core.messages(&truth, Some(77), 5);
    let stamp = flown.frame.stamp;
    assert_eq!((stamp.exposure_ns, stamp.stream_ns, stamp.published_ns), (77, stream_ns, 5));
    assert_eq!((stamp.sequence, stamp.source_generation), (6, 3));
    assert_eq!((flown.truth.0.stamp, flown.inertial), (stamp, None));
}

#[test]
fn samples_cover_each_exposure_and_come_once() {
    let (mut core, mut world) = core(&["inertial.source=sim"]);
    assert!(core.has_sensor());
    let mut samples = Vec::new();
    for frame in 0..3 {
        let truth = truth(&mut world, frame);
        let messages = core.messages(&truth, None, 9);
        let (header, taken) = messages.inertial.unwrap();
        assert_eq!((header.sent_ns, header.generation), (9, 3));
        let end_ns = messages.frame.stamp.exposure_ns + (truth.exposure_s * 0.5e9) as i64;
        assert!(taken.last().unwrap().at_ns <= end_ns);
        samples.extend(taken);
    }
    assert!(samples.windows(2).all(|pair| pair[1].at_ns - pair[0].at_ns == 5 * MS));
}
