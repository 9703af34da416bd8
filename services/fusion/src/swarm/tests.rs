//! What is said of frames whose parts come late, early, and in another order.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "of the drawings")]

use super::trust::DOUBTED_FRAMES;
use super::*;
use crate::drawn_body::{Drawing, draw, prints};
use crate::neighbour::PoseEstimate;
use crate::sighting::{MeasuredBy, Sighting};
use flockeye_contract::{DetectedMarker, DetectionHeader, FrameEnd, FrameStamp};
use flockeye_geometry::body::{Body, squares};
use flockeye_geometry::filter::{MotionModel, TrackState};
use flockeye_geometry::partition::Partition;
use flockeye_geometry::search::{GazeOptions, SearchMode};
use flockeye_imaging::align::Picture;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::{Point3, Translation3, UnitQuaternion};

const PIXELS_PER_RADIAN: f64 = 611.0;
const INTERVAL_S: f64 = 1.0 / 30.0;

fn alpha() -> Body {
    squares("alpha", 0.0625, 0.05, 0)
}

fn pose(turn: f64) -> Isometry3<f64> {
    Isometry3::from_parts(
        Translation3::new(0.7, 0.5, 0.3),
        UnitQuaternion::from_euler_angles(0.3, -0.2, turn),
    )
}

fn swarm() -> Swarm {
    swarm_of(vec![alpha()])
}

fn swarm_of(bodies: Vec<Body>) -> Swarm {
    let bodies = Bodies::new("DICT_5X5_250".into(), bodies).unwrap();
    let prints = prints();
    let aligner = Aligner::new(&bodies, |id| prints.get(&id), PIXELS_PER_RADIAN).unwrap();
    let partition = Partition::icosahedron();
    let views = partition.views(0.1, PIXELS_PER_RADIAN).unwrap();
    let gaze = GazeOptions::new(PIXELS_PER_RADIAN);
    let planner = Planner::new(SearchMode::Gaze, partition, views, gaze).unwrap();
    // Neighbours jump here from one frame to the next, by more than the usual ones do.
    let motion = MotionModel { acceleration: 1.5, ..MotionModel::default() };
    let filter = FilterChoice::Tracks(TrackPolicy { motion, ..TrackPolicy::default() });
    Swarm::new(&bodies, filter, planner, aligner, 1)
}

fn stamp(sequence: u64) -> FrameStamp {
    FrameStamp { sequence, ..FrameStamp::default() }
}

fn at_s(sequence: u64) -> f64 {
    10.0 + sequence as f64 * INTERVAL_S
}

/// What detection says of a gaze view of a body at `pose`.
fn record(sequence: u64, pose: &Isometry3<f64>) -> Record {
    let body = alpha();
    let eye = pose.inverse_transform_point(&Point3::origin());
    let facing = body
        .markers
        .iter()
        .filter(|marker| marker.normal().dot(&(eye - marker.centre()).normalize()) > 0.5);
    let markers = facing.map(|marker| DetectedMarker {
        rays_in_camera: marker.corners.map(|corner| (pose * corner).coords.normalize().into()),
        deviations: [2e-4; 4],
        id: marker.id,
        ..DetectedMarker::default()
    });
    let header = DetectionHeader { stamp: stamp(sequence), ..DetectionHeader::default() };
    Record { header, markers: markers.collect() }
}

/// What detection says of a view in which it found no marker.
fn nothing(sequence: u64) -> Record {
    let header = DetectionHeader { stamp: stamp(sequence), ..DetectionHeader::default() };
    Record { header, markers: Vec::new() }
}

fn glance(swarm: &mut Swarm, sequence: u64, pose: &Isometry3<f64>) -> Vec<Update> {
    let record = record(sequence, pose);
    let seen = Seen { record: &record, purpose: Some(Purpose::Gaze(0)), view: None };
    swarm.glance(stamp(sequence).order(), at_s(sequence), &[seen], &BestViews::new())
}

/// Ends a frame of which nothing more is known.
fn finish(swarm: &mut Swarm, sequence: u64) -> Vec<Update> {
    let end = FrameEnd { stamp: stamp(sequence), ..FrameEnd::default() };
    let mut assembly = crate::assembly::Assembly::new(1_000);
    assembly.add_end(end, 0);
    let (frame, _) = assembly.take(0).expect("it has no views to wait for");
    swarm.finish(at_s(sequence), &frame, &Purposes::new(), StopRule::Deadline, &BestViews::new())
}

/// A swarm that has seen its neighbour in frames 0 to 2.
fn following(pose: &Isometry3<f64>) -> Swarm {
    let mut swarm = swarm();
    for sequence in 0..3 {
        assert_eq!(glance(&mut swarm, sequence, pose).len(), 1);
        assert!(finish(&mut swarm, sequence).is_empty(), "it was said already");
    }
    swarm
}

