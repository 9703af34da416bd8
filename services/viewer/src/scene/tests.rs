#![allow(clippy::unwrap_used, clippy::expect_used)]

use bytemuck::Zeroable;
use flockeye_contract::{NONE, Pose, StageState};

use super::*;

fn stamp(sequence: u64) -> FrameStamp {
    FrameStamp {
        sequence,
        exposure_ns: 1_000_000_000 + sequence as i64 * 33_000_000,
        ..FrameStamp::default()
    }
}

fn alpha(state: TrackState) -> Track {
    let mut covariance = [0.0; 36];
    (covariance[0], covariance[7], covariance[14], covariance[21]) = (1.0, 4.0, 9.0, 0.01);
    Track {
        name: "alpha".into(),
        state: state.code(),
        observer_from_target: Pose { position: [1.0, 2.0, 3.0], ..Pose::default() },
        covariance,
        latency: flockeye_contract::StageLatency { capture_ns: -1, ..Default::default() },
        ..Track::zeroed()
    }
}

fn ends(scene: &mut PageScene, sequence: u64, tracks: &[Track]) -> EndedFrame {
    let header = TrackHeader { stamp: stamp(sequence), is_last: 1, ..TrackHeader::default() };
    scene.tracks(&header, tracks, stamp(sequence).exposure_ns + 20_000_000).expect("it ends")
}

#[test]
fn a_frame_goes_out_whole_when_it_ends() {
    let mut scene = PageScene::new(true);
    let tile = PlannedView {
        tile: 3,
        target: NONE,
        focal_px: 100.0,
        size_px: 50,
        ..PlannedView::default()
    };
    let unsearched = PlannedView { tile: 4, ..tile };
    let turn = 0.4;
    let region = PlannedView {
        kind: ViewKind::Roi.code(),
        tile: NONE,
        target: 0,
        camera_from_view: [0.0, 0.0, 0.0, 1.0],
        rate_in_camera: [0.0, 0.0, turn / 0.033],
        reference_ns: stamp(0).exposure_ns,
        ..tile
    };
    let header = PlanHeader { plan_id: 9, ..PlanHeader::default() };
    scene.plan(&header, &[region, tile, unsearched, tile]);
    let marker = DetectedMarker { id: 5, ..DetectedMarker::default() };
    for view_index in [0, 1] {
        let record =
            DetectionHeader { stamp: stamp(1), plan_id: 9, view_index, ..Default::default() };
        scene.detection(&record, &[marker]);
    }
    let end = FrameEnd {
        stamp: stamp(1),
        plan_id: 9,
        views_issued: 3,
        views_abandoned: 1,
        ..Default::default()
    };
    scene.frame_end(&end);
    let early = TrackHeader { stamp: stamp(1), ..TrackHeader::default() };
    assert!(scene.tracks(&early, &[alpha(TrackState::Tentative)], 0).is_none(), "more may follow");
    let ended = ends(&mut scene, 1, &[alpha(TrackState::Confirmed)]);
    let shown = &ended.message;
    assert_eq!((shown.key.as_str(), shown.views, shown.age_ms), ("0.0.1", [3, 1], Some(20.0)));
    assert_eq!((&shown.partitions[..], shown.markers.len()), (&[3][..], 2));
    assert_eq!(shown.markers[0].id, 5);
    let [region] = &shown.regions[..] else { panic!("{shown:?}") };
    let wanted = (turn / 2.0).sin() as f32;
    assert!((region.view.q[2].abs() - wanted).abs() < 1e-6, "turned about z: {region:?}");
    assert!((region.view.half - 0.25).abs() < 1e-6);
    let [track] = &shown.tracks[..] else { panic!("{shown:?}") };
    assert_eq!((track.state, track.covariance), ("confirmed", [1.0, 0.0, 0.0, 4.0, 0.0, 9.0]));
    assert!((track.attitude_deg - 0.1f32.to_degrees()).abs() < 1e-4);
    assert_eq!(track.latency_ms[0], None);
    assert_eq!(ended.tracks.len(), 1);
}

