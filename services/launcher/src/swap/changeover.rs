//! What a swap is doing.

use flockeye_config::Pipeline;

use super::judge::Judge;
use super::replacement::Replacement;
use super::shadow::Shadow;
use crate::control::Worker;
use crate::control::server::ClientId;
use crate::process::Process;

/// What the launcher is doing about a swap. One worker at a time is swapped.
#[derive(Default)]
#[expect(clippy::large_enum_variant, reason = "a launcher has one")]
pub(crate) enum Changeover {
    /// No worker is being swapped.
    #[default]
    Nothing,
    /// The new process works beside the old one.
    Beside(SwapOrder, Candidate),
    /// The old process ends first, because the stage owns a device or a port.
    InTurn(SwapOrder, Replacement),
    /// The new process of a swap in turn has failed. The old program is to run again, in a
    /// generation after this one.
    PuttingBack(Worker, u32),
}

/// The client that asked for a swap, and what the swap changes.
pub(crate) struct SwapOrder {
    /// The client that asked for it.
    pub client: ClientId,
    /// Which worker is swapped.
    pub worker: Worker,
    /// The configuration before the swap, if the swap changes it.
    pub pipeline_before: Option<Pipeline>,
}

/// A new process beside the old one.
pub(crate) struct Candidate {
    /// The new process.
    pub process: Process,
    /// What both processes send.
    pub shadow: Shadow,
    /// Decides what is to be done.
    pub judge: Judge,
}

impl Changeover {
    /// The worker that is being swapped.
    pub(crate) fn worker(&self) -> Option<Worker> {
        match self {
            Self::Beside(order, _) | Self::InTurn(order, _) => Some(order.worker),
            Self::Nothing | Self::PuttingBack(..) => None,
        }
    }

    /// The new process that works beside the old one.
    pub(crate) fn candidate(&mut self) -> Option<&mut Process> {
        match self {
            Self::Beside(_, candidate) => Some(&mut candidate.process),
            _ => None,
        }
    }

    /// Whether two processes of a worker run, only one of which counts.
    pub(crate) fn is_beside(&self) -> bool {
        matches!(self, Self::Beside(..))
    }
}
