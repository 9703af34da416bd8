//! Processes that fly on when their launcher dies (`up --keep`): what is left of them, and how a
//! later launcher goes on with them.

use std::fs::File;
use std::time::Instant;

use flockeye_runtime::kept::{self, KeptProcess};

use super::child::RunningProcess;
use super::memo::Memo;
use super::output::KeptOutput;
use super::{Condition, EndRequest, Process};

impl Process {
    /// Goes on where an earlier launcher was: with its program and its count of generations. It is
    /// started at the next opportunity if it was not ended on demand.
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

    /// Shows what a process of an earlier launcher has written before it ended, and removes what it
    /// left.
    pub(crate) fn bury(&self, kept: &KeptProcess) {
        if let Ok(mut output) = KeptOutput::open(&kept.output(&self.start.folder)) {
            output.forward_rest(&self.lines).ok();
        }
        kept.forget(&self.start.folder);
    }

    /// Goes on with a living process that an earlier launcher has left.
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

    /// Goes on with another living process of this worker, which does not count any more and is to
    /// end.
    pub(crate) fn adopt_retired(&mut self, kept: &KeptProcess) -> Self {
        let mut retired = self.beside(kept.generation, &kept.command, "old");
        retired.adopt(kept);
        retired.ask_to_stop();
        self.used_generations = self.used_generations.max(kept.generation);
        retired
    }

    /// Notes for a later launcher what it cannot see for itself. What cannot be noted costs no more
    /// than that.
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

    /// Passes on what a process that is kept has written.
    pub(super) fn forward_kept_output(&mut self) {
        if let Some(output) = &mut self.kept_output
            && let Err(error) = output.forward(&self.lines)
        {
            tracing::warn!("the output of {}: {error}", self.lines.label());
            self.kept_output = None;
        }
    }

    /// Removes what a process that was kept has left behind.
    pub(super) fn forget_kept(&mut self) {
        if let Some(mut output) = self.kept_output.take() {
            output.forward_rest(&self.lines).ok();
        }
        if self.start.is_kept {
            self.record().forget(&self.start.folder);
        }
    }
}
