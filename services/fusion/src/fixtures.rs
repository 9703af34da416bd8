//! Fixtures of fusion's tests: bodies, poses, records, and trackers with measurements.

#![allow(clippy::unwrap_used, clippy::expect_used, missing_docs, reason = "of the drawings")]

use std::sync::Arc;

use flockeye_geometry::body::{Bodies, Body};
use flockeye_geometry::filter::{MotionModel, TrackPolicy};
use flockeye_geometry::partition::Partition;
use flockeye_geometry::search::{Plan, PlanOrder, Planner, RoiOptions};
use flockeye_imaging::align::Picture;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use crate::aligner::{Aligner, BestView};
use crate::drawn_body::{draw, prints};
use crate::measurement::PoseMeasurement;
use crate::planning::Planning;
use crate::record::Record;
use crate::tracker::Tracker;

pub(crate) use self::scene::*;

#[path = "../tests/scene/mod.rs"]
mod scene;

pub(crate) fn aligner(bodies: &Bodies) -> Aligner {
    let prints = prints();
    Aligner::new(bodies, |id| prints.get(&id), PIXELS_PER_RADIAN).unwrap()
}

pub(crate) fn tracker_of(bodies: Vec<Body>, threads: usize) -> Tracker {
    let bodies = Bodies::new("DICT_5X5_250".into(), bodies).unwrap();
    // Targets jump here from one frame to the next, farther than real ones do.
    let motion = MotionModel { acceleration: 1.5, ..MotionModel::default() };
    let policy = TrackPolicy { motion, confirm_hits: 3, ..TrackPolicy::default() };
    Tracker::new(&bodies, Some(policy), Arc::new(aligner(&bodies)), threads, None)
}

pub(crate) fn planner() -> Planner {
    let partition = Partition::icosahedron();
    let views = partition.views(0.1, PIXELS_PER_RADIAN).unwrap();
    let roi = RoiOptions::new(PIXELS_PER_RADIAN);
    Planner::new(PlanOrder::Roi, partition, views, roi).unwrap()
}

/// The first plan of a process.
pub(crate) fn plan() -> Plan {
    let planner = planner();
    Planning::new(&planner).next(&planner, 1, &tracker_of(vec![alpha()], 1)).plan
}

/// A pose in which the first marker of a body faces the camera, tilted by 0.7 radians.
pub(crate) fn facing(body: &Body, range_m: f64) -> Isometry3<f64> {
    let towards = Vector3::new(0.8, 0.5, 0.33).normalize();
    let turn = UnitQuaternion::rotation_between(&body.markers[0].normal(), &-towards).unwrap();
    let tilt = UnitQuaternion::from_euler_angles(0.0, 0.0, 0.7);
    Isometry3::from_parts(Translation3::from(towards * range_m), tilt * turn)
}

/// Gives `by` a view that shows alpha at `pose`.
pub(crate) fn with_view<T>(pose: &Isometry3<f64>, by: impl FnOnce(&BestView<'_>) -> T) -> T {
    with_view_of(&alpha(), pose, by)
}

/// Gives `by` a view that shows a body at `pose`.
pub(crate) fn with_view_of<T>(
    body: &Body,
    pose: &Isometry3<f64>,
    by: impl FnOnce(&BestView<'_>) -> T,
) -> T {
    let drawing = draw(body, pose, PIXELS_PER_RADIAN, 0.9, 0.004);
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
    let (image, view) = (drawing.image(), drawing.view);
    let picture = Picture::still(image, view, &light, PIXELS_PER_RADIAN);
    by(&BestView { picture, view_index: 0, rays_m: f64::INFINITY })
}

/// Position error of a pose, metres.
pub(crate) fn error_m(found: &Isometry3<f64>, truth: &Isometry3<f64>) -> f64 {
    (found.translation.vector - truth.translation.vector).norm()
}
