//! Choice of a running pipeline, and access to its messages.

use anyhow::{Context, bail, ensure};
use clap::Args;
use flockeye_config::Resolved;
use flockeye_runtime::instance::{Instance, service_user};
use flockeye_runtime::onlooker;
use flockeye_runtime::ports::Ports;

/// The argument that chooses a running pipeline.
#[derive(Debug, Clone, Args)]
pub struct PipelineChoice {
    /// Its instance. Without it: the only one that runs.
    #[arg(long, value_name = "NAME")]
    pub instance: Option<String>,
}

/// The chosen pipeline.
///
/// # Errors
/// No pipeline runs, or several run and none was named.
pub fn choose(running: &PipelineChoice) -> anyhow::Result<Instance> {
    let living: Vec<Instance> = Instance::all().into_iter().filter(Instance::is_running).collect();
    let names = living.iter().map(Instance::name).collect::<Vec<_>>().join(", ");
    if let Some(name) = &running.instance {
        let others = if names.is_empty() { "none runs".to_owned() } else { format!("{names} run") };
        let found = living.into_iter().find(|instance| instance.name() == name);
        return found.with_context(|| format!("no pipeline '{name}' runs here; {others}"));
    }
    ensure!(!living.is_empty(), "no pipeline runs here. Cure: {}", where_it_may_be());
    match <[Instance; 1]>::try_from(living) {
        Ok([only]) => Ok(only),
        Err(_) => bail!("several pipelines run here: {names}. Cure: --instance NAME"),
    }
}

/// Joins the chosen pipeline. Returns its instance, its configuration, and ports for its messages.
///
/// # Errors
/// As [`choose`], or it has no room for another reader.
pub fn attach(running: &PipelineChoice) -> anyhow::Result<(Instance, Resolved, Ports)> {
    let instance = choose(running)?;
    let (ports, resolved) = onlooker::join(&instance)?;
    Ok((instance, resolved, ports))
}

/// Cure where this user has no pipeline.
fn where_it_may_be() -> &'static str {
    let own = rustix::process::getuid().as_raw();
    match service_user() {
        Some(user) if user != own => {
            "the service runs as a user of its own: `runuser -u flockeye -- flockeye ...`. Or start one with \
             `flockeye up`"
        }
        _ => "start one with `flockeye up`",
    }
}
