//! `flockeye up`: runs a pipeline until it ends.

use std::sync::atomic::AtomicBool;

use anyhow::{Context, ensure};
use flockeye_cli::{Configuration, Screen, signals};
use flockeye_config::{Flow, Pipeline, Resolved};
use flockeye_dictionary::Dictionary;
use flockeye_runtime::instance::Instance;
use flockeye_runtime::memory::{Budget, shared_memory_space};
use iceoryx2::prelude::*;

use crate::run_log::{RunOptions, RunSummary};
use crate::supervisor::{Supervisor, unfinished_swap};

pub(crate) fn run(configuration: &Configuration, options: &RunOptions) -> anyhow::Result<()> {
    let stopping = signals::stop_flag()?;
    let pipeline = configuration.load()?;
    run_pipeline(&pipeline, options, &mut Screen::new(), &stopping).map(drop)
}

/// The configuration of stages that fly on. It stays unchanged, whatever `wanted` contains.
fn what_flies(
    instance: &Instance,
    wanted: &Pipeline,
    screen: &mut Screen,
) -> anyhow::Result<Resolved> {
    unfinished_swap::undo(instance)?;
    let flying = instance.pipeline()?;
    let [ours, theirs] = [serde_json::to_value(wanted)?, serde_json::to_value(&flying)?];
    let keys = theirs.as_object().into_iter().flatten();
    let other: Vec<_> = keys.filter(|(key, value)| ours.get(key) != Some(value)).collect();
    if !other.is_empty() {
        let names: Vec<_> = other.iter().map(|(key, _)| key.as_str()).collect();
        screen.line(&format!(
            "what flies has other settings in {}; they stay. Cure: `flockeye swap STAGE --set`, or end it \
             and start anew",
            names.join(", ")
        ));
    }
    Resolved::of(flying).context("the configuration of what flies")
}

/// Runs a pipeline until its source ends, the options end it or `stopping` is raised.
///
/// # Errors
/// As [`run`]; also if it ran for longer than it takes to start, and no frame was searched to its
/// end.
pub(crate) fn run_pipeline(
    pipeline: &Pipeline,
    options: &RunOptions,
    screen: &mut Screen,
    stopping: &AtomicBool,
) -> anyhow::Result<RunSummary> {
    set_log_level(LogLevel::Fatal);
    let resolved = Resolved::of(pipeline.clone())?;
    ensure!(
        !(options.keep && pipeline.flow() == Flow::Lossless),
        "--keep: a lossless run waits for its launcher. Cure: profile: flight"
    );
    // The stages read both. Checking them here reports an error once and first.
    resolved.mask()?;
    Dictionary::of(&resolved.bodies)?;
    let instance = Instance::named(&pipeline.instance.0);
    let (ownership, kept) = match options.keep {
        true => instance.take_over()?,
        false => (instance.take()?, Vec::new()),
    };
    let resolved = match kept.is_empty() {
        true => resolved,
        false => what_flies(&instance, pipeline, screen)?,
    };
    let budget = Budget::of(&resolved);
    if kept.is_empty() {
        let (free, total) = shared_memory_space().context("cannot look at /dev/shm")?;
        budget.check(free, total)?;
        instance.write_configuration(&resolved)?;
    }
    let mut supervisor = Supervisor::new(options, &resolved, &instance, budget, screen)?;
    supervisor.adopt(&kept)?;
    supervisor.start()?;
    let outcome = supervisor.watch(stopping);
    supervisor.stop();
    let had_its_time = supervisor.had_its_time();
    let summary = supervisor.finish(ownership)?;
    outcome?;
    ensure!(
        summary.frames > 0 || !had_its_time,
        "no frame was ever worked on. Cure: the lines above say which stage was not ready or did not \
         answer; `flockeye check` says what the configuration means on this machine"
    );
    Ok(summary)
}
