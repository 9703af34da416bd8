//! The contract's messages: what is read from them, and what fusion knows and plans, written as them.

use std::collections::BTreeMap;

use flockeye_contract as contract;
use flockeye_contract::{
    FrameStamp, MeasuredBy, NONE, Pose, Search, StageLatency, StopRule, Track, TrackState,
    ViewHeader, ViewKind,
};
use flockeye_geometry::body::Body;
use flockeye_geometry::filter::{self, Prediction};
use flockeye_geometry::search::{self, Plan, PlannedView, Purpose};
use flockeye_runtime::config::Flow;
use nalgebra::{Isometry3, Matrix3, Matrix6, Vector3};

use crate::assembly::Record;
use crate::neighbour::{Known, PoseEstimate};
use crate::sighting;

/// When a frame was exposed, seconds.
pub fn seconds(stamp: &FrameStamp) -> f64 {
    stamp.exposure_ns as f64 * 1e-9
}

/// What a view says it was cut for.
pub fn purpose_stated(view: &ViewHeader) -> Option<Purpose> {
    match ViewKind::try_from(view.kind).ok()? {
        ViewKind::Partition => Some(Purpose::Partition(view.tile as usize)),
        ViewKind::HighResolution => Some(Purpose::HighResolution(view.tile as usize)),
        ViewKind::Gaze => Some(Purpose::Gaze(view.target as usize)),
    }
}

/// How a view is searched. An unknown code, which no checked view has, counts as all windows.
pub fn search_stated(view: &ViewHeader) -> search::Search {
    match Search::try_from(view.search).unwrap_or(Search::AllWindows) {
        Search::AllWindows => search::Search::AllWindows,
        Search::FineWindow => search::Search::FineWindow,
        Search::CoarseWindow => search::Search::CoarseWindow,
        Search::Nothing => search::Search::Nothing,
    }
}

fn search_code(search: search::Search) -> Search {
    match search {
        search::Search::AllWindows => Search::AllWindows,
        search::Search::FineWindow => Search::FineWindow,
        search::Search::CoarseWindow => Search::CoarseWindow,
        search::Search::Nothing => Search::Nothing,
    }
}

/// A transform as the contract has it.
pub fn pose(isometry: &Isometry3<f64>) -> Pose {
    let [x, y, z, w] = isometry.rotation.coords.into();
    Pose { position: isometry.translation.vector.into(), orientation: [x, y, z, w] }
}

/// The pose of the target drone in the observer drone's frame, mounts applied, with its covariance.
///
/// A small rotation d of the markers moves the target's origin, which lies at r from theirs (both
/// in the camera's axes), by d x r; so the covariance turns with J = [I, -[r]x; 0, I], then both
/// with the camera's mount.
fn mounted(
    estimate: &PoseEstimate,
    body: &Body,
    observer_from_camera: &Isometry3<f64>,
) -> (Isometry3<f64>, Matrix6<f64>) {
    let markers_from_target = body.target_from_markers.inverse();
    let camera_from_target = estimate.camera_from_markers * markers_from_target;
    let offset = estimate.camera_from_markers.rotation * markers_from_target.translation.vector;
    let turn = observer_from_camera.rotation.to_rotation_matrix().into_inner();
    let mut jacobian = Matrix6::zeros();
    jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&turn);
    jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&(turn * -offset.cross_matrix()));
    jacobian.fixed_view_mut::<3, 3>(3, 3).copy_from(&turn);
    let covariance = jacobian * estimate.covariance * jacobian.transpose();
    (observer_from_camera * camera_from_target, covariance)
}

