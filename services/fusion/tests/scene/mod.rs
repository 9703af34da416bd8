//! Frames that tests make up: bodies, poses, records and views. Tests of `flockeye-replay` use them
//! too.

#![allow(clippy::unwrap_used, clippy::expect_used, missing_docs, reason = "of the drawings")]
#![allow(dead_code, reason = "neither crate uses all of it")]

use std::sync::OnceLock;

use flockeye_contract::{
    DetectedMarker, DetectionHeader, FrameEnd, FrameStamp, MeasuredBy, Transfer, ViewHeader,
    ViewKind,
};
use flockeye_geometry::body::{Body, squares};
use flockeye_geometry::pose::PoseEstimate;
use flockeye_geometry::view::View;
use flockeye_imaging::align::{Alignment, Evidence, is_precise};
use nalgebra::{Isometry3, Matrix6, Point3, Translation3, UnitQuaternion};

use super::{PoseMeasurement, Record};
use crate::drawn_body::{Drawing, draw};

pub(crate) const PIXELS_PER_RADIAN: f64 = 611.0;
pub(crate) const INTERVAL_S: f64 = 1.0 / 30.0;

pub(crate) fn alpha() -> Body {
    squares("alpha", 0.0625, 0.05, 0)
}

pub(crate) fn bravo() -> Body {
    squares("bravo", 0.0625, 0.05, 17)
}

/// `camera_from_markers`, turned by this angle in radians.
pub(crate) fn pose(turn: f64) -> Isometry3<f64> {
    Isometry3::from_parts(
        Translation3::new(0.7, 0.5, 0.3),
        UnitQuaternion::from_euler_angles(0.3, -0.2, turn),
    )
}

pub(crate) fn stamp(sequence: u64) -> FrameStamp {
    FrameStamp { sequence, exposure_ns: (at_s(sequence) * 1e9) as i64, ..FrameStamp::default() }
}

pub(crate) fn at_s(sequence: u64) -> f64 {
    10.0 + sequence as f64 * INTERVAL_S
}

/// The first of a body's markers that face the camera, at most `most` of them.
pub(crate) fn facing_markers(
    body: &Body,
    pose: &Isometry3<f64>,
    most: usize,
) -> Vec<DetectedMarker> {
    let eye = pose.inverse_transform_point(&Point3::origin());
    let facing = body
        .markers
        .iter()
        .filter(|marker| marker.normal().dot(&(eye - marker.centre()).normalize()) > 0.5);
    facing
        .take(most)
        .map(|marker| DetectedMarker {
            rays_in_camera: marker.corners.map(|corner| (pose * corner).coords.normalize().into()),
            deviations: [2e-4; 4],
            id: marker.id,
            ..DetectedMarker::default()
        })
        .collect()
}

/// What detection finds in a view of alpha at `pose`.
pub(crate) fn record(sequence: u64, pose: &Isometry3<f64>) -> Record {
    Record { markers: facing_markers(&alpha(), pose, usize::MAX), ..empty_record(sequence) }
}

/// A view in which no marker was found.
pub(crate) fn empty_record(sequence: u64) -> Record {
    let header = DetectionHeader { stamp: stamp(sequence), ..DetectionHeader::default() };
    Record { header, markers: Vec::new() }
}

/// Alpha at `pose(0.9)`. It is drawn once, because drawing takes longer than all else here.
pub(crate) fn shown() -> &'static (View, Vec<u8>) {
    static SHOWN: OnceLock<(View, Vec<u8>)> = OnceLock::new();
    SHOWN.get_or_init(|| {
        let drawing = drawing(&pose(0.9));
        let image = drawing.image();
        let pixels = (0..image.height()).flat_map(|y| image.row(y).to_vec()).collect();
        (drawing.view, pixels)
    })
}

/// View 0 of the plan `plan_id`: the region of alpha, as in [`shown`].
pub(crate) fn region_view(sequence: u64, plan_id: u64) -> ViewHeader {
    let (view, _) = shown();
    ViewHeader {
        stamp: stamp(sequence),
        plan_id,
        view_index: 0,
        kind: ViewKind::Roi.code(),
        target: 0,
        camera_from_view: view.camera_from_view.coords.into(),
        focal_px: view.focal_px,
        size_px: view.size_px,
        stride: view.size_px,
        transfer: Transfer::Srgb.code(),
        ..ViewHeader::default()
    }
}

/// Its record, with alpha's markers at a pose.
pub(crate) fn region_record(
    sequence: u64,
    plan_id: u64,
    camera_from_markers: &Isometry3<f64>,
) -> Record {
    let mut record = record(sequence, camera_from_markers);
    let view = shown().0;
    for marker in &mut record.markers {
        marker.corners_in_view = marker.rays_in_camera.map(|ray| {
            let ray = nalgebra::Unit::new_normalize(nalgebra::Vector3::from(ray));
            let pixel = view.project(&ray).expect("it is in the view").0;
            [pixel.x as f32, pixel.y as f32]
        });
    }
    let header = DetectionHeader { plan_id, hits: record.markers.len() as u32, ..record.header };
    Record { header, ..record }
}

/// The end of a frame in which so many views were cut.
pub(crate) fn region_end(sequence: u64, plan_id: u64, views_issued: u32) -> FrameEnd {
    FrameEnd { stamp: stamp(sequence), plan_id, views_issued, ..FrameEnd::default() }
}

/// What alignment has led to: a pose with these log odds, and this deviation along and about each
/// axis, metres and radians.
pub(crate) fn alignment(
    camera_from_markers: Isometry3<f64>,
    log_odds: f64,
    sigma: f64,
) -> Alignment {
    let covariance = Matrix6::from_diagonal_element(sigma * sigma);
    Alignment {
        camera_from_markers,
        covariance,
        is_precise: is_precise(&covariance),
        stretch_px2: None,
        evidence: Evidence { log_odds, ..Evidence::default() },
        visible_share: 1.0,
        response: None,
        stitch: None,
    }
}

/// A certain measurement.
pub(crate) fn measurement(camera_from_markers: &Isometry3<f64>) -> PoseMeasurement {
    let covariance = Matrix6::identity() * 1e-6;
    let pose = PoseEstimate { camera_from_markers: *camera_from_markers, covariance };
    PoseMeasurement {
        pose,
        rival: None,
        measured_by: MeasuredBy::Decoded,
        markers: 2,
        is_precise: true,
        is_proven: false,
        shown: None,
    }
}

/// A drawing of alpha at `pose`.
pub(crate) fn drawing(pose: &Isometry3<f64>) -> Drawing {
    draw(&alpha(), pose, PIXELS_PER_RADIAN, 0.9, 0.004)
}
