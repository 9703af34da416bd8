//! The core of fusion, as the configuration asks for it.

use std::sync::Arc;

use anyhow::Context as _;
use flockeye_config::{Flow, FrameLimit, Pipeline, Resolved};
use flockeye_contract as contract;
use flockeye_convert::RadianceCache;
use flockeye_dictionary::Dictionary;
use flockeye_geometry::camera::CameraModel;
use flockeye_geometry::filter::{MotionModel, TrackPolicy};
use flockeye_geometry::search::{Planner, SearchMode};
use flockeye_imaging::align::Coding;
use flockeye_runtime::memory;

use crate::aligner::Aligner;
use crate::core::Core;
use crate::frame::frames::{Frames, Keeping};
use crate::output::Writer;
use crate::parallax::Parallax;
use crate::pictures::{PictureReader, Pixels};
use crate::planning::Planning;
use crate::readout::Readout;
use crate::schedule::{Schedule, VirtualClock};
use crate::tracker::{FilterChoice, Tracker};

/// A core, the writer of its messages, and the aligner that its background passes run with.
pub struct Configured<P> {
    /// The core.
    pub core: Core<P>,
    /// The writer.
    pub writer: Writer,
    /// The aligner.
    pub aligner: Arc<Aligner>,
    /// Whether the core hands out background passes.
    pub has_background: bool,
}

/// What the configuration asks for.
///
/// # Errors
/// A configuration that cannot be worked with: bodies, dictionary, mask, views.
pub fn configured<P: Pixels>(
    resolved: &Resolved,
    generation: u32,
) -> anyhow::Result<Configured<P>> {
    let Resolved { pipeline, bodies, camera, observer_from_camera, .. } = resolved;
    let planner = Planner::new(
        search_mode(pipeline),
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
        .with_coding(coding(pipeline))
        .with_max_tilt(bodies, observer_from_camera, pipeline.fusion.level_deg.to_radians());
    let aligner = Arc::new(aligner);
    let parallax = Parallax::of(camera, pipeline.camera.assumed_distance_m);
    let filter = filter_choice(pipeline);
    let has_background = pipeline.is_limited() && pipeline.fusion.align && pipeline.has_tracks();
    let threads = pipeline.fusion.threads as usize;
    let mut tracker = Tracker::new(bodies, filter, aligner.clone(), threads)
        .with_parallax(parallax.clone())
        .with_readout(Readout::of(camera, pipeline.camera.readout_ms * 1e-3))
        .with_exposure(pipeline.exposure_s());
    if has_background {
        tracker = tracker.with_background();
    }
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
        Planning::new(planner),
    );
    // In a lossless run a record may come before anything else of its frame.
    let core = match pipeline.flow() {
        Flow::Latest => core.guarded(pipeline.detection_workers()),
        Flow::Lossless => core,
    };
    let writer = Writer {
        bodies: bodies.clone(),
        observer_from_camera: *observer_from_camera,
        flow: pipeline.flow(),
        mode: pipeline.search.mode,
        generation,
    };
    Ok(Configured { core, writer, aligner, has_background })
}

/// Views of places that look like a body in each frame. They are found in equirectangular pictures
/// only.
fn proposals(resolved: &Resolved) -> usize {
    match resolved.camera.model() {
        CameraModel::Equirectangular { .. } => resolved.pipeline.proposals(),
        _ => 0,
    }
}

/// Without tracks there is no prediction of where to look, so everything is searched.
fn search_mode(pipeline: &Pipeline) -> SearchMode {
    match pipeline.search.mode {
        contract::SearchMode::Greedy => SearchMode::Greedy,
        contract::SearchMode::Optimized => SearchMode::Optimized,
        contract::SearchMode::Roi if pipeline.has_tracks() => SearchMode::Roi,
        contract::SearchMode::Exhaustive | contract::SearchMode::Roi => SearchMode::Exhaustive,
    }
}

/// How the source's pictures are coded.
fn coding(pipeline: &Pipeline) -> Coding {
    if pipeline.is_coded_as_video() { Coding::Video } else { Coding::Images }
}

/// How poses are carried from frame to frame.
fn filter_choice(pipeline: &Pipeline) -> FilterChoice {
    let fusion = &pipeline.fusion;
    let usual = MotionModel::default();
    match pipeline.has_tracks() {
        false => FilterChoice::None,
        true => FilterChoice::Tracks(TrackPolicy {
            motion: MotionModel {
                acceleration: fusion.acceleration,
                angular_acceleration: fusion.angular_acceleration,
                // A coasting target is predicted all the while.
                longest_step_s: usual.longest_step_s.max(fusion.coast_s),
                ..usual
            },
            coast_s: fusion.coast_s,
            ..TrackPolicy::default()
        }),
    }
}