fn with_view<T>(pose: &Isometry3<f64>, by: impl FnOnce(&BestView<'_>) -> T) -> T {
    let drawing: Drawing = draw(&alpha(), pose, PIXELS_PER_RADIAN, 0.9, 0.004);
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
    let (image, view) = (drawing.image(), drawing.view);
    let picture = Picture { image, view, light: &light, pixels_per_radian: PIXELS_PER_RADIAN };
    by(&BestView { picture, view_index: 0, rays_m: f64::INFINITY })
}

fn peek(swarm: &mut Swarm, sequence: u64, view: &BestView<'_>) -> Option<Update> {
    let glimpse = Glimpse { target: 0, view: *view };
    swarm.peek(stamp(sequence).order(), at_s(sequence), &[glimpse]).pop()
}

#[test]
fn a_frame_need_not_wait_for_the_one_before() {
    let truth = pose(0.9);
    let mut swarm = following(&truth);
    // Frame 4 is searched while frame 3 waits for a partition, in which nothing is found.
    let updates = glance(&mut swarm, 4, &truth);
    assert!(updates[0].1.measured.is_some());
    let late = finish(&mut swarm, 3);
    assert_eq!(late.len(), 1);
    assert!(late[0].1.measured.is_none(), "frame 3 did not show it");
    assert_eq!(swarm.neighbours[0].predict(at_s(5)).map(|p| p.stamp_s), Some(at_s(5)));
    assert!(swarm.neighbours[0].is_measured(), "frame 4 did");
    assert!(finish(&mut swarm, 4).is_empty(), "it was said already");
    assert!(swarm.looked.is_empty(), "nothing is kept of frames that ended");
}

#[test]
fn a_late_frame_is_put_where_it_belongs() {
    let truth = pose(0.9);
    let mut swarm = following(&truth);
    assert_eq!(glance(&mut swarm, 4, &truth).len(), 1);
    let late = glance(&mut swarm, 3, &truth);
    assert!(late[0].1.measured.is_some());
    assert_eq!(late[0].1.state, Some(TrackState::Confirmed));
}

#[test]
fn a_confirmed_neighbour_is_measured_before_its_view_is_searched() {
    let truth = pose(0.9);
    let mut swarm = following(&truth);
    with_view(&truth, |view| {
        let (target, known) = peek(&mut swarm, 3, view).expect("it is there");
        let (measured, by) = known.measured.expect("it is measured");
        assert_eq!((target, by, known.markers), (0, MeasuredBy::Aligned, 0));
        let error = measured.camera_from_markers.translation.vector - truth.translation.vector;
        assert!(error.norm() < 2e-3, "{} m", error.norm());
        // Its view in this frame need not be held any more, that in the next one is.
        let header = flockeye_contract::ViewHeader::default();
        let shown = [3, 4].map(|sequence| {
            let record = record(sequence, &truth);
            swarm.shown(&record, Some(Purpose::Gaze(0)), Some(&header), StopRule::Deadline).len()
        });
        assert_eq!(shown, [0, 1]);
        // The markers that are found later agree, and there is nothing to add.
        assert!(glance(&mut swarm, 3, &truth).is_empty());
        assert!(peek(&mut swarm, 3, view).is_none(), "once is enough");
        assert!(!swarm.needs_no_markers(0), "frame 3 has not ended");
        assert!(finish(&mut swarm, 3).is_empty());
        assert!(swarm.needs_no_markers(0));
        assert!(peek(&mut swarm, 4, view).is_some());
        // Not seen at once in frame 5, and so searched for.
        finish(&mut swarm, 4);
        finish(&mut swarm, 5);
        assert!(!swarm.needs_no_markers(0));
    });
}

#[test]
fn what_led_nowhere_is_aligned_again_only_with_something_new() {
    let truth = pose(0.9);
    let mut swarm = following(&truth);
    finish(&mut swarm, 3);
    let nothing = nothing(4);
    let seen = vec![Seen { record: &nothing, purpose: Some(Purpose::Gaze(0)), view: None }];
    let mut settle = |view: BestView<'_>| {
        let (looks, best_views) = ([(0, seen.clone())], BestViews::from([(0, view)]));
        swarm.settle(stamp(4).order(), at_s(4), &looks, &best_views, 1).len()
    };
    with_view(&pose(2.4), |elsewhere| assert_eq!(settle(*elsewhere), 0));
    with_view(&truth, |view| {
        // It would be found, were it looked at.
        assert_eq!(settle(*view), 0);
        assert_eq!(settle(BestView { view_index: 1, ..*view }), 1);
    });
}

#[test]
fn what_a_peek_led_to_is_not_aligned_again() {
    let truth = pose(0.9);
    let mut swarm = following(&truth);
    let nothing = nothing(3);
    let seen = [Seen { record: &nothing, purpose: Some(Purpose::Gaze(0)), view: None }];
    with_view(&pose(2.4), |elsewhere| assert!(peek(&mut swarm, 3, elsewhere).is_none()));
    let looks = |swarm: &Swarm, view: &BestView<'_>| {
        let best_views = BestViews::from([(0, *view)]);
        let mut look = swarm.look(at_s(3), 0, &seen, &best_views, 1).expect("it was predicted");
        (look.pace, look.has_second) = (Pace::Live, true);
        look.peek = swarm.looked.get(&stamp(3).order()).and_then(|looked| looked.peeks.get(&0));
        look.measure(&swarm.aligner).is_some()
    };
    with_view(&truth, |view| {
        assert!(!looks(&swarm, view), "it would be found, were it looked at");
        assert!(looks(&swarm, &BestView { view_index: 1, ..*view }), "another view says more");
    });
}

