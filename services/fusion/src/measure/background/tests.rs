//! Which background pass runs, waits or is refused.

#![allow(clippy::unwrap_used, clippy::expect_used)]
use super::*;
use crate::fixtures::alpha;
use crate::track_prior::TrackPrior;
use flockeye_geometry::pose::PoseEstimate;
use flockeye_imaging::light::{CodeRange, TransferCurve};
use nalgebra::{Matrix6, Vector3};

/// Requests passes over an empty picture, for a tracked target or an untracked one.
fn with_requests(
    by: impl FnOnce(&mut BackgroundQueue, &dyn Fn(&mut BackgroundQueue, usize, bool) -> bool),
) {
    let body = alpha();
    let (pixels, light) =
        ([128; 64 * 64], LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap());
    let image = LumaImage::new(&pixels, 64, 64, 64).unwrap();
    let view = View::looking_at(&Vector3::x_axis(), 0.5, 64);
    let picture = Picture::still(image, view, &light, 611.0);
    let camera_from_markers = Isometry3::translation(1.0, 0.0, 0.0);
    let covariance = Matrix6::identity();
    let request = |queue: &mut BackgroundQueue, target: usize, is_tracked: bool| {
        let prior = match is_tracked {
            true => TrackPrior::Confirmed(PoseEstimate { camera_from_markers, covariance }),
            false => TrackPrior::Untracked,
        };
        let begun = Trial::of(Pass::Complete, &prior, TimeBudget::OneFrame);
        let view = BestView { picture, view_index: 0, agreeing: 0, rays_m: f64::INFINITY };
        let inputs = PassInputs {
            target,
            body: &body,
            decoded: Vec::new(),
            candidates: Vec::new(),
            rays_m: f64::INFINITY,
            prior,
            best_view: Some(view),
            trial: Trial { is_deferred: true, ..begun },
            may_search: false,
            part: None,
        };
        queue.request(TIME, &inputs)
    };
    by(&mut BackgroundQueue::default(), &request);
}

const TIME: FrameTime = FrameTime { order: (0, 0, 0), at_s: 0.0, number: 0 };

/// Ends what is under way without having found anything.
fn finish(queue: &mut BackgroundQueue) {
    queue.take_job().expect("a job is under way");
    queue.finish();
}

fn under_way(queue: &BackgroundQueue) -> Option<(FrameTime, usize)> {
    queue.under_way.as_ref().map(|under_way| (under_way.time, under_way.target))
}

#[test]
fn passes_run_one_at_a_time_and_refused_targets_go_first() {
    with_requests(|queue, request| {
        let request = |queue: &mut BackgroundQueue, target| request(queue, target, true);
        assert!(request(queue, 0));
        assert!(!request(queue, 1) && !request(queue, 0), "one is under way");
        finish(queue);
        assert!(!request(queue, 0), "1 goes first");
        assert!(request(queue, 1));
        finish(queue);
        assert!(request(queue, 1), "nobody else asked");
        assert!(!request(queue, 0));
        finish(queue);
        assert!(!request(queue, 1));
        assert!(request(queue, 1), "0 was left the place once and did not take it");
    });
}

#[test]
fn an_untracked_target_queues_behind_a_tracked_one() {
    with_requests(|queue, request| {
        assert!(request(queue, 0, true));
        assert!(request(queue, 1, false), "there is a place for one");
        assert!(!request(queue, 2, false) && !request(queue, 3, true));
        finish(queue);
        assert_eq!(under_way(queue), Some((TIME, 1)));
        finish(queue);
        // Untracked targets do not queue behind each other: a tracked one would never get a turn.
        assert!(request(queue, 2, false));
        assert!(!request(queue, 1, false) && !request(queue, 3, true));
        finish(queue);
        // Another frame measured it before its turn came.
        assert!(request(queue, 3, true));
        assert!(request(queue, 1, false));
        queue.cancel((0, 0, 1), 1);
        finish(queue);
        assert_eq!(under_way(queue), None);
    });
}

#[test]
fn a_newer_frame_takes_the_place_of_the_one_that_waits() {
    with_requests(|queue, request| {
        assert!(request(queue, 0, true) && request(queue, 1, false));
        queue.waiting.as_mut().expect("it waits").time.at_s = -1.0;
        assert!(request(queue, 1, false), "a newer frame");
        finish(queue);
        assert_eq!(under_way(queue), Some((TIME, 1)));
    });
}

#[test]
fn the_answer_of_a_cancelled_pass_is_dropped() {
    with_requests(|queue, request| {
        assert!(request(queue, 0, true));
        queue.take_job().expect("a job");
        assert!(queue.take_job().is_none(), "a job is run once");
        queue.cancel((0, 0, 0), 0);
        assert_eq!(queue.awaited(), None);
        assert!(queue.finish().is_some_and(|finished| finished.is_cancelled));
        assert!(request(queue, 0, true));
        queue.take_job().expect("a job");
        queue.cancel((0, 0, 7), 0);
        let finished = queue.finish().expect("it was under way");
        assert!(!finished.is_cancelled, "it was measured in another frame");
    });
}
