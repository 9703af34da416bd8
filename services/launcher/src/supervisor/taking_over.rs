//! Goes on with the processes that an earlier launcher left flying (`up --keep`).
//!
//! What a launcher knows and its successor cannot see for itself is in the folder `kept` of the instance: a
//! record of each process ([`flockeye_runtime::kept`]), the last word on whose messages count, the settings
//! before an unfinished swap, and a mark for each worker that was stopped on demand.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use anyhow::Context;
use flockeye_contract::{HandOver, HandOverState};
use flockeye_runtime::instance::Instance;
use flockeye_runtime::kept::{self, KeptProcess};

use super::Supervisor;
use crate::control::Worker;
use crate::process::Condition;

impl Supervisor<'_> {
    /// Goes on with these processes. Of two of one worker, the one that counts by the last word stays, and the
    /// other one is ended.
    ///
    /// # Errors
    /// The word cannot be passed on.
    pub fn adopt(&mut self, kept: &[KeptProcess]) -> anyhow::Result<()> {
        if kept.is_empty() {
            return Ok(());
        }
        let folder = self.instance.folder().to_owned();
        let word = read_word(&folder);
        let mut taken = Vec::new();
        for process in &mut self.processes {
            let worker = process.worker;
            if is_marked_stopped(&folder, worker) {
                process.ask_to_stop();
            }
            let is_own = |kept: &&KeptProcess| {
                kept.stage == worker.stage.name() && kept.replica == worker.replica
            };
            let (living, dead): (Vec<_>, Vec<_>) =
                kept.iter().filter(is_own).partition(|kept| kept.is_alive(&folder));
            dead.into_iter().for_each(|kept| process.adopt(kept));
            let counting = counting_generation(&word, worker);
            let counts = |kept: &&&KeptProcess| Some(kept.generation) == counting;
            let Some(&stays) = living.iter().find(counts).or(living.last()) else { continue };
            process.adopt(stays);
            taken.push(format!("{worker} (process {})", stays.pid));
            let others = living.into_iter().filter(|kept| *kept != stays);
            self.retired.extend(others.map(|kept| process.adopt_retired(kept)));
        }
        let source = self.processes.iter().find(|process| process.worker.stage.is_source());
        if source.is_some_and(|source| source.condition() == Condition::Running) {
            self.source_started = Some(self.started);
        }
        self.screen.line(&format!("takes over {}", taken.join(", ")));
        if let Some(ports) = self.ports.take() {
            // Processes that start from now on hear it from this launcher.
            self.announce(&ports, word)?;
            self.ports = Some(ports);
        }
        // Once no other process is left, everybody counts.
        self.awaits_silence = true;
        Ok(())
    }

    /// Notes whether a worker is stopped on demand, for the launcher after this one.
    pub(super) fn mark_stopped(&self, worker: Worker, is_stopped: bool) {
        if !self.is_kept {
            return;
        }
        let mark = stop_mark(self.instance.folder(), worker);
        let marked = match is_stopped {
            true => std::fs::write(&mark, ""),
            false => std::fs::remove_file(&mark),
        };
        if let Err(error) = marked
            && error.kind() != ErrorKind::NotFound
        {
            tracing::warn!("{}: {error}", mark.display());
        }
    }
}

/// The generation of a worker that counts now, by the last word.
fn counting_generation(word: &HandOver, worker: Worker) -> Option<u32> {
    if !word.is_about(worker.stage, worker.replica) {
        return None;
    }
    match HandOverState::try_from(word.state) {
        Ok(HandOverState::Shadow) => Some(word.old_generation),
        Ok(HandOverState::TakenOver) => Some(word.new_generation),
        Ok(HandOverState::Nothing) | Err(_) => None,
    }
}

fn stop_mark(folder: &Path, worker: Worker) -> PathBuf {
    kept::folder(folder).join(format!("{worker}.stopped"))
}

fn is_marked_stopped(folder: &Path, worker: Worker) -> bool {
    stop_mark(folder, worker).exists()
}

fn word_file(folder: &Path) -> PathBuf {
    kept::folder(folder).join("hand_over")
}

/// Keeps a word for the launcher after this one. It is written before it is said: said twice, it does no harm.
pub(super) fn write_word(folder: &Path, word: &HandOver) -> anyhow::Result<()> {
    let file = word_file(folder);
    write_whole(&file, bytemuck::bytes_of(word)).with_context(|| format!("{}", file.display()))
}

fn read_word(folder: &Path) -> HandOver {
    let bytes = std::fs::read(word_file(folder)).unwrap_or_default();
    bytemuck::try_pod_read_unaligned(&bytes).unwrap_or_default()
}

fn write_whole(file: &Path, bytes: &[u8]) -> std::io::Result<()> {
    let fresh = file.with_extension("new");
    std::fs::write(&fresh, bytes)?;
    std::fs::rename(fresh, file)
}

fn settings_before(folder: &Path) -> PathBuf {
    kept::folder(folder).join("settings_before")
}

/// Keeps the configuration of before a swap, until the new process has taken over.
pub(super) fn keep_settings(folder: &Path) -> anyhow::Result<()> {
    let now = folder.join("pipeline.json");
    std::fs::copy(&now, settings_before(folder)).with_context(|| format!("{}", now.display()))?;
    Ok(())
}

/// The swap for which the settings were kept is over.
pub(super) fn forget_settings(folder: &Path) {
    // Without one there is nothing to forget.
    drop(std::fs::remove_file(settings_before(folder)));
}

/// Goes back to the settings of before a swap whose new process had not taken over.
///
/// # Errors
/// The configuration cannot be written.
pub fn undo_unfinished_swap(instance: &Instance) -> anyhow::Result<()> {
    let folder = instance.folder();
    let before = settings_before(folder);
    if read_word(folder).state != HandOverState::TakenOver.code() && before.exists() {
        let now = folder.join("pipeline.json");
        std::fs::rename(&before, &now).with_context(|| format!("{}", now.display()))?;
    }
    forget_settings(folder);
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_word_says_which_of_two_processes_counts() {
        let word = |state: HandOverState, [old_generation, new_generation]: [u32; 2]| HandOver {
            stage: "fusion".into(),
            state: state.code(),
            old_generation,
            new_generation,
            ..HandOver::default()
        };
        let fusion = "fusion".parse().unwrap();
        for (said, wanted) in [
            (word(HandOverState::Shadow, [1, 2]), Some(1)),
            (word(HandOverState::TakenOver, [1, 2]), Some(2)),
            (word(HandOverState::TakenOver, [2, 1]), Some(1)),
            (HandOver::default(), None),
        ] {
            assert_eq!(counting_generation(&said, fusion), wanted);
            assert_eq!(counting_generation(&said, "detection".parse().unwrap()), None);
        }
    }
}
