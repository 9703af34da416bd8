//! The truth about a frame, as the contract's messages.

use flockeye_contract::{BodyTruth, FrameStamp, TruthHeader};
use flockeye_convert::{pose, xyzw};
use flockeye_geometry::body::Body;
use nalgebra::Isometry3;

use crate::{FrameTruth, TargetTruth};

/// The truth message of a frame; `bodies` are the flying bodies.
pub(crate) fn truth_message(
    stamp: FrameStamp,
    truth: &FrameTruth,
    bodies: &[Body],
    observer_from_camera: &Isometry3<f64>,
) -> (TruthHeader, Vec<BodyTruth>) {
    let targets = truth.bodies.iter().zip(bodies);
    let bodies = targets.map(|(target, body)| body_truth(target, body, observer_from_camera));
    let header = TruthHeader {
        stamp,
        world_from_camera: xyzw(&truth.camera.world_from_camera),
        observer_yaw: truth.camera.yaw(),
        exposure_s: truth.exposure_s,
    };
    (header, bodies.collect())
}

fn body_truth(
    target: &TargetTruth,
    body: &Body,
    observer_from_camera: &Isometry3<f64>,
) -> BodyTruth {
    let camera_from_target = target.camera_from_markers * body.target_from_markers.inverse();
    BodyTruth {
        camera_from_markers: pose(&target.camera_from_markers),
        observer_from_target: pose(&(observer_from_camera * camera_from_target)),
        best_side_px: target.best_side_px,
        blur_px: target.blur_px,
        name: target.name.as_str().into(),
        target: target.target as u32,
        markers_visible_50: target.markers_visible_50,
        markers_visible_90: target.markers_visible_90,
        localisable: u32::from(target.localisable),
    }
}
