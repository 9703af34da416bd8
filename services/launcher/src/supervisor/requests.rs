//! Does what clients ask for by the control channel.

use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use flockeye_contract::{StageName, StageState};
use flockeye_runtime::ports::Ports;

use super::Supervisor;
use crate::control::server::ClientId;
use crate::control::{Reply, Request, Worker};
use crate::process::Condition;
use crate::status::{PipelineStatus, WorkerStatus};

/// A worker that has not come to what was asked for after this long is reported.
const PATIENCE: Duration = Duration::from_secs(20);

/// A client that waits until a worker is as it was asked to be.
pub(super) struct Pending {
    client: ClientId,
    worker: Worker,
    wanted: Wanted,
    since: Instant,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Wanted {
    Stopped,
    /// Ready, in a generation after this one.
    ReadyAfter(Option<u32>),
}

impl Supervisor<'_> {
    pub(super) fn serve_clients(&mut self, ports: &Ports) -> anyhow::Result<()> {
        for (client, request) in self.server.poll() {
            if let Err(error) = self.serve(client, &request, ports) {
                self.server.reply(client, &Reply::Failed(format!("{error:#}")));
            }
        }
        self.answer_pending();
        self.end_hand_over(ports)
    }

    fn serve(&mut self, client: ClientId, request: &Request, ports: &Ports) -> anyhow::Result<()> {
        match request {
            Request::Status => {
                let status = self.status();
                let (text, report) = (status.to_string(), serde_json::to_value(&status)?);
                self.server.reply(client, &Reply::Done { text, report });
                return Ok(());
            }
            Request::Stop { worker: None } => {
                self.is_asked_to_end = true;
                self.server.reply(client, &Reply::done("the pipeline ends"));
            }
            Request::Stop { worker: Some(worker) } => {
                let index = self.free_index(*worker)?;
                self.processes[index].ask_to_stop();
                self.wait_for(client, *worker, Wanted::Stopped);
            }
            Request::Start { worker } => {
                let index = self.free_index(*worker)?;
                let process = &mut self.processes[index];
                ensure!(process.condition() != Condition::Running, "{worker} runs already");
                process.ask_to_restart();
                self.wait_for(client, *worker, Wanted::ReadyAfter(None));
            }
            Request::Restart { worker } => {
                let index = self.free_index(*worker)?;
                let process = &mut self.processes[index];
                let generation = process.generation;
                process.ask_to_restart();
                self.wait_for(client, *worker, Wanted::ReadyAfter(Some(generation)));
            }
            Request::Swap(request) => self.begin_swap(client, request, ports)?,
        }
        Ok(())
    }

    fn wait_for(&mut self, client: ClientId, worker: Worker, wanted: Wanted) {
        self.pending.push(Pending { client, worker, wanted, since: Instant::now() });
    }

    fn answer_pending(&mut self) {
        for pending in std::mem::take(&mut self.pending) {
            let Pending { client, worker, wanted, since } = pending;
            let Ok(index) = self.index_of(worker) else { continue };
            let process = &self.processes[index];
            let (condition, generation) = (process.condition(), process.generation);
            let pid = process.pid();
            let is_reported = pid.is_some_and(|pid| {
                let dashboard = &self.messages.dashboard;
                dashboard.last_report(worker.stage.name(), worker.replica, pid).is_some()
            });
            let is_reached = match wanted {
                Wanted::Stopped => condition == Condition::Stopped,
                Wanted::ReadyAfter(before) => {
                    before.is_none_or(|before| generation > before)
                        && is_reported
                        && (self.is_ready(worker) || worker.stage.is_source())
                }
            };
            let reply = match wanted {
                _ if !is_reached && since.elapsed() < PATIENCE => {
                    self.pending.push(Pending { client, worker, wanted, since });
                    continue;
                }
                _ if !is_reached => Reply::Failed(format!(
                    "{worker} is not as asked for after {} s: {}",
                    PATIENCE.as_secs(),
                    word(condition)
                )),
                Wanted::Stopped => Reply::done(format!("{worker} has stopped")),
                Wanted::ReadyAfter(_) => {
                    let pid = pid.unwrap_or(0);
                    Reply::done(format!("{worker} runs (process {pid}, generation {generation})"))
                }
            };
            self.server.reply(client, &reply);
        }
    }

    /// The place of a worker in the list of processes.
    pub(super) fn index_of(&self, worker: Worker) -> anyhow::Result<usize> {
        let found = self.processes.iter().position(|process| process.worker == worker);
        found.with_context(|| {
            let names: Vec<String> =
                self.processes.iter().map(|process| process.worker.to_string()).collect();
            format!("{worker} is not part of this pipeline. Parts: {}", names.join(", "))
        })
    }

    /// The same, of a worker that is not being swapped.
    fn free_index(&self, worker: Worker) -> anyhow::Result<usize> {
        ensure!(
            self.is_swapping() != Some(worker),
            "{worker} is being swapped. Cure: wait until that is done"
        );
        self.index_of(worker)
    }

    /// Tells a client, and the log, what has been done so far.
    pub(super) fn say(&mut self, client: ClientId, text: &str) {
        self.screen.line(text);
        self.server.reply(client, &Reply::Progress(text.to_owned()));
    }

    fn status(&self) -> PipelineStatus {
        let workers = self.processes.iter().rev().map(|process| {
            let Worker { stage, replica } = process.worker;
            let pid = process.pid();
            let report =
                pid.and_then(|pid| self.messages.dashboard.last_report(stage.name(), replica, pid));
            let state = match process.condition() {
                Condition::Running => match report.map(|report| StageState::try_from(report.state))
                {
                    Some(Ok(state)) => stage_state_word(state),
                    Some(Err(_)) | None => "starting".to_owned(),
                },
                other => word(other).to_owned(),
            };
            WorkerStatus {
                worker: process.worker,
                state,
                pid,
                generation: process.generation,
                age_s: pid.is_some().then(|| process.age().as_secs_f64()),
                command: process.command().to_vec(),
            }
        });
        let mut workers: Vec<_> = workers.collect();
        let order = |stage: StageName| StageName::ALL.iter().position(|other| *other == stage);
        workers.sort_by_key(|status| (order(status.worker.stage), status.worker.replica));
        PipelineStatus {
            instance: self.instance.name().to_owned(),
            launcher_pid: std::process::id(),
            running_s: self.started.elapsed().as_secs_f64(),
            frames: self.messages.dashboard.frames_ended(),
            swapping: self.is_swapping(),
            workers,
        }
    }
}

fn stage_state_word(state: StageState) -> String {
    let name = serde_json::to_value(state).ok();
    name.as_ref().and_then(|name| name.as_str()).unwrap_or("unknown").to_owned()
}

fn word(condition: Condition) -> &'static str {
    match condition {
        Condition::New => "waits for the others",
        Condition::Running => "runs",
        Condition::Waiting(_) => "is restarted",
        Condition::Resting(_) => "rests",
        Condition::Stopped => "stopped",
        Condition::GivenUp => "given up",
    }
}