#[test]
fn who_is_behind_does_not_search() {
    let truth = pose(0.9);
    let mut swarm = following(&truth);
    let record = record(3, &truth);
    let seen = [Seen { record: &record, purpose: Some(Purpose::Gaze(0)), view: None }];
    let look = |swarm: &Swarm| {
        let best_views = BestViews::new();
        let look = swarm.look(at_s(3), 0, &seen, &best_views, 1).expect("markers are seen");
        (look.pace, look.may_search)
    };
    assert_eq!(look(&swarm), (Pace::Unhurried, true), "frame 3 is one of those that search");
    swarm.hurry(Pace::Behind);
    assert_eq!(look(&swarm), (Pace::Behind, false));
    // Its markers tell its pose all the same.
    assert!(glance(&mut swarm, 3, &truth)[0].1.measured.is_some());
}

#[test]
fn what_is_being_searched_is_not_asked_for_again() {
    let mut swarm = following(&pose(0.9));
    let partition = |swarm: &Swarm| {
        let (plan, _) = swarm.plan();
        let mut purposes = plan.views.iter().map(|view| view.purpose);
        purposes.find(|purpose| matches!(purpose, Purpose::Partition(_))).expect("it is swept")
    };
    // The frame that is searched has not ended when the next plans are made.
    let mut asked = BTreeSet::new();
    for _ in 0..5 {
        let next = partition(&swarm);
        swarm.note_cut(next, Search::FineWindow);
        asked.insert(format!("{next:?}"));
    }
    assert_eq!(asked.len(), 5, "{asked:?}");
}

#[test]
fn who_is_not_confirmed_is_not_peeked_at() {
    let truth = pose(0.9);
    with_view(&truth, |view| {
        let mut swarm = swarm();
        assert!(peek(&mut swarm, 0, view).is_none(), "nobody knows it");
        assert_eq!(glance(&mut swarm, 0, &truth).len(), 1);
        assert!(peek(&mut swarm, 1, view).is_none(), "seen once");
        let mut swarm = following(&truth);
        finish(&mut swarm, 3);
        assert!(peek(&mut swarm, 4, view).is_none(), "it coasts");
    });
    // Nor is it believed to be where the picture does not show it.
    with_view(&pose(2.4), |view| assert!(peek(&mut following(&truth), 3, view).is_none()));
}

#[test]
fn markers_that_contradict_a_pose_are_waited_for_from_then_on() {
    let truth = pose(0.9);
    let mut swarm = following(&truth);
    with_view(&truth, |view| {
        assert!(peek(&mut swarm, 3, view).is_some());
        // A facet further round.
        glance(&mut swarm, 3, &pose(0.9 + std::f64::consts::FRAC_PI_4));
        finish(&mut swarm, 3);
        assert!(peek(&mut swarm, 4, view).is_none());
        for sequence in 4..4 + DOUBTED_FRAMES {
            glance(&mut swarm, sequence, &truth);
            finish(&mut swarm, sequence);
        }
        assert!(peek(&mut swarm, 4 + DOUBTED_FRAMES, view).is_some(), "and is forgiven");
    });
}

#[test]
fn peeks_at_several_neighbours_say_the_same_on_several_threads() {
    let bravo = squares("bravo", 0.0625, 0.05, 17);
    let (here, there) = (pose(0.9), Isometry3::translation(-1.0, 0.2, 0.0));
    let peeked = |threads| {
        let mut swarm = swarm_of(vec![alpha(), bravo.clone()]);
        swarm.threads = threads;
        for sequence in 0..3 {
            let order = stamp(sequence).order();
            for (target, pose) in [(0, here), (1, there)] {
                let certain = nalgebra::Matrix6::identity() * 1e-6;
                let pose = PoseEstimate { camera_from_markers: pose, covariance: certain };
                let sighting = Sighting { pose, measured_by: MeasuredBy::Decoded, markers: 2 };
                swarm.take_in(order, at_s(sequence), target, &sighting);
            }
        }
        // Where bravo should be its view shows nothing like it.
        with_view(&here, |view| {
            let glimpses = [0, 1].map(|target| Glimpse { target, view: *view });
            swarm.peek(stamp(3).order(), at_s(3), &glimpses)
        })
    };
    let alone = peeked(1);
    assert_eq!(alone.iter().map(|(target, _)| *target).collect::<Vec<_>>(), [0]);
    assert_eq!(peeked(2), alone);
    assert_eq!(peeked(7), alone);
}

mod second_looks;
