//! Reading a running pipeline's messages beside its stages.

use std::rc::Rc;

use iceoryx2::prelude::{NodeBuilder, NodeName, SignalHandlingMode, ipc};

use crate::health::SharedCounters;
use crate::instance::{Instance, InstanceError};
use crate::memory::Budget;
use crate::ports::Ports;
use flockeye_config::Pipeline;

/// Why a pipeline could not be joined.
#[derive(Debug, thiserror::Error)]
pub enum JoinError {
    /// Its files cannot be read.
    #[error(transparent)]
    Instance(#[from] InstanceError),
    /// Its configuration is none any more: a file that it names has changed or gone.
    #[error("the configuration of the instance '{instance}' cannot be followed: {reason}")]
    Configuration {
        /// The instance.
        instance: String,
        /// What is wrong.
        reason: String,
    },
    /// There is no room, or no permission.
    #[error("cannot join the instance '{instance}': {reason}")]
    Node {
        /// The instance.
        instance: String,
        /// What iceoryx2 says.
        reason: String,
    },
}

/// Joins a pipeline whose launcher has written what there is to read: gives what its messages are
/// received with, and its configuration.
///
/// # Errors
/// [`JoinError`].
pub fn join(instance: &Instance) -> Result<(Ports, Pipeline), JoinError> {
    let pipeline = instance.pipeline()?;
    let unfit =
        |reason: String| JoinError::Configuration { instance: instance.name().to_owned(), reason };
    let bodies = pipeline.bodies().map_err(|error| unfit(error.to_string()))?;
    let largest_view_px = pipeline
        .largest_view_px(bodies.largest_side())
        .map_err(|error| unfit(error.to_string()))?;
    let apart = |reason: String| JoinError::Node { instance: instance.name().to_owned(), reason };
    let node = NodeBuilder::new()
        .name(&NodeName::new("onlooker").map_err(|error| apart(format!("{error:?}")))?)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .config(&instance.iceoryx2()?)
        .create::<ipc::Service>()
        .map_err(|error| apart(format!("{error:?}")))?;
    let budget = Budget::of(&pipeline, largest_view_px);
    Ok((Ports::new(Rc::new(node), budget, SharedCounters::default()), pipeline))
}
