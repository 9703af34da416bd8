//! Takes over the processes that an earlier launcher left flying (`up --keep`).
//!
//! The folder `kept` of the instance holds the facts that a new launcher cannot read elsewhere: a
//! record of each process ([`flockeye_runtime::kept`]), a memo of each worker
//! ([`crate::process::memo`]), the last hand-over ([`super::hand_over`]), and an unfinished swap
//! ([`super::unfinished_swap`]).

use flockeye_runtime::kept::KeptProcess;

use super::Supervisor;
use super::hand_over::{self, counting_generation, has_taken_over};

impl Supervisor<'_> {
    /// Takes over these processes. Where a worker has two, the one that counts by the last
    /// hand-over stays, and the other is ended.
    pub(crate) fn adopt(&mut self, kept: &[KeptProcess]) -> anyhow::Result<()> {
        if kept.is_empty() {
            return Ok(());
        }
        let folder = self.instance.folder().to_owned();
        let hand_over = hand_over::read(&folder);
        let mut taken = Vec::new();
        for process in &mut self.workers.processes {
            let worker = process.worker;
            process.recall();
            let is_own = |kept: &&KeptProcess| {
                kept.stage == worker.stage.name() && kept.replica == worker.replica
            };
            let (living, dead): (Vec<_>, Vec<_>) =
                kept.iter().filter(is_own).partition(|kept| kept.is_alive(&folder));
            dead.into_iter().for_each(|kept| process.bury(kept));
            let counting = counting_generation(&hand_over, worker).unwrap_or(process.generation);
            let stays = living.iter().find(|kept| kept.generation == counting);
            // After a take-over either process may continue alone; before it only the old one may.
            let stays =
                stays.or(living.last().filter(|_| has_taken_over(&hand_over, worker))).copied();
            if let Some(stays) = stays {
                process.adopt(stays);
                taken.push(format!("{worker} (process {})", stays.pid));
            }
            let others = living.into_iter().filter(|kept| Some(*kept) != stays);
            self.workers.retired.extend(others.map(|kept| process.adopt_retired(kept)));
        }
        // The source also starts by itself, if it has ended meanwhile.
        self.source_started = Some(self.started);
        self.console.line(&format!("takes over {}", taken.join(", ")));
        match &self.ports {
            // Processes that start from now on receive the hand-over from this launcher. It ends
            // when the retired processes have ended.
            Some(ports) => self.hand_over.announce(ports, hand_over),
            None => Ok(()),
        }
    }
}
