//! Rows for tests.

use flockeye_contract::{MeasuredBy, TrackState};
use flockeye_tables::{MeasuredPose, PoseRow, TruthRow};
use nalgebra::{Matrix6, UnitQuaternion, Vector3};

/// A pose of alpha, upright.
pub(crate) fn pose_at(frame: u64, position: Vector3<f64>, state: TrackState) -> PoseRow {
    let orientation = UnitQuaternion::identity();
    let is_measured = !matches!(state, TrackState::Coasting | TrackState::Lost);
    let covariance = Some(Matrix6::identity() * 1e-4);
    PoseRow {
        frame,
        stamp_s: frame as f64 / 30.0,
        target: "alpha".into(),
        position,
        orientation,
        state,
        markers: 2,
        measured_by: if is_measured { MeasuredBy::Decoded } else { MeasuredBy::Nothing },
        measured: is_measured.then_some(MeasuredPose { position, orientation, covariance }),
        covariance,
        predicted: None,
        latency_ms: frame as f64,
    }
}

/// The truth of alpha, upright, with three visible markers.
pub(crate) fn truth_at(frame: u64, position: Vector3<f64>) -> TruthRow {
    TruthRow {
        frame,
        t_s: frame as f64 / 30.0,
        body: "alpha".into(),
        x: position.x,
        y: position.y,
        z: position.z,
        qw: 1.0,
        qx: 0.0,
        qy: 0.0,
        qz: 0.0,
        dist_m: position.norm(),
        az_deg: 0.0,
        el_deg: 0.0,
        n_markers_vis50: 3,
        n_markers_vis90: 3,
        best_side_px: 20.0,
        blur_px: 0.0,
        env: "test".into(),
        observer_yaw_deg: 0.0,
        ev: 0.0,
        iso: 0,
        exposure_s: 0.0,
        localisable: 1,
        camera_qw: None,
        camera_qx: None,
        camera_qy: None,
        camera_qz: None,
    }
}
