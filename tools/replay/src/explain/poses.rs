//! Poses of the target in the frame: predicted by its track, measured, and likeliest.

use flockeye_config::Resolved;
use flockeye_contract::{MeasuredBy, Pose, Track, TrackState, ViewHeader, ViewKind};
use flockeye_convert::{isometry, pose};
use flockeye_geometry::Ray;
use flockeye_geometry::pose::{position_deviation_m, rotation_deviation_rad};
use nalgebra::{Isometry3, Matrix6};

use super::explanation::{Deviations, PoseFacts, ResidualOf};
use super::known::FrameKnowledge;

/// The mounting of a target's markers. It converts between poses of the markers and of the drone.
pub(super) struct Mounting<'r> {
    /// The configuration.
    pub resolved: &'r Resolved,
    /// The target's number.
    pub target: usize,
}

impl Mounting<'_> {
    /// `camera_from_markers` as a pose of the drone.
    pub(super) fn of_markers(&self, camera_from_markers: &Isometry3<f64>) -> PoseFacts {
        of_pose(
            &(self.resolved.observer_from_camera
                * camera_from_markers
                * self.target_from_markers().inverse()),
        )
    }

    /// A pose of the drone as `camera_from_markers`.
    pub(super) fn to_markers(&self, observer_from_target: &Pose) -> Isometry3<f64> {
        self.resolved.observer_from_camera.inverse()
            * isometry(observer_from_target)
            * self.target_from_markers()
    }

    /// The pose of the markers on the drone.
    fn target_from_markers(&self) -> Isometry3<f64> {
        let mounted = self.resolved.bodies.get(self.target);
        mounted.map_or_else(Isometry3::identity, |body| body.target_from_markers)
    }
}

pub(super) fn of_pose(observer_from_target: &Isometry3<f64>) -> PoseFacts {
    let position = observer_from_target.translation.vector;
    let Pose { position: at, orientation } = pose(observer_from_target);
    PoseFacts {
        position: at,
        orientation,
        range_m: position.norm(),
        bearing_deg: position.y.atan2(position.x).to_degrees(),
        elevation_deg: position.z.atan2(position.xy().norm()).to_degrees(),
    }
}

/// Standard deviations of a pose, all axes together.
pub(super) fn deviations(covariance: &Matrix6<f64>) -> Deviations {
    Deviations {
        position_m: position_deviation_m(covariance),
        rotation_deg: rotation_deviation_rad(covariance).to_degrees(),
    }
}

/// The difference between two poses.
pub(super) fn difference(one: &Isometry3<f64>, other: &Isometry3<f64>) -> Deviations {
    Deviations {
        position_m: (one.translation.vector - other.translation.vector).norm(),
        rotation_deg: one.rotation.angle_to(&other.rotation).to_degrees(),
    }
}

/// The pose of this frame in a track message: the measurement if there is one, else the track's
/// pose.
pub(super) fn told(track: &Track) -> &Pose {
    match track.measured_by == MeasuredBy::Nothing.code() {
        true => &track.observer_from_target,
        false => &track.measured_observer_from_target,
    }
}

/// The place where the target is expected, by its track or by the truth.
#[derive(Debug, Clone, Copy)]
pub(super) struct TargetPlace {
    pub camera_from_markers: Isometry3<f64>,
    /// Whether the track predicts it there.
    pub is_predicted: bool,
}

impl TargetPlace {
    /// The direction from the camera.
    pub(super) fn direction(&self) -> Option<Ray> {
        Ray::try_new(self.camera_from_markers.translation.vector, 1e-9)
    }
}

/// The pose that the track predicted for the frame, from the replayed core or else from the plan.
pub(super) fn predicted(resolved: &Resolved, known: &FrameKnowledge) -> Option<Isometry3<f64>> {
    if let Some(before) = &known.before {
        return before.predicted.map(|(pose, _)| pose);
    }
    let gathered = &known.gathered;
    let regions = gathered.views.values().map(|(view, _)| view);
    let region = |view: &&ViewHeader| {
        view.has_prediction != 0
            && view.kind == ViewKind::Roi.code()
            && view.target as usize == known.target
    };
    if let Some(view) = regions.clone().find(region) {
        return Some(isometry(&view.predicted_camera_from_markers));
    }
    let planned = gathered.plan().and_then(|(_, views)| {
        let mut own = views.iter().filter(|view| view.target as usize == known.target);
        own.find(|view| view.has_prediction != 0)
    });
    if let Some(planned) = planned {
        return Some(isometry(&planned.predicted_camera_from_markers));
    }
    let (_, before) =
        gathered.before.filter(|(_, track)| track.state != TrackState::Lost.code())?;
    let frames = Mounting { resolved, target: known.target };
    Some(frames.to_markers(&before.observer_from_target))
}

/// The place of the target in the frame.
pub(super) fn place(resolved: &Resolved, known: &FrameKnowledge) -> Option<TargetPlace> {
    let by_track = predicted(resolved, known)
        .map(|camera_from_markers| TargetPlace { camera_from_markers, is_predicted: true });
    by_track.or_else(|| {
        let truth = known.gathered.true_body()?;
        let camera_from_markers = isometry(&truth.camera_from_markers);
        Some(TargetPlace { camera_from_markers, is_predicted: false })
    })
}

/// The pose with which corners are compared, `camera_from_markers`.
pub(super) fn reference_pose(
    resolved: &Resolved,
    known: &FrameKnowledge,
) -> Option<(Isometry3<f64>, ResidualOf)> {
    let frames = Mounting { resolved, target: known.target };
    let measured = known.gathered.track().filter(|track| track.measured_by != 0);
    if let Some(track) = measured {
        return Some((frames.to_markers(told(track)), ResidualOf::Measurement));
    }
    let hypotheses = known.trials().flat_map(|trial| &trial.hypotheses);
    let likeliest = hypotheses
        .filter_map(|hypothesis| Some((hypothesis.log_odds()?, hypothesis.found.as_ref().ok()?)))
        .max_by(|(one, _), (other, _)| one.total_cmp(other));
    match likeliest {
        Some((_, found)) => Some((found.camera_from_markers, ResidualOf::Hypothesis)),
        None => predicted(resolved, known).map(|pose| (pose, ResidualOf::Prediction)),
    }
}
