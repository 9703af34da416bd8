//! The processes of all workers.

use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant};

use anyhow::Context;
use flockeye_config::Pipeline;
use flockeye_contract::StageName;
use flockeye_runtime::instance::Instance;
use rustix::process::Signal;

use super::console::Console;
use crate::control::WorkerName;
use crate::process::{Condition, LogLine, Process, STOP_TIME};

/// The processes of a pipeline's workers.
pub(super) struct Workers {
    /// One process for each worker, the source last.
    pub processes: Vec<Process>,
    /// Processes that were replaced and have not ended.
    pub retired: Vec<Process>,
}

impl Workers {
    /// Creates the workers of `pipeline`, not yet started. Their lines go to `log`. With `is_kept`
    /// they fly on when the launcher dies.
    pub(super) fn prepare(
        pipeline: &Pipeline,
        instance: &Instance,
        log: &SyncSender<LogLine>,
        is_kept: bool,
    ) -> anyhow::Result<Self> {
        // Order against the dataflow, so that a subscriber exists before its publisher.
        let stages = StageName::ALL.into_iter().rev().filter(|stage| !stage.is_source());
        let workers = stages
            .filter(|&stage| pipeline.runs(stage))
            .flat_map(|stage| (0..pipeline.replicas(stage)).map(move |replica| (stage, replica)))
            .chain([(pipeline.source.stage(), 0)]);
        let processes = workers.map(|(stage, replica)| {
            let configuration = pipeline.stages.of(stage);
            let worker = WorkerName { stage, replica };
            Process::new(worker, configuration, instance.folder(), log.clone(), is_kept)
        });
        Ok(Self { processes: processes.collect::<anyhow::Result<_>>()?, retired: Vec::new() })
    }

    /// Starts the consumers that do not run yet.
    pub(super) fn start_consumers(&mut self) -> anyhow::Result<()> {
        let new = self.processes.iter_mut().filter(|process| {
            !process.worker.stage.is_source() && process.condition() == Condition::New
        });
        new.into_iter().try_for_each(Process::start)
    }

    /// Starts the source if it does not run yet.
    pub(super) fn start_source(&mut self) -> anyhow::Result<()> {
        let is_new = |process: &&mut Process| {
            process.worker.stage.is_source() && process.condition() == Condition::New
        };
        self.processes.iter_mut().find(is_new).map_or(Ok(()), Process::start)
    }

    /// Index of a worker in the list of processes.
    pub(super) fn index_of(&self, worker: WorkerName) -> anyhow::Result<usize> {
        let found = self.processes.iter().position(|process| process.worker == worker);
        found.with_context(|| {
            let names: Vec<String> =
                self.processes.iter().map(|process| process.worker.to_string()).collect();
            format!("{worker} is not part of this pipeline. Parts: {}", names.join(", "))
        })
    }

    pub(super) fn of(&self, worker: WorkerName) -> anyhow::Result<&Process> {
        Ok(&self.processes[self.index_of(worker)?])
    }

    pub(super) fn of_mut(&mut self, worker: WorkerName) -> anyhow::Result<&mut Process> {
        let index = self.index_of(worker)?;
        Ok(&mut self.processes[index])
    }

    /// Whether an operator has ended a worker.
    pub(super) fn has_stopped(&self) -> bool {
        self.processes.iter().any(|process| process.condition() == Condition::Stopped)
    }

    /// Ends all processes, and those in `others`: first by SIGTERM, then by SIGKILL.
    pub(super) fn stop<'p>(
        &'p mut self,
        others: impl IntoIterator<Item = &'p mut Process>,
        console: &mut Console<'_>,
    ) {
        let own = self.processes.iter_mut().chain(&mut self.retired);
        let mut processes: Vec<_> = own.chain(others).collect();
        processes.iter().for_each(|process| process.signal(Signal::TERM));
        let deadline = Instant::now() + STOP_TIME;
        while Instant::now() < deadline && !processes.iter_mut().all(|process| process.has_ended())
        {
            std::thread::sleep(Duration::from_millis(5));
        }
        for process in &mut processes {
            if !process.has_ended() {
                console.line(&format!("{} does not stop and is killed", process.label()));
                process.signal(Signal::KILL);
                while !process.has_ended() {
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
        }
    }
}
