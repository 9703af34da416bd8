//! Makes the answer from messages and decisions.

use std::path::Path;

use flockeye_config::Resolved;
use flockeye_contract::{MeasuredBy, NONE, Search, StopReason, Track, TrackState, ViewKind};
use flockeye_convert::{at_exposure, isometry, matrix6, view_of};
use flockeye_geometry::Ray;
use flockeye_geometry::body::Body;
use flockeye_geometry::filter;
use flockeye_geometry::pose::position_deviation_m;
use flockeye_geometry::view::View;
use nalgebra::{Isometry3, Unit, Vector3};

use super::explanation::{
    BeforeFacts, DecisiveStep, FrameExplanation, FrameFacts, MarkerFacts, Reliance, ResultFacts,
    StageLatencies, TruthFacts, ViewFacts,
};
use super::gathered::StageMessages;
use super::known::{FrameKnowledge, ReplayOutcome};
use super::poses::{
    Mounting, TargetPlace, deviations, difference, of_pose, place, predicted, reference_pose, told,
};
use super::{judgement, passes};
use flockeye_fusion::decoded_rays;

/// Makes the answer for a frame.
pub(super) fn explanation(
    path: &Path,
    resolved: &Resolved,
    known: &FrameKnowledge,
) -> FrameExplanation {
    let FrameKnowledge { gathered, stamp, .. } = known;
    let body = resolved.bodies.get(known.target);
    let place = place(resolved, known);
    let direction = place.and_then(|place| place.direction());
    let end = gathered.end.as_ref();
    let mut explanation = FrameExplanation {
        recording: path.display().to_string(),
        target: body.map_or_else(String::new, |body| body.name.clone()),
        frame: FrameFacts {
            sequence: stamp.sequence,
            epoch: stamp.epoch,
            at_s: known.at_s,
            plan_id: end.map(|end| end.plan_id),
            views_issued: end.map(|end| end.views_issued),
            views_abandoned: end.map(|end| end.views_abandoned),
            stopped: end.and_then(|end| StopReason::try_from(end.reason).ok()),
        },
        step: DecisiveStep::Untold,
        why: String::new(),
        before: before(resolved, known),
        views: views(resolved, known, direction.as_ref()),
        next_search_in: direction.as_ref().and_then(|direction| next_search(known, direction)),
        markers: markers(resolved, known, place.as_ref()),
        passes: passes::facts(resolved, known.target, &known.decisions),
        result: gathered.track().map(result),
        truth: truth(gathered),
        hidden_by: hidden_by(resolved, known, place.as_ref()),
        reliance: reliance(known),
    };
    let (step, why) = judgement::of(known, &explanation, place.as_ref());
    (explanation.step, explanation.why) = (step, why);
    explanation
}

fn before(resolved: &Resolved, known: &FrameKnowledge) -> BeforeFacts {
    let FrameKnowledge { gathered, stamp, .. } = known;
    let frames = Mounting { resolved, target: known.target };
    let (state, deviations) = match &known.before {
        Some(before) => {
            let said = before.predicted.map(|(_, covariance)| deviations(&covariance));
            (before.state.map(state_of), said)
        }
        None => {
            let last = gathered.before.as_ref().map(|(_, track)| track);
            let state = last.and_then(|track| TrackState::try_from(track.state).ok());
            (state.filter(|state| *state != TrackState::Lost), None)
        }
    };
    let measured = gathered.measured_before;
    BeforeFacts {
        state,
        track_id: gathered.before.filter(|_| state.is_some()).map(|(_, track)| track.track_id),
        predicted: predicted(resolved, known).map(|pose| frames.of_markers(&pose)),
        deviations,
        measured_in: measured.map(|(stamp, _)| stamp.sequence),
        measured_by: measured.map(|(_, by)| by),
        measured_ago_s: measured
            .map(|(then, _)| stamp.exposure_ns.saturating_sub(then.exposure_ns) as f64 * 1e-9),
    }
}

fn state_of(state: filter::TrackState) -> TrackState {
    match state {
        filter::TrackState::Tentative => TrackState::Tentative,
        filter::TrackState::Confirmed => TrackState::Confirmed,
        filter::TrackState::Coasting => TrackState::Coasting,
        filter::TrackState::Lost => TrackState::Lost,
    }
}

