//! Output of fusion: tracks and plans as the contract's messages.

use std::collections::BTreeMap;

use flockeye_config::Flow;
use flockeye_contract as contract;
use flockeye_contract::{
    FrameStamp, MeasuredBy, NONE, PlanHeader, Pose, StageLatency, Track, TrackHeader, TrackState,
    ViewKind,
};
use flockeye_convert::{pose, row_major, search_code, stop_rule, xyzw};
use flockeye_geometry::body::{Bodies, Body};
use flockeye_geometry::camera::Stitch;
use flockeye_geometry::filter::{self, MotionEstimate, RivalPose};
use flockeye_geometry::pose::{LensError, PoseEstimate};
use flockeye_geometry::search::{Purpose, Search, SearchView};
use flockeye_runtime::memory::MAX_TRACKS;
use nalgebra::{Isometry3, Matrix3, Matrix6, Vector3};

use crate::planning::NextPlan;
use crate::record::Record;
use crate::target::{TargetEstimate, Update};
use crate::tracker::Tracker;

/// An estimate to publish, with its cause.
pub(crate) type Outgoing = (Update, Cause);

/// Times at which the views behind an estimate were cut and searched, nanoseconds of
/// CLOCK_MONOTONIC.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Cause {
    /// A view that was not searched yet.
    View {
        /// Time at which it was sent.
        issued_ns: i64,
    },
    /// The last view that shows a marker of the target.
    Record {
        /// Time at which it was sent.
        issued_ns: i64,
        /// Time at which its record was sent.
        sent_ns: i64,
    },
    /// No view shows the target.
    Nothing,
}

impl Cause {
    /// The cause of a pose from records: the last record with a marker of `body`.
    pub(crate) fn of_records(records: &[&Record], body: &Body) -> Self {
        let shows = |record: &&&Record| {
            record.markers.iter().any(|marker| body.marker(marker.id).is_some())
        };
        let last = records.iter().filter(shows).max_by_key(|record| record.header.sent_ns);
        last.map_or(Self::Nothing, |Record { header, .. }| Self::Record {
            issued_ns: header.issued_ns,
            sent_ns: header.sent_ns,
        })
    }
}

/// Estimates of one frame that are published together.
#[derive(Debug, Clone, PartialEq)]
pub struct TrackMessage {
    /// The frame.
    pub stamp: FrameStamp,
    /// The estimates, at most [`MAX_TRACKS`].
    pub(crate) updates: Vec<Outgoing>,
    /// Whether this is the last message about the frame.
    pub is_last: bool,
}

impl TrackMessage {
    /// Packs estimates into the least number of messages.
    pub(crate) fn of(stamp: FrameStamp, updates: Vec<Outgoing>) -> impl Iterator<Item = Self> {
        let mut updates = updates.into_iter().peekable();
        std::iter::from_fn(move || {
            updates.peek()?;
            let updates = updates.by_ref().take(MAX_TRACKS).collect();
            Some(Self { stamp, updates, is_last: false })
        })
    }

    /// The message that ends a frame.
    pub(crate) fn last_of(stamp: FrameStamp) -> Self {
        Self { stamp, updates: Vec::new(), is_last: true }
    }
}

/// The camera on the observer.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CameraMount {
    pub(crate) observer_from_camera: Isometry3<f64>,
    /// The error of its lens model. It is the same in all frames, so the tracks' filters must not
    /// average it away. It is added where poses leave.
    pub(crate) lens: LensError,
    /// The lenses of a stitched camera. What is not known of them is another error of all frames.
    pub(crate) stitch: Option<Stitch>,
}

/// Writes messages for one observer.
#[derive(Debug)]
pub struct Writer {
    pub(crate) bodies: Bodies,
    pub(crate) mount: CameraMount,
    /// Flow of frames: in a lossless run exposures have another clock than the stages.
    pub(crate) flow: Flow,
    pub(crate) mode: contract::SearchMode,
    /// Number of starts of this stage.
    pub(crate) generation: u32,
}

