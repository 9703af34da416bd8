//! An unfinished swap, kept for a later launcher, which restores the state before it.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use flockeye_config::{Pipeline, Resolved};
use flockeye_contract::HandOver;
use flockeye_runtime::instance::Instance;
use flockeye_runtime::kept::{self, KeptProcess};
use flockeye_runtime::whole_file::write_whole;
use rustix::process::{Pid, Signal, kill_process_group};
use serde::{Deserialize, Serialize};

use super::hand_over::{self, counting_generation, has_taken_over};
use crate::control::WorkerName;
use crate::process::KILL_TIME;
use crate::process::memo::Memo;
use crate::swap::shadow::can_shadow;

/// A swap that is not over.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct UnfinishedSwap {
    pub worker: WorkerName,
    pub old_generation: u32,
    /// The program before the swap.
    pub old_command: Vec<String>,
    /// The configuration before the swap, if the swap changes it.
    pub pipeline: Option<Pipeline>,
}

fn file(folder: &Path) -> PathBuf {
    kept::folder(folder).join("unfinished_swap")
}

impl UnfinishedSwap {
    /// Writes the file, which stays until [`forget`].
    pub(crate) fn keep(&self, folder: &Path) -> anyhow::Result<()> {
        let file = file(folder);
        write_whole(&file, &serde_json::to_vec(self)?)
            .with_context(|| format!("{}", file.display()))
    }

    /// Whether the new process stays.
    fn has_succeeded(&self, hand_over: &HandOver) -> bool {
        // A process that owns a device had to prove that it works, and no launcher has seen that.
        can_shadow(self.worker.stage)
            && has_taken_over(hand_over, self.worker)
            && counting_generation(hand_over, self.worker) > Some(self.old_generation)
    }

    /// Ends the new process of a stage that owns a device. The next start runs the old program.
    fn put_back_program(&self, folder: &Path) -> anyhow::Result<()> {
        let is_new = |kept: &KeptProcess| {
            kept.stage == self.worker.stage.name()
                && kept.replica == self.worker.replica
                && kept.generation > self.old_generation
        };
        for new in kept::living(folder).iter().filter(|kept| is_new(kept)) {
            if let Some(pid) = i32::try_from(new.pid).ok().and_then(Pid::from_raw) {
                // The process may end by itself meanwhile.
                kill_process_group(pid, Signal::KILL).ok();
            }
            let start = Instant::now();
            while new.is_alive(folder) {
                ensure!(start.elapsed() < KILL_TIME, "process {} does not end", new.pid);
                std::thread::sleep(Duration::from_millis(10));
            }
        }
        if let Some(memo) = Memo::read(folder, self.worker) {
            let memo = Memo { command: self.old_command.clone(), ..memo };
            memo.write(folder, self.worker).context("what is known of its worker")?;
        }
        Ok(())
    }
}

/// Removes the file: the swap is over.
pub(super) fn forget(folder: &Path) {
    // Without a swap there is no file.
    drop(std::fs::remove_file(file(folder)));
}

/// Restores the state before an unfinished swap, unless its new process is the one that stays.
pub(crate) fn undo(instance: &Instance) -> anyhow::Result<()> {
    let folder = instance.folder();
    let swap = std::fs::read(file(folder)).ok();
    let swap = swap.and_then(|json| serde_json::from_slice::<UnfinishedSwap>(&json).ok());
    if let Some(swap) = swap.filter(|swap| !swap.has_succeeded(&hand_over::read(folder))) {
        if !can_shadow(swap.worker.stage) {
            swap.put_back_program(folder)?;
        }
        if let Some(pipeline) = swap.pipeline {
            instance.write_configuration(&Resolved::of(pipeline)?)?;
        }
    }
    forget(folder);
    Ok(())
}