/// A neighbour as a track. `latency` is filled in where the message is sent.
pub fn track(
    target: usize,
    known: &Known,
    body: &Body,
    observer_from_camera: &Isometry3<f64>,
) -> Track {
    let (observer_from_target, covariance) = mounted(&known.pose, body, observer_from_camera);
    let measured =
        known.measured.map(|(measured, _)| mounted(&measured, body, observer_from_camera));
    let measured_by = match known.measured {
        None => MeasuredBy::Nothing,
        Some((_, sighting::MeasuredBy::Decoded)) => MeasuredBy::Decoded,
        Some((_, sighting::MeasuredBy::Aligned)) => MeasuredBy::Aligned,
    };
    let turn: Matrix3<f64> = observer_from_camera.rotation.to_rotation_matrix().into_inner();
    let offset = known.pose.camera_from_markers.rotation
        * body.target_from_markers.inverse().translation.vector;
    let velocity: Vector3<f64> = turn * (known.velocity + known.rate.cross(&offset));
    let state = match known.state {
        None => TrackState::Measured,
        Some(filter::TrackState::Tentative) if known.measured.is_none() => TrackState::Coasting,
        Some(filter::TrackState::Tentative) => TrackState::Tentative,
        Some(filter::TrackState::Confirmed) => TrackState::Confirmed,
        Some(filter::TrackState::Coasting) => TrackState::Coasting,
        Some(filter::TrackState::Lost) => TrackState::Lost,
    };
    Track {
        observer_from_target: pose(&observer_from_target),
        covariance: row_major(&covariance),
        linear_velocity: velocity.into(),
        angular_velocity: (turn * known.rate).into(),
        measured_observer_from_target: measured.map_or_else(Pose::default, |(at, _)| pose(&at)),
        measured_covariance: measured.map_or([0.0; 36], |(_, covariance)| row_major(&covariance)),
        age_ns: nanoseconds(known.age_s),
        unseen_ns: nanoseconds(known.unseen_s),
        latency: StageLatency::default(),
        name: body.name.as_str().into(),
        target: target as u32,
        track_id: known.track_id,
        state: state.code(),
        measured_by: measured_by.code(),
        markers: known.markers,
        reserved: 0,
    }
}

fn nanoseconds(seconds: f64) -> i64 {
    (seconds * 1e9).round() as i64
}

fn row_major(matrix: &Matrix6<f64>) -> [f64; 36] {
    // nalgebra keeps columns; a covariance is symmetric, but rounding need not be.
    std::array::from_fn(|k| matrix[(k / 6, k % 6)])
}

/// The views of a plan; regions of interest carry their neighbour's prediction. `needs_no_markers` says
/// of which neighbours' only the pixels are wanted.
pub fn planned_views(
    plan: &Plan,
    predictions: &BTreeMap<usize, Prediction>,
    reference_ns: i64,
    needs_no_markers: impl Fn(usize) -> bool,
) -> Vec<contract::PlannedView> {
    plan.views
        .iter()
        .take(contract::MAX_PLANNED_VIEWS)
        .map(|planned| {
            let search = match planned.purpose {
                Purpose::Gaze(target) if needs_no_markers(target) => Search::Nothing,
                _ => search_code(planned.search),
            };
            planned_view(planned, predictions, reference_ns, search)
        })
        .collect()
}

fn planned_view(
    planned: &PlannedView,
    predictions: &BTreeMap<usize, Prediction>,
    reference_ns: i64,
    search: Search,
) -> contract::PlannedView {
    let (kind, tile, target) = match planned.purpose {
        Purpose::Partition(tile) => (ViewKind::Partition, tile as u32, NONE),
        Purpose::HighResolution(tile) => (ViewKind::HighResolution, tile as u32, NONE),
        Purpose::Gaze(target) => (ViewKind::Gaze, NONE, target as u32),
    };
    let prediction = match planned.purpose {
        Purpose::Gaze(target) => predictions.get(&target),
        Purpose::Partition(_) | Purpose::HighResolution(_) => None,
    };
    contract::PlannedView {
        camera_from_view: planned.view.camera_from_view.coords.into(),
        rate_in_camera: planned.rate_in_camera.into(),
        reference_ns,
        focal_px: planned.view.focal_px,
        predicted_camera_from_markers: prediction
            .map_or_else(Pose::default, |prediction| pose(&prediction.observer_from_target)),
        size_px: planned.view.size_px,
        kind: kind.code(),
        tile,
        target,
        has_prediction: u32::from(prediction.is_some()),
        search: search.code(),
    }
}

/// The code of a stop rule.
pub fn stop_rule(rule: search::StopRule) -> StopRule {
    match rule {
        search::StopRule::FirstHit => StopRule::FirstHit,
        search::StopRule::All => StopRule::All,
        search::StopRule::Deadline => StopRule::Deadline,
    }
}