impl Writer {
    /// Estimates as a message of the topic `track`, sent at `now_ns`, with the predictions of
    /// `tracker` for that time.
    pub fn tracks(
        &self,
        message: &TrackMessage,
        tracker: &Tracker,
        now_ns: i64,
    ) -> (TrackHeader, Vec<Track>) {
        let TrackMessage { stamp, updates, is_last } = message;
        let stitch = tracker.camera().stitching.as_ref().map(|it| *it.current());
        let mount = CameraMount { stitch, ..self.mount };
        // In a lossless run exposures have another clock, and the time of sending is meaningless.
        let predicted_ns = match self.flow {
            Flow::Latest => now_ns,
            Flow::Lossless => stamp.exposure_ns,
        };
        let tracks = updates.iter().filter_map(|((target, estimate), cause)| {
            let body = self.bodies.get(*target)?;
            let track = track(*target, estimate, body, &mount);
            let predicted_s = predicted_ns as f64 * 1e-9;
            let rival = tracker.rival(*target, predicted_s).filter(|_| track.is_ambiguous != 0);
            let track = match tracker.prediction(*target, predicted_s) {
                Some(predicted) => {
                    let (at, covariance) = believed(&predicted.pose(), rival, body, &mount);
                    Track {
                        predicted_observer_from_target: pose(&at),
                        predicted_covariance: row_major(&covariance),
                        predicted_ns,
                        ..track
                    }
                }
                // Without a live track, the last pose is repeated.
                None => Track {
                    predicted_observer_from_target: track.observer_from_target,
                    predicted_covariance: track.covariance,
                    predicted_ns: stamp.exposure_ns,
                    ..track
                },
            };
            Some(Track { latency: latency(self.flow, stamp, *cause, now_ns), ..track })
        });
        let header = TrackHeader {
            stamp: *stamp,
            generation: self.generation,
            is_last: u32::from(*is_last),
        };
        (header, tracks.collect())
    }

    /// A plan as a message of the topic `plan`, made after the frame `after` and sent at `now_ns`.
    pub fn plan(
        &self,
        next: &NextPlan,
        after: Option<FrameStamp>,
        now_ns: i64,
    ) -> (PlanHeader, Vec<contract::PlannedView>) {
        let NextPlan { plan_id, plan, predictions, unsearched, gamma } = next;
        let reference_s = predictions.values().next().map_or(0.0, |first| first.stamp_s);
        let reference_ns = nanoseconds(reference_s);
        let views = plan.views.iter().take(contract::MAX_PLANNED_VIEWS).map(|planned| {
            let search = match planned.purpose {
                Purpose::Roi(target) if unsearched.contains(&target) => Search::Nothing,
                _ => planned.search,
            };
            planned_view(planned, predictions, reference_ns, search)
        });
        let header = PlanHeader {
            after: after.unwrap_or_default(),
            plan_id: *plan_id,
            made_ns: now_ns,
            has_after: u32::from(after.is_some()),
            generation: self.generation,
            stop_rule: stop_rule(plan.stop_rule).code(),
            mode: self.mode.code(),
            view_budget: plan.view_budget as u32,
            gamma: gamma.map_or(0.0, |gamma| gamma as f32),
        };
        (header, views.collect())
    }
}