fn views(resolved: &Resolved, known: &FrameKnowledge, direction: Option<&Ray>) -> Vec<ViewFacts> {
    let gathered = &known.gathered;
    let body = resolved.bodies.get(known.target);
    let name = |target: u32| resolved.bodies.get(target as usize).map(|body| body.name.clone());
    let facts = |view_index: u32, kind: u32, tile: u32, target: u32, view: &View| {
        let kind = ViewKind::try_from(kind).ok();
        let record = gathered.records.get(&view_index);
        let markers = record.into_iter().flat_map(|record| &record.markers);
        let own =
            markers.filter(|marker| body.is_some_and(|body| body.marker(marker.id).is_some()));
        // The direction of a proposal is not known before it is cut.
        let is_placed =
            kind != Some(ViewKind::Proposal) || gathered.views.contains_key(&view_index);
        ViewFacts {
            view_index,
            kind,
            tile: (tile != NONE).then_some(tile),
            region_of: name(target).filter(|_| kind == Some(ViewKind::Roi)),
            shows_place: direction.map(|direction| is_placed && view.holds(direction, 0.0)),
            is_cut: gathered.views.contains_key(&view_index) || record.is_some(),
            is_answered: record.is_some(),
            is_searched: true,
            has_failed: record.is_some_and(|record| record.header.failed != 0),
            decoded: own.count() as u32,
        }
    };
    let cut = gathered.views.values().map(|(view, _)| ViewFacts {
        is_searched: view.search != Search::Nothing.code(),
        ..facts(view.view_index, view.kind, view.tile, view.target, &view_of(view))
    });
    let planned = gathered.plan().map(|(_, views)| views.as_slice()).unwrap_or_default();
    let not_cut = (0..).zip(planned).filter(|(index, _)| !gathered.views.contains_key(index));
    let not_cut = not_cut.map(|(index, planned)| {
        let view = at_exposure(planned, known.stamp.exposure_ns);
        ViewFacts {
            is_searched: planned.search != Search::Nothing.code(),
            ..facts(index, planned.kind, planned.tile, planned.target, &view)
        }
    });
    let mut views: Vec<ViewFacts> = cut.chain(not_cut).collect();
    views.sort_by_key(|view| view.view_index);
    views
}

/// The number of frames until a view shows the place again.
fn next_search(known: &FrameKnowledge, direction: &Ray) -> Option<u64> {
    let later = known.gathered.later.iter();
    let next = later.filter(|view| view_of(view).holds(direction, 0.0)).map(|view| &view.stamp);
    next.min_by_key(|stamp| stamp.order())
        .map(|stamp| stamp.sequence.saturating_sub(known.stamp.sequence))
}

/// The largest angle between a marker of the target and its expected direction, radians.
fn reach_rad(body: &Body, known: &FrameKnowledge, place: &TargetPlace) -> f64 {
    let range_m = place.camera_from_markers.translation.vector.norm();
    let predicted = known.before.as_ref().and_then(|before| before.predicted);
    let doubt_m = predicted
        .filter(|_| place.is_predicted)
        .map_or(0.0, |(_, covariance)| 3.0 * position_deviation_m(&covariance));
    (2.0 * body.radius() + doubt_m) / range_m.max(1e-3)
}

fn markers(
    resolved: &Resolved,
    known: &FrameKnowledge,
    place: Option<&TargetPlace>,
) -> Vec<MarkerFacts> {
    let Some(body) = resolved.bodies.get(known.target) else { return Vec::new() };
    let reference = reference_pose(resolved, known);
    let mut all = Vec::new();
    for record in known.gathered.records.values() {
        let view_index = record.header.view_index;
        let view = known.gathered.views.get(&view_index).map(|(view, _)| view);
        for marker in record.markers.iter().filter(|marker| body.marker(marker.id).is_some()) {
            let rays = decoded_rays(body, [marker]);
            let off_rad = |pose: &Isometry3<f64>| {
                let squared = rays.iter().filter_map(|ray| {
                    let corner = pose * body.marker(ray.marker_id)?.corners[ray.corner];
                    let towards = Unit::try_new(corner.coords, 1e-9)?;
                    Some(towards.angle(&ray.ray_in_camera).powi(2))
                });
                (squared.sum::<f64>() / rays.len().max(1) as f64).sqrt()
            };
            let is_at_place = place.and_then(|place| {
                let middle: Vector3<f64> =
                    rays.iter().map(|ray| ray.ray_in_camera.into_inner()).sum();
                let expected = place.direction()?;
                let off_rad = Ray::try_new(middle, 1e-9)?.angle(&expected);
                Some(off_rad < reach_rad(body, known, place))
            });
            // Residuals are only valid for markers near the expected place.
            let residual = reference.as_ref().zip(view).filter(|_| is_at_place != Some(false));
            all.push(MarkerFacts {
                id: marker.id,
                view_index,
                is_at_place,
                residual_px: residual.map(|((pose, _), view)| off_rad(pose) * view.focal_px),
                residual_of: residual.map(|((_, of), _)| *of),
            });
        }
    }
    all
}

