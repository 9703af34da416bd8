//! A disturbance of a process.

use std::time::Duration;

use anyhow::Context;
use clap::ValueEnum;
use rustix::process::{Pid, Signal, kill_process};
use serde::Serialize;

use crate::dice::Dice;
use flockeye_launcher::control::WorkerName;

/// A kind of disturbance.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, ValueEnum, Serialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum DisturbanceKind {
    /// SIGKILL.
    Kill,
    /// SIGSTOP, and SIGCONT up to two seconds later.
    Stop,
    /// Stopped half of the time for a second.
    Slow,
    /// Swapped for the same program.
    Swap,
}

/// One disturbance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Disturbance {
    /// The kind of disturbance.
    pub kind: DisturbanceKind,
    /// The disturbed worker.
    pub worker: WorkerName,
    /// Process number of the worker.
    pub pid: i32,
    /// Duration of the disturbance.
    pub lasts: Duration,
}

/// Time for which a slowed process alternately runs and is stopped.
const SLOW_TURN: Duration = Duration::from_millis(25);

impl Disturbance {
    /// Disturbs the process, calling `wait` in between.
    ///
    /// # Errors
    /// An error of `wait`, or the process has ended by itself.
    pub(crate) fn strike(
        &self,
        mut wait: impl FnMut(Duration) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        let pid = Pid::from_raw(self.pid).context("no process has number 0")?;
        let send = |signal| kill_process(pid, signal).context("the process has ended");
        match self.kind {
            DisturbanceKind::Kill => send(Signal::KILL),
            DisturbanceKind::Stop => {
                send(Signal::STOP)?;
                wait(self.lasts)?;
                // An error is ignored: the process may have been replaced meanwhile.
                drop(send(Signal::CONT));
                Ok(())
            }
            DisturbanceKind::Slow => {
                let turns = self.lasts.as_millis() / (2 * SLOW_TURN.as_millis());
                for _ in 0..turns {
                    send(Signal::STOP)?;
                    wait(SLOW_TURN)?;
                    send(Signal::CONT)?;
                    wait(SLOW_TURN)?;
                }
                Ok(())
            }
            DisturbanceKind::Swap => Ok(()),
        }
    }
}

impl Dice {
    /// The next disturbance of one of `victims`, each with its process number. It may be of any
    /// kind if `only` is empty.
    pub(crate) fn throw(
        &mut self,
        victims: &[(WorkerName, i32)],
        only: &[DisturbanceKind],
    ) -> Option<Disturbance> {
        let all = [
            DisturbanceKind::Kill,
            DisturbanceKind::Stop,
            DisturbanceKind::Slow,
            DisturbanceKind::Swap,
        ];
        let kind = self.choose(if only.is_empty() { &all } else { only })?;
        let (worker, pid) = self.choose(victims)?;
        let lasts = match kind {
            DisturbanceKind::Stop => Duration::from_millis(100 + self.number() % 1900),
            DisturbanceKind::Slow => Duration::from_secs(1),
            DisturbanceKind::Kill | DisturbanceKind::Swap => Duration::ZERO,
        };
        Some(Disturbance { kind, worker, pid, lasts })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_seed_says_what_is_done_to_whom() {
        let victims = ["fusion", "detection.1"].map(|name| (name.parse().unwrap(), 7));
        let thrown = |seed| {
            let mut dice = Dice::new(seed);
            (0..20).map(|_| dice.throw(&victims, &[]).unwrap()).collect::<Vec<_>>()
        };
        assert_eq!(thrown(3), thrown(3));
        assert_ne!(thrown(3), thrown(4));
        let mut dice = Dice::new(1);
        assert!((0..20).all(|_| dice.throw(&victims, &[DisturbanceKind::Kill]).unwrap().kind
            == DisturbanceKind::Kill));
        assert_eq!(dice.throw(&[], &[]), None);
    }
}
