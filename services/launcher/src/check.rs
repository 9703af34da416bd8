//! `flockeye check`: what a configuration means on this machine, before anything runs.

use std::fmt::Write;
use std::time::Duration;

use anyhow::{Context, ensure};
use flockeye_dictionary::Dictionary;
use flockeye_geometry::partition;
use flockeye_geometry::view::View;
use flockeye_runtime::config::{Count, Flow, Pipeline};
use flockeye_runtime::instance::Instance;
use flockeye_runtime::memory::{Budget, shared_memory_space};

use crate::cli::Check;
use crate::screen::Screen;
use crate::up::{self, Errand};

/// Checks, and prints the plan.
///
/// # Errors
/// Everything that is wrong with the configuration, or memory that is too small.
pub fn run(arguments: &Check) -> anyhow::Result<()> {
    let pipeline = arguments.configuration.load()?;
    let bodies = pipeline.bodies()?;
    Dictionary::of(&bodies)?;
    let budget = Budget::of(&pipeline, pipeline.largest_view_px(bodies.largest_side())?);
    let (free, total) = shared_memory_space().context("cannot look at /dev/shm")?;
    let mut screen = Screen::new();
    screen.line(&plan(&pipeline, &bodies, &budget)?);
    screen.line(&format!("/dev/shm has {:.0} MB free", free as f64 / 1e6));
    budget.check(free, total)?;
    screen.line("everything is in order");
    if let Some(duration) = arguments.measure {
        screen.line(&measured(arguments, duration)?);
    }
    Ok(())
}

/// What a short flight in an instance of its own says of this machine.
fn measured(arguments: &Check, duration: Duration) -> anyhow::Result<String> {
    let own = [format!("instance=m{}", std::process::id()), "gateway.enabled=false".to_owned()];
    let pipeline = arguments.configuration.load_between(&[], &own)?;
    let errand =
        Errand { duration: Some(duration), keeps: true, watches_sweep: true, ..Errand::default() };
    let mut log = Screen::muted();
    let stopping = up::stopped_by_signals()?;
    let flown = up::fly(&pipeline, &errand, &mut log, &stopping)
        .with_context(|| format!("{}the flight to measure this machine", log.kept()))?;
    let frames = flown.frames.len();
    ensure!(
        frames > 1,
        "{}in {:.1} s no two frames were searched. Cure: measure for longer",
        log.kept(),
        duration.as_secs_f64()
    );
    let measured = flown.poses.iter().filter(|row| row.is_measured()).count();
    let mut text = format!(
        "measured {frames} frames, {:.1}/s, with {:.1} neighbours tracked",
        (frames - 1) as f64 / flown.ends_s,
        measured as f64 / frames as f64
    );
    match flown.sweep {
        Some(sweep) => {
            write!(text, ": {sweep}. A newcomer waits as long for its first search")?;
            if pipeline.sweeps_by_turns() {
                text += ", by one of two windows";
            }
        }
        None => write!(text, ": every frame is searched from its beginning")?,
    }
    Ok(text)
}

fn plan(
    pipeline: &Pipeline,
    bodies: &flockeye_geometry::body::Bodies,
    budget: &Budget,
) -> anyhow::Result<String> {
    let mut text = String::new();
    let instance = Instance::named(&pipeline.instance.0);
    let flow = match pipeline.flow {
        Flow::Latest => "latest: the newest frame wins",
        Flow::Lossless => "lossless: every frame is worked on",
    };
    writeln!(text, "instance '{}' in {}", pipeline.instance.0, instance.folder().display())?;
    writeln!(text, "flow     {flow}")?;
    writeln!(text, "source   {} (stage {})", pipeline.source.input, pipeline.source_stage())?;
    let camera = &pipeline.camera;
    let projection = format!("{:?}", camera.projection);
    writeln!(text, "camera   {}x{}, {projection}", camera.width, camera.height)?;
    let mask = pipeline.mask()?;
    let views = pipeline.partition_views(bodies.largest_side())?;
    let hidden = views.iter().filter(|view| mask.hides_view(view)).count();
    if let Some(path) = &camera.mask {
        writeln!(text, "mask     {}", path.display())?;
    }
    if hidden > 0 {
        writeln!(
            text,
            "         the camera sees nothing of {hidden} of {} partitions",
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
    writeln!(text, "search   {}", search(pipeline, views.len() - hidden)?)?;
    writeln!(text, "sphere   {}", sphere(pipeline, &views, bodies.largest_side())?)?;
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
    for (name, stage) in pipeline.stages.iter() {
        let is_used = match name {
            "capture" | "simulator" => name == pipeline.source_stage(),
            "gateway" => pipeline.gateway.enabled,
            _ => true,
        };
        if is_used {
            let command = if stage.command.is_empty() {
                "Flockeye's own".to_owned()
            } else {
                stage.command.join(" ")
            };
            let count = if name == "detection" { pipeline.detection_workers() } else { 1 };
            writeln!(text, "  {name} x {count}: {command}, restart {:?}", stage.restart)?;
        }
    }
    write!(text, "{budget}")?;
    Ok(text)
}

/// How it is searched, and how soon newcomers are found.
fn search(pipeline: &Pipeline, partitions: usize) -> anyhow::Result<String> {
    let mode = format!("{:?}", pipeline.search.mode).to_lowercase();
    if !pipeline.gazes() {
        return Ok(mode);
    }
    let mask = pipeline.mask()?;
    let far_views = pipeline.far_views()?;
    let far: Vec<_> = far_views.iter().filter(|view| !mask.hides_view(view)).collect();
    let each = pipeline.search.lossless_partitions as usize;
    // One of each kind in turn, until the fewer ones come a second time.
    let frames = |count: usize| if far.is_empty() { count } else { 2 * count }.div_ceil(each);
    let mut text = format!("{mode}, the partitions in turn");
    if let Some(px) = far.iter().map(|view| view.size_px).max() {
        text += &format!(" with {} high-resolution tiles of {px} px", far.len());
    }
    text += &format!(
        "; of a lossless frame {each}: each partition every {} frames",
        frames(partitions)
    );
    if !far.is_empty() {
        text += &format!(", each high-resolution tile every {}", frames(far.len()));
    }
    Ok(text)
}

/// What the views that cover the sphere are.
fn sphere(pipeline: &Pipeline, views: &[View], largest_marker_m: f64) -> anyhow::Result<String> {
    let partition = pipeline.sphere_partition()?;
    let is_chosen = matches!(pipeline.partition.count, Count::Chosen(_));
    let seed = u64::from(pipeline.partition.seed);
    let is_stored =
        partition::Partition::is_stored(pipeline.partition.method.into(), partition.len(), seed);
    Ok(format!(
        "{} partitions of {} px{}: circles of {:.2}° by {:?}, {}; squares of {:.2}° for a margin of {:.2}°",
        partition.len(),
        views.iter().map(|view| view.size_px).max().unwrap_or(0),
        if is_chosen { " (chosen by partition.weights)" } else { "" },
        partition.covering_diameter_rad().to_degrees(),
        pipeline.partition.method,
        if is_stored { "stored".to_owned() } else { format!("found from seed {seed}") },
        pipeline.partition_field_rad(largest_marker_m)?.to_degrees(),
        pipeline.partition_margin_rad(largest_marker_m).to_degrees(),
    ))
}
