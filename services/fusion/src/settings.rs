//! The core of fusion for a configuration.

use std::sync::Arc;

use anyhow::Context as _;
use flockeye_config::{Flow, FrameLimit, Pipeline, Resolved};
use flockeye_contract as contract;
use flockeye_convert::RadianceCache;
use flockeye_dictionary::Dictionary;
use flockeye_geometry::camera::CameraModel;
use flockeye_geometry::filter::{MotionModel, TrackPolicy};
use flockeye_geometry::search::{PlanOrder, Planner};
use flockeye_imaging::align::VIDEO_COVARIANCE_SCALE;
use flockeye_runtime::memory;

use crate::aligner::Aligner;
use crate::core::Core;
use crate::frame::frames::{Frames, Keeping};
use crate::measure::background::BackgroundSlot;
use crate::output::{CameraMount, Writer};
use crate::parallax::Parallax;
use crate::pictures::PictureReader;
use crate::response::{ResponseEstimate, Stated};
use crate::schedule::{Schedule, VirtualClock};
use crate::stitching::StitchEstimate;
use crate::tracker::Tracker;

/// Creates the core of a configuration, the writer of its messages, and the aligner of its
/// background passes; `None` if it has none.
///
/// # Errors
/// An invalid configuration: bodies, dictionary, mask, views.
pub fn configured<P: AsRef<[u8]>>(
    resolved: &Resolved,
    generation: u32,
) -> anyhow::Result<(Core<P>, Writer, Option<Arc<Aligner>>)> {
    let Resolved { pipeline, bodies, camera, observer_from_camera, .. } = resolved;
    let planner = Planner::new(
        plan_order(pipeline),
        resolved.division.partition.clone(),
        resolved.partition_views.clone(),
        resolved.roi_options,
    )?
    .with_high_resolution_tiles(resolved.high_resolution_tiles.clone())
    .with_alternating_windows(pipeline.alternates_windows())
    .with_proposals(bodies.len(), proposals(resolved))
    .with_mask(resolved.mask()?.clone());
    if planner.hidden_partitions() > 0 {
        tracing::info!(
            "{} of {} partitions are never searched: the camera sees nothing of them",
            planner.hidden_partitions(),
            planner.partition().len()
        );
    }
    let dictionary = Dictionary::load(&bodies.dictionary)?;
    let aligner = Aligner::new(bodies, |id| dictionary.print(id), camera.pixels_per_radian())
        .context("a body cannot be aligned")?
        .with_covariance_scale(pipeline.fusion.covariance_scale)
        .with_coding_covariance_scale(coding_covariance_scale(pipeline))
        .with_max_tilt(bodies, observer_from_camera, pipeline.fusion.level_deg.to_radians());
    let aligner = Arc::new(aligner);
    let parallax = Parallax::of(camera, pipeline.camera.assumed_distance_m);
    let filter = pipeline.has_tracks().then(|| track_policy(pipeline));
    let has_background = pipeline.is_limited() && pipeline.fusion.align && pipeline.has_tracks();
    let threads = pipeline.fusion.threads as usize;
    let exposure_s = pipeline.exposure_s();
    let mut tracker = Tracker::new(bodies, filter, aligner.clone(), threads, exposure_s);
    tracker.camera.lens = resolved.lens_error();
    tracker.camera.parallax = parallax.clone();
    tracker.camera.stitching = stitching(resolved);
    let is_simulated = pipeline.source.stage() == contract::StageName::Simulator;
    tracker.camera.response = ResponseEstimate::new(match pipeline.learns_response() {
        true => Stated::Nothing,
        false if is_simulated || resolved.measured_response.is_some() => Stated::Exactly,
        false => Stated::ByName,
    });
    let readout_s = pipeline.camera.readout_ms * 1e-3;
    tracker.camera.readout = (readout_s > 0.0).then_some((*camera, readout_s));
    tracker.background = has_background.then(BackgroundSlot::default);
    let schedule = match pipeline.limit() {
        FrameLimit::Time => Schedule::Flight,
        FrameLimit::Costs => Schedule::Virtual(VirtualClock::new(pipeline.costs())),
        FrameLimit::Unlimited => Schedule::Unlimited,
    };
    let keeping = Keeping {
        deadline_ns: pipeline.frame_deadline().as_nanos() as i64,
        max_unanswered: memory::held_views_waiting(pipeline),
        max_best: memory::held_views_best(resolved),
        keeps_pixels: pipeline.fusion.align,
        keeps_regions: schedule.has_direct_pass(),
        keeps_places: pipeline.has_single_images(),
    };
    let core = Core::new(
        schedule,
        Frames::new(keeping, bodies.len()),
        PictureReader::new(
            RadianceCache::new(resolved.measured_response)?,
            camera.pixels_per_radian(),
            parallax,
        ),
        tracker,
        planner,
    );
    // In a lossless run a record may be the first message of its frame.
    let core = match pipeline.flow() {
        Flow::Latest => core.guarded(pipeline.detection_workers()),
        Flow::Lossless => core,
    };
    let writer = Writer {
        bodies: bodies.clone(),
        mount: CameraMount {
            observer_from_camera: *observer_from_camera,
            lens: resolved.lens_error(),
            stitch: None,
        },
        flow: pipeline.flow(),
        mode: pipeline.search.mode,
        generation,
    };
    Ok((core, writer, has_background.then_some(aligner)))
}

/// The lenses of a stitched camera. `None` for a camera that certainly has one centre.
fn stitching(resolved: &Resolved) -> Option<StitchEstimate> {
    let settings = &resolved.pipeline.camera;
    let (stated_m, assumed_m) = (settings.lens_distance_m, settings.assumed_distance_m);
    let is_stitched = matches!(resolved.camera.model(), CameraModel::Equirectangular { .. });
    match stated_m.filter(|_| is_stitched) {
        _ if resolved.pipeline.learns_lenses() => Some(StitchEstimate::new(stated_m, assumed_m)),
        Some(exact_m) if exact_m > 0.0 => Some(StitchEstimate::exact(exact_m, assumed_m)),
        _ => None,
    }
}

/// Number of views of places that look like a body in each frame. They are found in equirectangular
/// pictures only.
fn proposals(resolved: &Resolved) -> usize {
    match resolved.camera.model() {
        CameraModel::Equirectangular { .. } => resolved.pipeline.proposals(),
        _ => 0,
    }
}

/// Without tracks there is no prediction for the search, so everything is searched.
fn plan_order(pipeline: &Pipeline) -> PlanOrder {
    match pipeline.search.mode {
        contract::SearchMode::Greedy => PlanOrder::Greedy,
        contract::SearchMode::Optimized => PlanOrder::Optimized,
        contract::SearchMode::Roi if pipeline.has_tracks() => PlanOrder::Roi,
        contract::SearchMode::Exhaustive | contract::SearchMode::Roi => PlanOrder::Exhaustive,
    }
}

/// Factor on covariances for the coding of the source's pictures.
fn coding_covariance_scale(pipeline: &Pipeline) -> f64 {
    if pipeline.is_coded_as_video() { VIDEO_COVARIANCE_SCALE } else { 1.0 }
}

/// Policy of the tracks' filters.
fn track_policy(pipeline: &Pipeline) -> TrackPolicy {
    let fusion = &pipeline.fusion;
    let usual = MotionModel::default();
    TrackPolicy {
        motion: MotionModel {
            acceleration: fusion.acceleration,
            // A coasting target is predicted for the whole time.
            longest_step_s: usual.longest_step_s.max(fusion.coast_s),
            ..usual
        },
        coast_s: fusion.coast_s,
        ..TrackPolicy::default()
    }
}
