//! Clients that wait until a worker reaches a requested condition.

use std::time::{Duration, Instant};

use crate::control::server::ClientId;
use crate::control::{Reply, WorkerName};
use crate::process::{Condition, Process};

/// Timeout after which the client gets an error.
const PATIENCE: Duration = Duration::from_secs(20);

/// A client that waits until a worker reaches a requested condition.
pub(super) struct WaitingClient {
    pub client: ClientId,
    pub worker: WorkerName,
    wanted: WorkerGoal,
    since: Instant,
}

/// Requested condition of a worker.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum WorkerGoal {
    Stopped,
    /// The worker is ready, in a generation after this one.
    ReadyAfter(Option<u32>),
}

impl WaitingClient {
    /// A client that waits from now on.
    pub(super) fn new(client: ClientId, worker: WorkerName, wanted: WorkerGoal) -> Self {
        Self { client, worker, wanted, since: Instant::now() }
    }

    /// The reply, if the condition is reached or the time is over. `is_ready`: the worker's process
    /// has reported that it is ready.
    pub(super) fn answer(&self, process: &Process, is_ready: bool) -> Option<Reply> {
        let Self { worker, wanted, since, .. } = self;
        let (condition, generation) = (process.condition(), process.generation);
        let is_reached = match wanted {
            WorkerGoal::Stopped => condition == Condition::Stopped,
            WorkerGoal::ReadyAfter(before) => {
                before.is_none_or(|before| generation > before) && is_ready
            }
        };
        match wanted {
            _ if !is_reached && since.elapsed() < PATIENCE => None,
            _ if !is_reached => Some(Reply::Failed(format!(
                "{worker} is not as asked for after {} s: {}",
                PATIENCE.as_secs(),
                condition_name(condition)
            ))),
            WorkerGoal::Stopped => Some(Reply::done(format!("{worker} has stopped"))),
            WorkerGoal::ReadyAfter(_) => {
                let pid = process.pid().unwrap_or(0);
                let text = format!("{worker} runs (process {pid}, generation {generation})");
                Some(Reply::done(text))
            }
        }
    }
}

/// Condition of a process, in words.
pub(super) fn condition_name(condition: Condition) -> &'static str {
    match condition {
        Condition::New => "waits for the others",
        Condition::Running => "runs",
        Condition::Waiting(_) => "is restarted",
        Condition::Resting(_) => "rests",
        Condition::Stopped => "stopped",
        Condition::GivenUp => "given up",
    }
}