/// What led to tracks.
#[derive(Debug, Clone, Copy)]
pub enum Cause<'c> {
    /// A view alone.
    View(&'c ViewHeader),
    /// What was found in views: of each body, in those that show it.
    Records(&'c [&'c Record]),
}

/// How long each stage took with what led to a neighbour's track, published at `now_ns`.
pub fn latency(
    flow: Flow,
    stamp: &FrameStamp,
    cause: Cause<'_>,
    body: &Body,
    now_ns: i64,
) -> StageLatency {
    // In a lossless run the exposure has another clock.
    let (capture_ns, since_ns) = match flow {
        Flow::Latest => (stamp.published_ns - stamp.exposure_ns, stamp.exposure_ns),
        Flow::Lossless => (-1, stamp.published_ns),
    };
    let total_ns = now_ns - since_ns;
    let unknown = StageLatency {
        capture_ns,
        rectification_ns: -1,
        detection_ns: -1,
        fusion_ns: -1,
        total_ns,
    };
    match cause {
        Cause::View(view) => StageLatency {
            rectification_ns: view.issued_ns - stamp.published_ns,
            fusion_ns: now_ns - view.issued_ns,
            ..unknown
        },
        Cause::Records(records) => {
            let shows = |record: &&&Record| {
                let mut decoded = record.markers.iter().filter(|marker| marker.is_decoded());
                decoded.any(|marker| body.marker(marker.id).is_some())
            };
            let last = records.iter().filter(shows).max_by_key(|record| record.header.sent_ns);
            last.map_or(unknown, |Record { header, .. }| StageLatency {
                rectification_ns: header.issued_ns - stamp.published_ns,
                detection_ns: header.sent_ns - header.issued_ns,
                fusion_ns: now_ns - header.sent_ns,
                ..unknown
            })
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use flockeye_geometry::body::squares;
    use nalgebra::{Translation3, UnitQuaternion, Vector6};

    fn transform(x: f64, y: f64, z: f64, roll: f64, pitch: f64, yaw: f64) -> Isometry3<f64> {
        Isometry3::from_parts(
            Translation3::new(x, y, z),
            UnitQuaternion::from_euler_angles(roll, pitch, yaw),
        )
    }

    /// The covariance's Jacobian against differences of the transform itself.
    #[test]
    fn mounts_carry_the_covariance_along() {
        let mut body = squares("alpha", 0.0625, 0.05, 0);
        body.target_from_markers = transform(0.1, -0.2, 0.3, 0.3, 0.2, 0.1);
        let observer_from_camera = transform(1.0, 2.0, 3.0, -0.4, 0.5, 0.6);
        let at = transform(0.5, 0.6, -0.7, 1.0, -0.3, 2.0);
        let moved = |change: &Vector6<f64>| {
            let rotation = UnitQuaternion::from_scaled_axis(change.fixed_rows::<3>(3).into_owned());
            let moved = Isometry3::from_parts(
                Translation3::from(at.translation.vector + change.fixed_rows::<3>(0)),
                rotation * at.rotation,
            );
            let estimate =
                PoseEstimate { camera_from_markers: moved, covariance: Matrix6::identity() };
            mounted(&estimate, &body, &observer_from_camera).0
        };
        let straight = moved(&Vector6::zeros());
        let mut jacobian = Matrix6::zeros();
        for k in 0..6 {
            let mut change = Vector6::zeros();
            change[k] = 1e-6;
            let end = moved(&change);
            let shift = end.translation.vector - straight.translation.vector;
            let turn = (end.rotation * straight.rotation.inverse()).scaled_axis();
            jacobian.fixed_view_mut::<3, 1>(0, k).copy_from(&(shift / 1e-6));
            jacobian.fixed_view_mut::<3, 1>(3, k).copy_from(&(turn / 1e-6));
        }
        let spread = Matrix6::from_diagonal(&Vector6::new(1.0, 2.0, 3.0, 4.0, 5.0, 6.0));
        let estimate = PoseEstimate { camera_from_markers: at, covariance: spread };
        let (_, covariance) = mounted(&estimate, &body, &observer_from_camera);
        assert!((covariance - jacobian * spread * jacobian.transpose()).norm() < 1e-4);
    }
}
