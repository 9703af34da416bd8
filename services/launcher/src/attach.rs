//! A running pipeline's messages, read beside its stages.

use flockeye_config::Resolved;
use flockeye_runtime::instance::Instance;
use flockeye_runtime::onlooker;
use flockeye_runtime::ports::Ports;
use iceoryx2::prelude::{LogLevel, set_log_level};

pub use flockeye_cli::running::{PipelineChoice, choose};

/// A running pipeline, and the ports that receive its messages.
pub struct Attached {
    /// They receive its messages.
    pub ports: Ports,
    /// Its configuration.
    pub resolved: Resolved,
    /// Its name, folder and owner.
    pub instance: Instance,
}

/// Joins the chosen pipeline.
///
/// # Errors
/// None runs, several do and none was named, or it has no room for another reader.
pub fn attach(running: &PipelineChoice) -> anyhow::Result<Attached> {
    let instance = choose(running)?;
    set_log_level(LogLevel::Fatal);
    let (ports, resolved) = onlooker::join(&instance)?;
    Ok(Attached { ports, resolved, instance })
}
