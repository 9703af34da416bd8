//! Processes that fly on when their launcher dies (`up --keep`): their leftovers, and how a later
//! launcher takes them over.

use std::fs::File;
use std::time::Instant;

use flockeye_runtime::kept::{self, KeptProcess};

use super::child::RunningProcess;
use super::memo::Memo;
use super::output::KeptOutput;
use super::{Condition, EndRequest, Process};

impl Process {
    /// Restores the program and the generation count of an earlier launcher. A process that was not
    /// ended on request starts at the next opportunity.
    pub(crate) fn recall(&mut self) {
        self.condition = Condition::Waiting(Instant::now());
        let Some(memo) = Memo::read(&self.start.folder, self.worker) else { return };
        self.used_generations = memo.used_generations;
        self.generation = memo.counting_generation;
        self.start.program = memo.command;
        if memo.is_stopped {
            self.condition = Condition::Stopped;
        }
    }

    /// Shows the output that a process of an earlier launcher wrote before its end, and removes its
    /// leftovers.
    pub(crate) fn bury(&self, kept: &KeptProcess) {
        if let Ok(mut output) = KeptOutput::open(&kept.output(&self.start.folder)) {
            output.forward_rest(&self.lines).ok();
        }
        kept.forget(&self.start.folder);
    }

    /// Takes over a living process of an earlier launcher.
    pub(crate) fn adopt(&mut self, kept: &KeptProcess) {
        self.used_generations = self.used_generations.max(kept.generation);
        // It lived a moment ago. If it has ended since, it is started again.
        let Ok(child) = RunningProcess::adopt(kept.pid) else { return };
        self.generation = kept.generation;
        self.start.program = kept.command.clone();
        self.child = Some(child);
        self.kept_output = self.open_kept_output();
        self.condition = Condition::Running;
        self.remember();
    }

    /// Takes over another living process of this worker, which does not count any more and must
    /// end.
    pub(crate) fn adopt_retired(&mut self, kept: &KeptProcess) -> Self {
        let mut retired = self.beside(kept.generation, &kept.command, "old");
        retired.adopt(kept);
        retired.ask_to_stop();
        self.used_generations = self.used_generations.max(kept.generation);
        retired
    }

    /// Writes the memo for a later launcher. A failure costs only the memo.
    pub(super) fn remember(&self) {
        let memo = Memo {
            used_generations: self.used_generations,
            counting_generation: self.generation,
            command: self.start.program.clone(),
            is_stopped: self.end_request == EndRequest::Stop
                || self.condition == Condition::Stopped,
        };
        if self.is_remembered
            && let Err(error) = memo.write(&self.start.folder, self.worker)
        {
            tracing::warn!("{}: a later launcher will not know it: {error}", self.worker);
        }
    }

    /// Its record and its output, if it flies on when the launcher dies.
    fn record(&self) -> KeptProcess {
        KeptProcess {
            stage: self.worker.stage.name().to_owned(),
            replica: self.worker.replica,
            generation: self.generation,
            pid: self.pid().unwrap_or(0),
            command: self.start.program.clone(),
        }
    }

    pub(super) fn create_kept_output(&self) -> std::io::Result<File> {
        std::fs::create_dir_all(kept::folder(&self.start.folder))?;
        File::options().append(true).create(true).open(self.record().output(&self.start.folder))
    }

    pub(super) fn open_kept_output(&self) -> Option<KeptOutput> {
        let path = self.record().output(&self.start.folder);
        KeptOutput::open(&path)
            .inspect_err(|error| tracing::warn!("the output of {}: {error}", self.label()))
            .ok()
    }

    /// Forwards the output of a kept process.
    pub(super) fn forward_kept_output(&mut self) {
        if let Some(output) = &mut self.kept_output
            && let Err(error) = output.forward(&self.lines)
        {
            tracing::warn!("the output of {}: {error}", self.lines.label());
            self.kept_output = None;
        }
    }

    /// Removes the leftovers of a kept process.
    pub(super) fn forget_kept(&mut self) {
        if let Some(mut output) = self.kept_output.take() {
            output.forward_rest(&self.lines).ok();
        }
        if self.start.is_kept {
            self.record().forget(&self.start.folder);
        }
    }
}
