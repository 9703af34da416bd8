//! `flockeye check`: what a configuration means on this machine, before anything runs.

use std::fmt::Write;
use std::time::Duration;

use anyhow::{Context, ensure};
use flockeye_cli::{Configuration, Screen, signals};
use flockeye_config::{FrameLimit, RecordingTrigger, Resolved};
use flockeye_contract::Projection;
use flockeye_dictionary::Dictionary;
use flockeye_geometry::partition;
use flockeye_network::NetworkParameters;
use flockeye_runtime::instance::Instance;
use flockeye_runtime::memory::{Budget, shared_memory_space};

use crate::run_log::RunOptions;
use crate::up::run_pipeline;

/// Checks the configuration, and prints what it means.
pub(crate) fn run(configuration: &Configuration, measure: Option<Duration>) -> anyhow::Result<()> {
    let resolved = Resolved::of(configuration.load()?)?;
    Dictionary::of(&resolved.bodies)?;
    if resolved.pipeline.gateway.enabled {
        NetworkParameters::of_drone(&resolved.pipeline).check()?;
    }
    let budget = Budget::of(&resolved);
    let (free, total) = shared_memory_space().context("cannot look at /dev/shm")?;
    let mut screen = Screen::new();
    screen.line(&plan(&resolved, &budget)?);
    screen.line(&format!("/dev/shm has {:.0} MB free", free as f64 / 1e6));
    budget.check(free, total)?;
    screen.line("everything is in order");
    if let Some(duration) = measure {
        screen.line(&measured(configuration, duration)?);
    }
    Ok(())
}

/// Measures this machine by a short run in an instance of its own.
fn measured(configuration: &Configuration, duration: Duration) -> anyhow::Result<String> {
    let own = [
        format!("instance=m{}", std::process::id()),
        "gateway.enabled=false".to_owned(),
        // A trial run is no flight.
        "recording.folder=null".to_owned(),
    ];
    let pipeline = configuration.load_with(&[], &own)?;
    let options =
        RunOptions { duration: Some(duration), watches_sweep: true, ..RunOptions::default() };
    let mut log = Screen::muted();
    let stopping = signals::stop_flag()?;
    let run = run_pipeline(&pipeline, &options, &mut log, &stopping)
        .with_context(|| format!("{}the run that measures this machine", log.kept()))?;
    ensure!(
        run.frames > 1,
        "{}in {:.1} s no two frames were searched. Cure: measure for longer",
        log.kept(),
        duration.as_secs_f64()
    );
    let mut text = format!(
        "measured {} frames, {:.1}/s, with {:.1} neighbours tracked",
        run.frames,
        (run.frames - 1) as f64 / run.ends_s,
        run.measured as f64 / run.frames as f64
    );
    match run.sweep {
        Some(sweep) => {
            write!(text, ": {sweep}. An untracked target waits as long for its first search")?;
            if pipeline.alternates_windows() {
                text += ", by one of two windows";
            }
        }
        None => write!(text, ": every frame is searched from its beginning")?,
    }
    Ok(text)
}