fn result(track: &Track) -> ResultFacts {
    let measured_by = MeasuredBy::try_from(track.measured_by).ok();
    let is_measured = measured_by.is_some_and(|by| by != MeasuredBy::Nothing);
    let ms = |ns: i64| (ns != -1).then_some(ns as f64 * 1e-6);
    let measured = is_measured.then_some(&track.measured_observer_from_target);
    ResultFacts {
        state: TrackState::try_from(track.state).ok(),
        measured_by,
        measured: measured.map(|pose| of_pose(&isometry(pose))),
        measured_deviations: measured.map(|_| deviations(&matrix6(&track.measured_covariance))),
        pose: of_pose(&isometry(&track.observer_from_target)),
        deviations: deviations(&matrix6(&track.covariance)),
        markers: track.markers,
        unseen_s: track.unseen_ns as f64 * 1e-9,
        latency_ms: StageLatencies {
            capture: ms(track.latency.capture_ns),
            rectification: ms(track.latency.rectification_ns),
            detection: ms(track.latency.detection_ns),
            fusion: ms(track.latency.fusion_ns),
            total: ms(track.latency.total_ns),
        },
    }
}

fn truth(gathered: &StageMessages) -> Option<TruthFacts> {
    let body = gathered.true_body()?;
    let there = isometry(&body.observer_from_target);
    Some(TruthFacts {
        pose: of_pose(&there),
        error: gathered.track().map(|track| difference(&isometry(told(track)), &there)),
        markers_visible_50: body.markers_visible_50,
        markers_visible_90: body.markers_visible_90,
        best_side_px: body.best_side_px,
    })
}

/// The name of a nearer body that hides the target, from fusion's tracks or the truth.
fn hidden_by(
    resolved: &Resolved,
    known: &FrameKnowledge,
    place: Option<&TargetPlace>,
) -> Option<String> {
    let place = place?;
    let (direction, range_m) =
        (place.direction()?, place.camera_from_markers.translation.vector.norm());
    let own_rad = resolved.bodies.get(known.target)?.radius() / range_m;
    let hides = |target: usize, there: Vector3<f64>| {
        let body = resolved.bodies.get(target)?;
        let (towards, nearer_m) = (Ray::try_new(there, 1e-9)?, there.norm());
        let reach_rad = body.radius() / nearer_m;
        // A body is in the way if it hides at least half of the target.
        let is_in_the_way = nearer_m < range_m
            && target != known.target
            && towards.angle(&direction) < reach_rad.max(own_rad * 0.5);
        is_in_the_way.then(|| body.name.clone())
    };
    let told = known.gathered.tracks.iter().find_map(|track| {
        let target = track.target as usize;
        let frames = Mounting { resolved, target };
        hides(target, frames.to_markers(told(track)).translation.vector)
    });
    told.or_else(|| {
        let (_, bodies) = known.gathered.truth.as_ref()?;
        bodies.iter().find_map(|body| {
            hides(body.target as usize, Vector3::from(body.camera_from_markers.position))
        })
    })
}

fn reliance(known: &FrameKnowledge) -> Reliance {
    let mut untold = Vec::new();
    let difference = match &known.replay {
        ReplayOutcome::Same => None,
        ReplayOutcome::Different(difference) => Some(difference.clone()),
        ReplayOutcome::Impossible(reason) => {
            untold.push(format!(
                "which poses fusion tried, and how likely they were: fusion cannot be replayed ({reason})"
            ));
            None
        }
    };
    if known.gathered.views.values().all(|(_, pixels)| pixels.is_none()) {
        let cure = "the recording has no pixels of views. Cure: record with them (--frames views)";
        untold.push(format!("what the picture shows: {cure}"));
    }
    Reliance {
        is_exact: known.replay == ReplayOutcome::Same,
        difference,
        untold,
        lost: known.lost.clone(),
    }
}