#[test]
fn frames_that_never_ended_are_counted() {
    let mut scene = PageScene::new(false);
    assert_eq!(ends(&mut scene, 5, &[]).message.skipped, 0);
    assert_eq!(ends(&mut scene, 6, &[]).message.skipped, 0);
    let after = ends(&mut scene, 9, &[]).message;
    assert_eq!((after.skipped, after.age_ms), (2, None));
    let restarted = FrameStamp { epoch: 1, ..stamp(0) };
    let header = TrackHeader { stamp: restarted, is_last: 1, ..TrackHeader::default() };
    assert_eq!(scene.tracks(&header, &[], 0).expect("it ends").message.skipped, 2);
}

#[test]
fn what_never_ends_does_not_fill_the_memory() {
    let mut scene = PageScene::new(true);
    for sequence in 0..1000 {
        let record = DetectionHeader { stamp: stamp(sequence), ..Default::default() };
        for _ in 0..1000 {
            scene.detection(&record, &[DetectedMarker::default(); 8]);
        }
        scene.plan(&PlanHeader { plan_id: sequence, ..PlanHeader::default() }, &[]);
    }
    assert_eq!((scene.open.len(), scene.plans.len()), (OPEN_FRAMES, PLANS));
    assert!(scene.open.values().all(|frame| frame.markers.len() <= MOST_MARKERS));
    ends(&mut scene, 1000, &[]);
    assert!(scene.open.is_empty(), "they are older");
}

#[test]
fn the_swarm_is_shown_until_it_is_silent() {
    let mut scene = PageScene::new(true);
    assert_eq!(scene.swarm(0), None);
    let drone = SwarmPose {
        name: "bravo".into(),
        way: SwarmWay::Chained.code(),
        through: "alpha".into(),
        ..SwarmPose::zeroed()
    };
    scene.drones(&SwarmHeader { sent_ns: 1, ..SwarmHeader::default() }, &[drone]);
    let sighting = PeerSighting {
        observer: "alpha".into(),
        target: "bravo".into(),
        observer_from_target: Pose { position: [3.0, 4.0, 0.0], ..Pose::default() },
        ..PeerSighting::zeroed()
    };
    scene.sightings(&[sighting, sighting]);
    let (drones, sightings) = scene.swarm(2).expect("both are new");
    assert_eq!((drones[0].way, sightings.len()), ("chained", 1));
    assert_eq!(sightings[0].range_m, 5.0);
    assert_eq!(scene.swarm(2 + 2 * FORGOTTEN_NS), None);
}

fn health(sent_s: f64, taken: u64) -> Health {
    Health {
        stage: "fusion".into(),
        sent_ns: (sent_s * 1e9) as i64,
        taken,
        pid: 7,
        state: StageState::Ready.code(),
        latency_median_ns: 2_000_000,
        latency_p99_ns: 9_000_000,
        ..Health::default()
    }
}

#[test]
fn rates_follow_the_counters_and_silence_is_named() {
    let mut scene = PageScene::new(true);
    for step in 0..60 {
        scene.health(&health(f64::from(step) * 0.25, 10 * step as u64));
    }
    let now_ns = 15_000_000_000;
    let shown = scene.stages(now_ns);
    let [stage] = &shown[..] else { panic!("{shown:?}") };
    assert!((stage.taken_per_s - 40.0).abs() < 0.1, "{stage:?}");
    assert_eq!((stage.state, stage.latency_ms), ("ready", Some([2.0, 9.0])));
    assert_eq!(scene.stages(now_ns + 3_000_000_000)[0].state, "silent");
    assert!(scene.stages(now_ns + 30_000_000_000).is_empty(), "it is gone");
}

#[test]
fn inventions_do_not_fill_the_memory() {
    let mut scene = PageScene::new(true);
    for replica in 0..1000 {
        scene.health(&Health { replica, ..health(1.0, 0) });
    }
    assert_eq!(scene.stages(1_000_000_000).len(), MOST_PROCESSES);
}
