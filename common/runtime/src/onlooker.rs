//! Access of tools to a running pipeline's messages.

use anyhow::anyhow;
use iceoryx2::prelude::{LogLevel, set_log_level};

use crate::health::SharedCounters;
use crate::instance::Instance;
use crate::memory::Budget;
use crate::ports::Ports;
use flockeye_config::Resolved;

/// Joins a running pipeline, whose launcher has written its files. Returns ports to receive its
/// messages, and its resolved configuration. It sets iceoryx2's log level for the whole process.
///
/// # Errors
/// A file of the pipeline cannot be read, has changed or is missing. Or there is no room, or no
/// permission.
pub fn join(instance: &Instance) -> anyhow::Result<(Ports, Resolved)> {
    set_log_level(LogLevel::Fatal);
    let name = instance.name();
    let resolved = Resolved::of(instance.pipeline()?).map_err(|reason| {
        anyhow!("the configuration of the instance '{name}' is no longer valid: {reason}")
    })?;
    let node = instance.create_node("onlooker", &format!("cannot join the instance '{name}'"))?;
    let budget = Budget::of(&resolved);
    Ok((Ports::new(node, budget, SharedCounters::default()), resolved))
}
