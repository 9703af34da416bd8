//! Reading a running pipeline's messages beside its stages.

use std::rc::Rc;

use iceoryx2::node::NodeCreationFailure;
use iceoryx2::prelude::{LogLevel, NodeBuilder, NodeName, SignalHandlingMode, ipc, set_log_level};

use crate::health::SharedCounters;
use crate::instance::{Instance, InstanceError};
use crate::memory::Budget;
use crate::ports::Ports;
use flockeye_config::{ResolveError, Resolved};

/// Why a pipeline could not be joined.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// Its files cannot be read.
    #[error(transparent)]
    Instance(#[from] InstanceError),
    /// Its configuration is no longer valid: a file that it names has changed or is missing.
    #[error("the configuration of the instance '{instance}' is no longer valid: {reason}")]
    Configuration {
        /// The instance.
        instance: String,
        /// What is wrong.
        reason: ResolveError,
    },
    /// There is no room, or no permission.
    #[error("cannot join the instance '{instance}': {reason:?}")]
    Node {
        /// The instance.
        instance: String,
        /// iceoryx2's reason.
        reason: NodeCreationFailure,
    },
}

/// Joins a running pipeline, whose launcher has written its files. Returns ports to receive its
/// messages, and its resolved configuration. It sets iceoryx2's log level for the whole process.
///
/// # Errors
/// [`JoinError`].
pub fn join(instance: &Instance) -> Result<(Ports, Resolved), JoinError> {
    set_log_level(LogLevel::Fatal);
    let name = || instance.name().to_owned();
    let resolved = Resolved::of(instance.pipeline()?)
        .map_err(|reason| JoinError::Configuration { instance: name(), reason })?;
    let mut node = NodeBuilder::new()
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .config(&instance.iceoryx2()?);
    if let Ok(name) = NodeName::new("onlooker") {
        node = node.name(&name);
    }
    let node = node
        .create::<ipc::Service>()
        .map_err(|reason| JoinError::Node { instance: name(), reason })?;
    let budget = Budget::of(&resolved);
    Ok((Ports::new(Rc::new(node), budget, SharedCounters::default()), resolved))
}