/// The pose of the target drone in the observer drone's frame, mounts applied, with its covariance
/// and the errors of the lenses.
///
/// A small rotation d of the markers moves the target's origin, which lies at r from theirs (both
/// in the camera's axes), by d x r; so the covariance turns with J = [I, -[r]x; 0, I], then both
/// with the camera's mount.
fn mounted(
    estimate: &PoseEstimate,
    body: &Body,
    CameraMount { observer_from_camera, lens, stitch }: &CameraMount,
) -> (Isometry3<f64>, Matrix6<f64>) {
    let mut estimate = lens.added(estimate, body);
    if let Some(stitch) = stitch {
        let place = estimate.camera_from_markers.translation.vector;
        estimate.covariance += stitch.pose_covariance(&place);
    }
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

/// An estimate as a track, without its latency.
fn track(target: usize, estimate: &TargetEstimate, body: &Body, mount: &CameraMount) -> Track {
    let (observer_from_target, covariance) = believed(&estimate.pose, estimate.rival, body, mount);
    let is_published = |_: &RivalPose| {
        let states = [filter::TrackState::Confirmed, filter::TrackState::Coasting];
        estimate.state.is_some_and(|state| states.contains(&state))
    };
    let rival = estimate.rival.filter(is_published);
    let measured = estimate.measured.map(|(measured, _)| mounted(&measured, body, mount));
    let measured_by = estimate.measured.map_or(MeasuredBy::Nothing, |(_, by)| by);
    let turn: Matrix3<f64> = mount.observer_from_camera.rotation.to_rotation_matrix().into_inner();
    let offset = estimate.pose.camera_from_markers.rotation
        * body.target_from_markers.inverse().translation.vector;
    let velocity: Vector3<f64> = turn * (estimate.velocity + estimate.rate.cross(&offset));
    let state = match estimate.state {
        None => TrackState::Measured,
        Some(filter::TrackState::Tentative)
            if estimate.measured.is_none() && estimate.rival.is_none() =>
        {
            TrackState::Coasting
        }
        Some(filter::TrackState::Tentative) => TrackState::Tentative,
        // One of two poses is no measurement.
        Some(filter::TrackState::Confirmed) if rival.is_some() => TrackState::Coasting,
        Some(filter::TrackState::Confirmed) => TrackState::Confirmed,
        Some(filter::TrackState::Coasting) => TrackState::Coasting,
        Some(filter::TrackState::Lost) => TrackState::Lost,
    };
    let track = match rival.map(|rival| (mounted(&rival.pose, body, mount), rival)) {
        None => Track::default(),
        Some(((at, covariance), rival)) => Track {
            rival_observer_from_target: pose(&at),
            rival_covariance: row_major(&covariance),
            rival_lead: rival.lead,
            is_ambiguous: 1,
            ..Track::default()
        },
    };
    Track {
        observer_from_target: pose(&observer_from_target),
        covariance: row_major(&covariance),
        linear_velocity: velocity.into(),
        angular_velocity: (turn * estimate.rate).into(),
        measured_observer_from_target: measured.map_or_else(Pose::default, |(at, _)| pose(&at)),
        measured_covariance: measured.map_or([0.0; 36], |(_, covariance)| row_major(&covariance)),
        age_ns: nanoseconds(estimate.age_s),
        unseen_ns: nanoseconds(estimate.unseen_s),
        name: body.name.as_str().into(),
        target: target as u32,
        track_id: estimate.track_id,
        state: state.code(),
        measured_by: measured_by.code(),
        markers: estimate.markers,
        // The prediction and the latency follow when the track is written.
        ..track
    }
}

/// A [`mounted`] pose, with a covariance that covers its rival too.
fn believed(
    estimate: &PoseEstimate,
    rival: Option<RivalPose>,
    body: &Body,
    mount: &CameraMount,
) -> (Isometry3<f64>, Matrix6<f64>) {
    let (at, covariance) = mounted(estimate, body, mount);
    let Some(RivalPose { pose, lead }) = rival else { return (at, covariance) };
    let both = |(camera_from_markers, covariance)| PoseEstimate { camera_from_markers, covariance };
    let rival = RivalPose { pose: both(mounted(&pose, body, mount)), lead };
    (at, rival.covariance_beside(&both((at, covariance))))
}

fn nanoseconds(seconds: f64) -> i64 {
    (seconds * 1e9).round() as i64
}

fn planned_view(
    planned: &SearchView,
    predictions: &BTreeMap<usize, MotionEstimate>,
    reference_ns: i64,
    search: Search,
) -> contract::PlannedView {
    let (kind, tile, target) = match planned.purpose {
        Purpose::Partition(tile) => (ViewKind::Partition, tile as u32, NONE),
        Purpose::HighResolution(tile) => (ViewKind::HighResolution, tile as u32, NONE),
        Purpose::Roi(target) => (ViewKind::Roi, NONE, target as u32),
        Purpose::Proposal => (ViewKind::Proposal, NONE, NONE),
    };
    let prediction = match planned.purpose {
        Purpose::Roi(target) => predictions.get(&target),
        Purpose::Partition(_) | Purpose::HighResolution(_) | Purpose::Proposal => None,
    };
    contract::PlannedView {
        camera_from_view: xyzw(&planned.view.camera_from_view),
        rate_in_camera: planned.rate_in_camera.into(),
        reference_ns,
        focal_px: planned.view.focal_px,
        predicted_camera_from_markers: prediction
            .map_or_else(Pose::default, |prediction| pose(&prediction.camera_from_markers)),
        size_px: planned.view.size_px,
        kind: kind.code(),
        tile,
        target,
        has_prediction: u32::from(prediction.is_some()),
        search: search_code(search).code(),
    }
}

/// Latency of each stage for an estimate, published at `now_ns`. Unknown times are -1.
fn latency(flow: Flow, stamp: &FrameStamp, cause: Cause, now_ns: i64) -> StageLatency {
    // In a lossless run exposures have another clock.
    let (capture_ns, since_ns) = match flow {
        Flow::Latest => (stamp.published_ns - stamp.exposure_ns, stamp.exposure_ns),
        Flow::Lossless => (-1, stamp.published_ns),
    };
    let (rectification_ns, detection_ns, fusion_ns) = match cause {
        Cause::View { issued_ns } => (issued_ns - stamp.published_ns, -1, now_ns - issued_ns),
        Cause::Record { issued_ns, sent_ns } => {
            (issued_ns - stamp.published_ns, sent_ns - issued_ns, now_ns - sent_ns)
        }
        Cause::Nothing => (-1, -1, -1),
    };
    let total_ns = now_ns - since_ns;
    StageLatency { capture_ns, rectification_ns, detection_ns, fusion_ns, total_ns }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::fixtures::alpha;
    use nalgebra::{Translation3, UnitQuaternion, Vector6};

    fn transform(x: f64, y: f64, z: f64, roll: f64, pitch: f64, yaw: f64) -> Isometry3<f64> {
        Isometry3::from_parts(
            Translation3::new(x, y, z),
            UnitQuaternion::from_euler_angles(roll, pitch, yaw),
        )
    }

    fn mount(observer_from_camera: Isometry3<f64>) -> CameraMount {
        CameraMount { observer_from_camera, lens: LensError::default(), stitch: None }
    }

    #[test]
    fn an_ambiguous_track_has_both_poses_and_a_covariance_that_covers_both() {
        let estimate_of = |x: f64, roll: f64| PoseEstimate {
            camera_from_markers: transform(x, 0.0, 0.0, roll, 0.0, 0.0),
            covariance: Matrix6::identity() * 1e-4,
        };
        let lead = 9f64.ln();
        let measurement = crate::fixtures::measurement(&estimate_of(1.0, 0.0).camera_from_markers);
        let estimate = TargetEstimate {
            pose: estimate_of(1.0, 0.0),
            rival: Some(RivalPose { pose: estimate_of(1.2, 1.0), lead }),
            state: Some(filter::TrackState::Confirmed),
            measured: None,
            ..TargetEstimate::of_frame(&measurement)
        };
        let written = track(0, &estimate, &alpha(), &mount(Isometry3::identity()));
        assert_eq!((written.is_ambiguous, written.rival_lead), (1, lead));
        assert_eq!((written.state, written.measured_by), (TrackState::Coasting.code(), 0));
        assert!((written.rival_observer_from_target.position[0] - 1.2).abs() < 1e-12);
        // A tenth of the squared gaps.
        assert!((written.covariance[0] - (1e-4 + 0.1 * 0.04)).abs() < 1e-9);
        assert!((written.covariance[21] - (1e-4 + 0.1 * 1.0)).abs() < 1e-9);
        assert!((written.covariance[28] - 1e-4).abs() < 1e-9);
        for (state, code) in [
            (filter::TrackState::Tentative, TrackState::Tentative),
            (filter::TrackState::Lost, TrackState::Lost),
        ] {
            let ended = TargetEstimate { state: Some(state), ..estimate.clone() };
            let written = track(0, &ended, &alpha(), &mount(Isometry3::identity()));
            assert_eq!((written.is_ambiguous, written.state), (0, code.code()));
        }
    }

    /// The covariance's Jacobian against differences of the transform itself.
    #[test]
    fn mounts_transform_the_covariance() {
        let mut body = alpha();
        body.target_from_markers = transform(0.1, -0.2, 0.3, 0.3, 0.2, 0.1);
        let mount = mount(transform(1.0, 2.0, 3.0, -0.4, 0.5, 0.6));
        let at = transform(0.5, 0.6, -0.7, 1.0, -0.3, 2.0);
        let moved = |change: &Vector6<f64>| {
            let rotation = UnitQuaternion::from_scaled_axis(change.fixed_rows::<3>(3).into_owned());
            let moved = Isometry3::from_parts(
                Translation3::from(at.translation.vector + change.fixed_rows::<3>(0)),
                rotation * at.rotation,
            );
            let estimate =
                PoseEstimate { camera_from_markers: moved, covariance: Matrix6::identity() };
            mounted(&estimate, &body, &mount).0
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
        let (_, covariance) = mounted(&estimate, &body, &mount);
        assert!((covariance - jacobian * spread * jacobian.transpose()).norm() < 1e-4);
    }
}
