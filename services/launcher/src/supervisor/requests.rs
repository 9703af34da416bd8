//! Requests of clients over the control channel.

use anyhow::ensure;
use flockeye_contract::{StageName, StageState};
use flockeye_runtime::ports::Ports;

use super::Supervisor;
use super::waiting_client::{WaitingClient, WorkerGoal, condition_name};
use crate::control::server::ClientId;
use crate::control::{ControlRequest, Reply, WorkerName};
use crate::process::{Condition, Process};
use crate::status::{PipelineStatus, WorkerStatus};

impl Supervisor<'_> {
    pub(super) fn serve_clients(&mut self, ports: &Ports) -> anyhow::Result<()> {
        for (client, request) in self.server.poll() {
            if let Err(error) = self.serve(client, &request, ports) {
                self.server.reply(client, &Reply::Failed(format!("{error:#}")));
            }
        }
        self.answer_waiting_clients();
        Ok(())
    }

    fn serve(
        &mut self,
        client: ClientId,
        request: &ControlRequest,
        ports: &Ports,
    ) -> anyhow::Result<()> {
        match request {
            ControlRequest::Status => {
                let status = self.status();
                let (text, report) = (status.to_string(), serde_json::to_value(&status)?);
                self.server.reply(client, &Reply::Done { text, report });
                return Ok(());
            }
            ControlRequest::Stop { worker: None } => {
                self.is_asked_to_end = true;
                self.server.reply(client, &Reply::done("the pipeline ends"));
            }
            ControlRequest::Stop { worker: Some(worker) } => {
                self.free_process(*worker)?.ask_to_stop();
                self.wait_for(client, *worker, WorkerGoal::Stopped);
            }
            ControlRequest::Start { worker } => {
                let process = self.free_process(*worker)?;
                ensure!(process.condition() != Condition::Running, "{worker} runs already");
                process.ask_to_restart();
                self.wait_for(client, *worker, WorkerGoal::ReadyAfter(None));
            }
            ControlRequest::Restart { worker } => {
                let process = self.free_process(*worker)?;
                let generation = process.generation;
                process.ask_to_restart();
                self.wait_for(client, *worker, WorkerGoal::ReadyAfter(Some(generation)));
            }
            ControlRequest::Swap(request) => self.begin_swap(client, request, ports)?,
        }
        Ok(())
    }

    fn wait_for(&mut self, client: ClientId, worker: WorkerName, wanted: WorkerGoal) {
        self.waiting_clients.push(WaitingClient::new(client, worker, wanted));
    }

    fn answer_waiting_clients(&mut self) {
        for client in std::mem::take(&mut self.waiting_clients) {
            let worker = client.worker;
            let Ok(process) = self.workers.of(worker) else { continue };
            let is_ready = self.messages.has_reported(worker, process.pid())
                && (self.messages.is_ready(worker) || worker.stage.is_source());
            match client.answer(process, is_ready) {
                Some(reply) => self.server.reply(client.client, &reply),
                None => self.waiting_clients.push(client),
            }
        }
    }

    /// The process of a worker that is not being swapped.
    fn free_process(&mut self, worker: WorkerName) -> anyhow::Result<&mut Process> {
        ensure!(
            self.changeover.worker() != Some(worker),
            "{worker} is being swapped. Cure: wait until that is done"
        );
        self.workers.of_mut(worker)
    }

    /// Shows the progress, and sends it to a client.
    pub(super) fn report_step(&mut self, client: ClientId, text: &str) {
        self.console.line(text);
        self.server.reply(client, &Reply::Progress(text.to_owned()));
    }

    fn status(&self) -> PipelineStatus {
        let workers = self.workers.processes.iter().rev().map(|process| {
            let WorkerName { stage, replica } = process.worker;
            let pid = process.pid();
            let report =
                pid.and_then(|pid| self.messages.dashboard.last_report(stage.name(), replica, pid));
            let state = match process.condition() {
                Condition::Running => match report.map(|report| StageState::try_from(report.state))
                {
                    Some(Ok(state)) => state_name(state),
                    Some(Err(_)) | None => "starting".to_owned(),
                },
                other => condition_name(other).to_owned(),
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
            frames: self.messages.dashboard.frames_ended,
            swapping: self.changeover.worker(),
            workers,
        }
    }
}

/// A state in the spelling of JSON.
fn state_name(state: StageState) -> String {
    let name = serde_json::to_value(state).ok();
    name.as_ref().and_then(|name| name.as_str()).unwrap_or("unknown").to_owned()
}
