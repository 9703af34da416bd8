//! State of a swap.

use flockeye_config::Pipeline;

use super::judge::Judge;
use super::replacement::Replacement;
use super::shadow::Shadow;
use crate::control::WorkerName;
use crate::control::server::ClientId;
use crate::process::Process;

/// State of the current swap. One worker at a time is swapped.
#[derive(Default)]
#[expect(clippy::large_enum_variant, reason = "a launcher has one")]
pub(crate) enum Changeover {
    #[default]
    Nothing,
    /// The new process works beside the old one.
    Beside {
        order: SwapOrder,
        process: Process,
        /// Messages of both processes.
        shadow: Shadow,
        judge: Judge,
    },
    /// The old process ends first, because the stage owns a device or a port.
    InTurn(SwapOrder, Replacement),
    /// The new process of a swap in turn has failed. The old program is to run again, in a
    /// generation after this one.
    PuttingBack(WorkerName, u32),
}

/// Client and worker of a swap, and the configuration before it.
pub(crate) struct SwapOrder {
    pub client: ClientId,
    pub worker: WorkerName,
    /// The configuration before the swap, if the swap changes it.
    pub pipeline_before: Option<Pipeline>,
}

impl Changeover {
    /// The worker that is being swapped.
    pub(crate) fn worker(&self) -> Option<WorkerName> {
        match self {
            Self::Beside { order, .. } | Self::InTurn(order, _) => Some(order.worker),
            Self::Nothing | Self::PuttingBack(..) => None,
        }
    }

    /// The new process that works beside the old one.
    pub(crate) fn new_process(&mut self) -> Option<&mut Process> {
        match self {
            Self::Beside { process, .. } => Some(process),
            _ => None,
        }
    }
}
