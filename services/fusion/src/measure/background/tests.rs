//! Which background pass runs, and which is refused.

#![allow(clippy::unwrap_used, clippy::expect_used)]
use super::*;
use crate::fixtures::alpha;
use crate::track_prior::TrackPrior;
use flockeye_geometry::pose::PoseEstimate;
use flockeye_imaging::light::{CodeRange, TransferCurve};
use nalgebra::{Matrix6, Vector3};

/// Requests passes over an empty picture, for tracked targets.
fn with_requests(
    by: impl FnOnce(&mut BackgroundSlot, &dyn Fn(&mut BackgroundSlot, usize) -> bool),
) {
    let body = alpha();
    let (pixels, light) =
        ([128; 64 * 64], LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap());
    let image = LumaImage::new(&pixels, 64, 64, 64).unwrap();
    let view = View::looking_at(&Vector3::x_axis(), 0.5, 64);
    let picture = Picture::still(image, view, &light, 611.0);
    let camera_from_markers = Isometry3::translation(1.0, 0.0, 0.0);
    let covariance = Matrix6::identity();
    let request = |slot: &mut BackgroundSlot, target: usize| {
        let prior = TrackPrior::Confirmed(PoseEstimate { camera_from_markers, covariance });
        let begun = Trial::of(Pass::Complete, &prior, TimeBudget::OneFrame);
        let view = BestView { picture, view_index: 0, rays_m: f64::INFINITY };
        let inputs = PassInputs {
            target,
            body: &body,
            decoded: Vec::new(),
            rays_m: f64::INFINITY,
            prior,
            best_view: Some(view),
            trial: Trial { is_deferred: true, ..begun },
            part: None,
        };
        slot.request(TIME, &inputs)
    };
    by(&mut BackgroundSlot::default(), &request);
}

const TIME: FrameTime = FrameTime { order: (0, 0, 0), at_s: 0.0 };

/// Ends what is under way without having found anything.
fn finish(slot: &mut BackgroundSlot) {
    slot.take_job().expect("a job is under way");
    slot.finish();
}

#[test]
fn passes_run_one_at_a_time_and_refused_targets_go_first() {
    with_requests(|slot, request| {
        assert!(request(slot, 0));
        assert!(!request(slot, 1) && !request(slot, 0), "one is under way");
        finish(slot);
        assert!(!request(slot, 0), "1 goes first");
        assert!(request(slot, 1));
        finish(slot);
        assert!(request(slot, 1), "nobody else asked");
        assert!(!request(slot, 0));
        finish(slot);
        assert!(!request(slot, 1));
        assert!(request(slot, 1), "0 was left the place once and did not take it");
    });
}

#[test]
fn the_answer_of_a_cancelled_pass_is_dropped() {
    with_requests(|slot, request| {
        assert!(request(slot, 0));
        slot.take_job().expect("a job");
        assert!(slot.take_job().is_none(), "a job is run once");
        slot.cancel((0, 0, 0), 0);
        assert_eq!(slot.awaited(), None);
        assert!(slot.finish().is_some_and(|finished| finished.is_cancelled));
        assert!(request(slot, 0));
        slot.take_job().expect("a job");
        slot.cancel((0, 0, 7), 0);
        let finished = slot.finish().expect("it was under way");
        assert!(!finished.is_cancelled, "it was measured in another frame");
    });
}