fn plan(resolved: &Resolved, budget: &Budget) -> anyhow::Result<String> {
    let (pipeline, bodies, views) =
        (&resolved.pipeline, &resolved.bodies, &resolved.partition_views);
    let mut text = String::new();
    let instance = Instance::named(&pipeline.instance.0);
    writeln!(text, "instance '{}' in {}", pipeline.instance.0, instance.folder().display())?;
    writeln!(text, "profile  {}: {}", pipeline.profile.name(), pipeline.profile.about())?;
    writeln!(
        text,
        "source   {} (stage {})",
        pipeline.source.input,
        pipeline.source.stage().name()
    )?;
    writeln!(
        text,
        "pictures coded as {}, covariances times {} (fusion.covariance_scale)",
        if pipeline.is_coded_as_video() { "video" } else { "images" },
        pipeline.fusion.covariance_scale
    )?;
    let camera = &pipeline.camera;
    let projection = format!("{:?}", camera.projection);
    writeln!(
        text,
        "camera   {}x{}, {projection}, rays off by {} px ({})",
        camera.width,
        camera.height,
        pipeline.lens_error_px(),
        if camera.lens_error_px.is_some() { "camera.lens_error_px" } else { "assumed" }
    )?;
    if camera.projection == Projection::Equirectangular {
        let from = match (pipeline.learns_lenses(), camera.lens_distance_m) {
            (true, Some(_)) => "camera.lens_distance_m, until bodies across their border show it",
            (true, None) => "assumed until bodies across their border show it",
            (false, Some(_)) => "camera.lens_distance_m",
            (false, None) => "the simulator's",
        };
        let distance_mm = camera.lens_distance_m.unwrap_or(0.0) * 1e3;
        writeln!(text, "lenses   {distance_mm} mm apart ({from})")?;
    }
    let (curve, _) = resolved.transfer;
    let response = match (pipeline.learns_response(), camera.response) {
        (true, _) => "assumed until the bodies' print shows it; camera.response states it",
        (false, Some(_)) => "camera.response",
        (false, None) => "the simulator's",
    };
    writeln!(text, "response {} ({response})", curve.name())?;
    let mask = resolved.mask()?;
    let hidden = views.iter().filter(|view| mask.hides_view(view)).count();
    if let Some(path) = &camera.mask {
        writeln!(text, "mask     {}", path.display())?;
    }
    if hidden > 0 {
        writeln!(
            text,
            "         {hidden} of {} partitions are hidden from the camera",
            views.len()
        )?;
    }
    writeln!(
        text,
        "observer '{}' in swarm '{}'{}",
        pipeline.observer.name,
        pipeline.observer.swarm,
        if pipeline.gateway.enabled { "" } else { " (nothing goes over the network)" }
    )?;
    writeln!(text, "search   {}", search(resolved, views.len() - hidden)?)?;
    writeln!(text, "sphere   {}", sphere(resolved))?;
    writeln!(text, "bodies   of {}", bodies.dictionary)?;
    for (target, body) in bodies.iter().enumerate() {
        let ids = body.markers.first().zip(body.markers.last());
        let (first, last) = ids.map_or((0, 0), |(first, last)| (first.id, last.id));
        writeln!(
            text,
            "  {target}: {}, {} markers, ids {first} to {last}",
            body.name,
            body.markers.len()
        )?;
    }
    writeln!(text, "stages")?;
    for (stage_name, stage) in pipeline.stages.iter() {
        if pipeline.runs(stage_name) {
            let command = if stage.command.is_empty() {
                "Flockeye's own".to_owned()
            } else {
                stage.command.join(" ")
            };
            let (name, count) = (stage_name.name(), pipeline.replicas(stage_name));
            writeln!(text, "  {name} x {count}: {command}, restart {:?}", stage.restart)?;
        }
    }
    if let Some(folder) = &pipeline.recording.folder {
        let what = match pipeline.recording.trigger {
            None => "everything",
            Some(RecordingTrigger::Lost) => "what came before a track was lost, or a request",
            Some(RecordingTrigger::Request) => "what came before a request",
        };
        writeln!(text, "  recorder: {what}, to {}", folder.display())?;
    }
    write!(text, "{budget}")?;
    Ok(text)
}

/// Search mode of the frames, and search rate of each part of the sphere.
fn search(resolved: &Resolved, partitions: usize) -> anyhow::Result<String> {
    let pipeline = &resolved.pipeline;
    let mode = pipeline.search.mode.name();
    if !pipeline.has_regions() {
        return Ok(mode.to_owned());
    }
    let mask = resolved.mask()?;
    let far: Vec<_> =
        resolved.high_resolution_tiles.iter().filter(|view| !mask.hides_view(view)).collect();
    let mut text = format!("{mode}, the partitions in turn");
    if let Some(px) = far.iter().map(|view| view.size_px).max() {
        text += &format!(" with {} high-resolution tiles of {px} px", far.len());
    }
    match pipeline.limit() {
        FrameLimit::Time => text += "; of each frame as many as there is time for",
        FrameLimit::Costs => text += "; of each frame as many as fit by stated costs",
        FrameLimit::Unlimited => text += &sweep_of_all(resolved, partitions, far.len()),
    }
    Ok(text)
}

/// Search rate of each part of the sphere, where nothing limits the work on a frame.
fn sweep_of_all(resolved: &Resolved, partitions: usize, far: usize) -> String {
    let each = resolved.roi_options.partitions_per_frame;
    // One view of each kind in turn, until the smaller kind would repeat.
    let frames = |count: usize| if far == 0 { count } else { 2 * count }.div_ceil(each);
    let mut text =
        format!("; of each frame {each}: each partition every {} frames", frames(partitions));
    if far > 0 {
        text += &format!(", each high-resolution tile every {}", frames(far));
    }
    text
}

/// The views that cover the sphere.
fn sphere(resolved: &Resolved) -> String {
    let (pipeline, division) = (&resolved.pipeline, &resolved.division);
    let (partition, views) = (&division.partition, &resolved.partition_views);
    let is_stored = partition::Partition::is_stored(
        pipeline.partition.method.into(),
        partition.len(),
        partition::STORED_SEED,
    );
    format!(
        "{} partitions of {} px: circles of {:.2}° by {:?}, {}; squares of {:.2}° for a margin of {:.2}°",
        partition.len(),
        views.iter().map(|view| view.size_px).max().unwrap_or(0),
        partition.covering_diameter_rad().to_degrees(),
        pipeline.partition.method,
        if is_stored { "stored" } else { "found at the start" },
        division.field_rad.to_degrees(),
        division.margin_rad.to_degrees(),
    )
}
