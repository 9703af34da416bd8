//! Goes on with the processes that an earlier launcher left flying (`up --keep`).
//!
//! What a launcher knows and its successor cannot see for itself is in the folder `kept` of the instance: a
//! record of each process ([`flockeye_runtime::kept`]), a memo of each worker ([`crate::process::memo`]), the last
//! word on whose messages count, and an unfinished swap ([`super::unfinished`]).

use std::path::{Path, PathBuf};

use flockeye_contract::{HandOver, HandOverState};
use flockeye_runtime::kept::{self, KeptProcess};
use flockeye_runtime::whole_file::write_whole;

use super::Supervisor;
use crate::control::Worker;

impl Supervisor<'_> {
    /// Goes on with these processes. Of two of one worker, the one that counts by the last word stays, and the
    /// other one is ended.
    ///
    /// # Errors
    /// The word cannot be passed on.
    pub(crate) fn adopt(&mut self, kept: &[KeptProcess]) -> anyhow::Result<()> {
        if kept.is_empty() {
            return Ok(());
        }
        let folder = self.instance.folder().to_owned();
        let word = read_word(&folder);
        let mut taken = Vec::new();
        for process in &mut self.processes {
            let worker = process.worker;
            process.recall();
            let is_own = |kept: &&KeptProcess| {
                kept.stage == worker.stage.name() && kept.replica == worker.replica
            };
            let (living, dead): (Vec<_>, Vec<_>) =
                kept.iter().filter(is_own).partition(|kept| kept.is_alive(&folder));
            dead.into_iter().for_each(|kept| process.bury(kept));
            let counting = counting_generation(&word, worker).unwrap_or(process.generation);
            let stays = living.iter().find(|kept| kept.generation == counting);
            // After a take-over either of the two may go on alone; before it only the old one may.
            let stays = stays.or(living.last().filter(|_| has_taken_over(&word, worker))).copied();
            if let Some(stays) = stays {
                process.adopt(stays);
                taken.push(format!("{worker} (process {})", stays.pid));
            }
            let others = living.into_iter().filter(|kept| Some(*kept) != stays);
            self.retired.extend(others.map(|kept| process.adopt_retired(kept)));
        }
        // The source too is started by itself, if it has ended meanwhile.
        self.source_started = Some(self.started);
        self.screen.line(&format!("takes over {}", taken.join(", ")));
        if let Some(ports) = self.ports.take() {
            // Processes that start from now on hear it from this launcher.
            let said = self.announce(&ports, word);
            self.ports = Some(ports);
            said?;
        }
        // Once no other process is left, everybody counts.
        self.awaits_silence = true;
        Ok(())
    }
}

/// The generation of a worker that counts now, by the last word.
pub(super) fn counting_generation(word: &HandOver, worker: Worker) -> Option<u32> {
    if !word.is_about(worker.stage, worker.replica) {
        return None;
    }
    match HandOverState::try_from(word.state) {
        Ok(HandOverState::Shadow) => Some(word.old_generation),
        Ok(HandOverState::TakenOver) => Some(word.new_generation),
        Ok(HandOverState::Nothing) | Err(_) => None,
    }
}

/// Whether the new process of a worker has taken over, by the last word.
pub(super) fn has_taken_over(word: &HandOver, worker: Worker) -> bool {
    word.is_about(worker.stage, worker.replica) && word.state == HandOverState::TakenOver.code()
}

fn word_file(folder: &Path) -> PathBuf {
    kept::folder(folder).join("hand_over")
}

/// Keeps a word for the launcher after this one. It is written before it is said: said twice, it does no harm.
pub(super) fn write_word(folder: &Path, word: &HandOver) {
    if let Err(error) = write_whole(&word_file(folder), bytemuck::bytes_of(word)) {
        tracing::warn!("the hand-over is not kept for a later launcher: {error}");
    }
}

pub(super) fn read_word(folder: &Path) -> HandOver {
    let bytes = std::fs::read(word_file(folder)).unwrap_or_default();
    bytemuck::try_pod_read_unaligned(&bytes).unwrap_or_default()
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
