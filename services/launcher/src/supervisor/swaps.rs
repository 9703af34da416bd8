//! Replaces a process in flight: beside the old one where possible, else after its end.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use flockeye_config::{Flow, Pipeline, Resolved};
use flockeye_contract::{HandOver, StageName};
use flockeye_runtime::memory::{Budget, shared_memory_space};
use flockeye_runtime::ports::Ports;
use serde_json::Value;

use super::Supervisor;
use super::unfinished_swap::{self, UnfinishedSwap};
use crate::control::server::ClientId;
use crate::control::{Reply, SwapRequest, WorkerName};
use crate::fault_point;
use crate::process::{Condition, Process, ProcessChange};
use crate::swap::changeover::{Changeover, SwapOrder};
use crate::swap::judge::Judge;
use crate::swap::replacement::{Replacement, ReplacementProgress};
use crate::swap::shadow::{Shadow, can_shadow};
use crate::swap::verdict::SwapVerdict;

impl Supervisor<'_> {
    /// Begins a swap. An error means that nothing was changed.
    pub(super) fn begin_swap(
        &mut self,
        client: ClientId,
        request: &SwapRequest,
        ports: &Ports,
    ) -> anyhow::Result<()> {
        let worker = request.worker;
        let changed = self.check_swap(request)?;
        if self.is_kept {
            let process = self.workers.of(worker)?;
            let swap = UnfinishedSwap {
                worker,
                old_generation: process.generation,
                old_command: process.command().to_vec(),
                pipeline: changed.is_some().then(|| self.pipeline.clone()),
            };
            swap.keep(self.instance.folder())?;
        }
        let pipeline_before = changed.map(|changed| self.change_pipeline(changed)).transpose()?;
        if pipeline_before.is_some() {
            fault_point::pass(self.instance.folder(), "settings are written");
        }
        let order = SwapOrder { client, worker, pipeline_before };
        let refused = if can_shadow(worker.stage) {
            match self.begin_beside(client, request, ports) {
                Ok((process, shadow, judge)) => {
                    self.changeover = Changeover::Beside { order, process, shadow, judge };
                    return Ok(());
                }
                Err(error) => error,
            }
        } else {
            match self.begin_in_turn(client, request) {
                Ok(replacement) => {
                    self.changeover = Changeover::InTurn(order, replacement);
                    return Ok(());
                }
                Err(error) => error,
            }
        };
        self.restore(order.pipeline_before)?;
        unfinished_swap::forget(self.instance.folder());
        Err(refused)
    }

    /// Refuses an impossible swap. Returns the configuration if the swap changes it.
    fn check_swap(&self, request: &SwapRequest) -> anyhow::Result<Option<Resolved>> {
        let worker = request.worker;
        if let Some(other) = self.changeover.worker() {
            bail!("{other} is being swapped. Cure: wait until that is done");
        }
        ensure!(
            self.pipeline.flow() == Flow::Latest,
            "a lossless run is for evaluation: what it gives must not depend on when a stage is swapped. \
             Cure: fly with profile: flight, or begin the run anew with the other stage"
        );
        ensure!(
            self.workers.of(worker)?.condition() == Condition::Running,
            "{worker} does not run. Cure: flockeye start {worker}"
        );
        ensure!(
            request.within_s > 0.0 && request.within_s <= 600.0,
            "within {} s: 600 s at most",
            request.within_s
        );
        if let Some(program) = request.program.first() {
            check_program(program)?;
        }
        self.changed_pipeline(worker.stage, &request.set)
    }

    /// Starts the new process in the shadow of the old one.
    fn begin_beside(
        &mut self,
        client: ClientId,
        request: &SwapRequest,
        ports: &Ports,
    ) -> anyhow::Result<(Process, Shadow, Judge)> {
        let worker = request.worker;
        let needed = self.memory.budget.bytes_of(worker.stage) as u64;
        let (free, _) = shared_memory_space().context("cannot look at /dev/shm")?;
        ensure!(
            needed <= free,
            "a second process of {worker} needs {} MB of shared memory, and /dev/shm has {} MB free. \
             Cure: mount -o remount,size=... /dev/shm",
            needed / 1_000_000,
            free / 1_000_000
        );
        let old = self.workers.of_mut(worker)?;
        let old_generation = old.generation;
        let mut process = old.successor(&request.program);
        let generations = [old_generation, process.generation];
        let shadow = Shadow::open(worker, &mut self.memory.ports())?;
        let within = Duration::from_secs_f64(request.within_s);
        let judge = Judge::new(worker, generations, Instant::now(), within, request.accept_worse);
        // The announcement comes first, so that subscribers ignore the new process.
        self.hand_over.announce(ports, judge.begin())?;
        self.messages.beside = Some((worker, process.generation));
        if let Err(error) = process.start() {
            self.messages.beside = None;
            return Err(error);
        }
        fault_point::pass(self.instance.folder(), "it is started");
        let pid = process.pid().unwrap_or(0);
        self.report_step(client, &format!("{worker}: process {pid} works in the old one's shadow"));
        Ok((process, shadow, judge))
    }

    /// Requests the end of the old process, so that the new one can open its device.
    fn begin_in_turn(
        &mut self,
        client: ClientId,
        request: &SwapRequest,
    ) -> anyhow::Result<Replacement> {
        let worker = request.worker;
        let newest = self.messages.newest.map(|stamp| stamp.order());
        let process = self.workers.of_mut(worker)?;
        let old_command = match request.program.is_empty() {
            true => process.command().to_vec(),
            false => process.set_command(request.program.clone()),
        };
        let generations = [process.generation, process.next_generation()];
        process.ask_to_restart();
        let within = Duration::from_secs_f64(request.within_s);
        let now = Instant::now();
        let replacement = Replacement::new(worker, generations, old_command, newest, now, within);
        fault_point::pass(self.instance.folder(), "the old one ends first");
        let text = format!("{worker} owns a device or a port: the old process ends first");
        self.report_step(client, &text);
        Ok(replacement)
    }

    /// The configuration with changed settings, checked; `None` if there are none.
    fn changed_pipeline(
        &self,
        stage: StageName,
        set: &[String],
    ) -> anyhow::Result<Option<Resolved>> {
        if set.is_empty() {
            return Ok(None);
        }
        // JSON is a subset of YAML.
        let text = serde_json::to_string(&self.pipeline).context("the configuration")?;
        let changed = Pipeline::parse(&text, set, "the running configuration")?;
        let (before, after) =
            (serde_json::to_value(&self.pipeline)?, serde_json::to_value(&changed)?);
        let mut foreign = BTreeSet::new();
        for (key, value) in after.as_object().into_iter().flatten() {
            if before.get(key) != Some(value) && !own_keys(stage).contains(&key.as_str()) {
                foreign.insert(key.clone());
            }
        }
        ensure!(
            foreign.is_empty(),
            "{} cannot be changed by a swap of {}, which reads {}. Cure: start the pipeline anew",
            foreign.into_iter().collect::<Vec<_>>().join(", "),
            stage.name(),
            own_keys(stage).join(", ")
        );
        let resolved = Resolved::of(changed)?;
        ensure!(
            Budget::of(&resolved) == self.memory.budget,
            "these settings change how much memory the stages share. Cure: start the pipeline anew"
        );
        Ok(Some(resolved))
    }

    /// Changes the configuration, and returns the former one.
    fn change_pipeline(&mut self, resolved: Resolved) -> anyhow::Result<Pipeline> {
        self.instance.write_configuration(&resolved)?;
        Ok(std::mem::replace(&mut self.pipeline, resolved.pipeline))
    }

    /// Restores the configuration before a swap, if the swap has changed it.
    fn restore(&mut self, before: Option<Pipeline>) -> anyhow::Result<()> {
        if let Some(before) = before {
            self.change_pipeline(Resolved::of(before)?)?;
        }
        Ok(())
    }

    /// Performs the next step of a swap.
    pub(super) fn look_after_swap(&mut self, ports: &Ports) -> anyhow::Result<()> {
        let (client, worker, verdict) = match &mut self.changeover {
            Changeover::Nothing => return Ok(()),
            Changeover::PuttingBack(worker, generation) => {
                let process = self.workers.of(*worker)?;
                if process.generation > *generation && process.condition() == Condition::Running {
                    self.changeover = Changeover::Nothing;
                    unfinished_swap::forget(self.instance.folder());
                }
                return Ok(());
            }
            Changeover::InTurn(order, replacement) => {
                let process = self.workers.of(order.worker)?;
                let progress = ReplacementProgress {
                    generation: process.generation,
                    runs: process.condition() == Condition::Running,
                    is_ready: self.messages.has_reported(order.worker, process.pid())
                        && self.messages.is_ready(order.worker),
                    newest_frame: self.messages.newest.map(|stamp| stamp.order()),
                };
                (order.client, order.worker, replacement.judge(&progress, Instant::now()))
            }
            Changeover::Beside { order, process, shadow, judge } => {
                shadow.receive(judge)?;
                let new_ended = match process.attend(false, || {})? {
                    ProcessChange::Ended { end, .. } => Some(end.how),
                    _ => (process.condition() != Condition::Running).then(|| "ended".to_owned()),
                };
                let old = self.workers.of(order.worker)?;
                let old_runs =
                    old.condition() == Condition::Running && old.generation == judge.old_generation;
                let verdict = judge.judge(new_ended.as_deref(), old_runs, Instant::now());
                (order.client, order.worker, verdict)
            }
        };
        match verdict {
            SwapVerdict::Wait => Ok(()),
            SwapVerdict::TakeOver(hand_over, text) => {
                self.report_step(client, &format!("{worker}: {text}"));
                self.hand_over.announce(ports, hand_over)
            }
            SwapVerdict::TakeBack(hand_over, reason) => {
                let text = format!("{worker}: the old process counts again: {reason}");
                self.report_step(client, &text);
                self.hand_over.announce(ports, hand_over)
            }
            SwapVerdict::Done(text, report) => self.complete_swap(text, report),
            SwapVerdict::Refused(reason) => self.refuse_swap(&reason),
        }
    }

    /// The new process stays.
    fn complete_swap(&mut self, text: String, report: Value) -> anyhow::Result<()> {
        self.console.line(&text);
        let done = Reply::Done { text, report };
        match std::mem::take(&mut self.changeover) {
            Changeover::Beside { order, process: new, .. } => {
                self.server.reply(order.client, &done);
                let folder = self.instance.folder();
                unfinished_swap::forget(folder);
                let process = self.workers.of_mut(order.worker)?;
                let mut old = new.takes_the_place_of(process);
                fault_point::pass(folder, "it is swapped");
                old.ask_to_stop();
                fault_point::pass(folder, "the old one is asked to end");
                self.workers.retired.push(old);
                self.messages.beside = None;
            }
            Changeover::InTurn(order, _) => {
                fault_point::pass(self.instance.folder(), "it is replaced");
                self.server.reply(order.client, &done);
                unfinished_swap::forget(self.instance.folder());
            }
            Changeover::Nothing | Changeover::PuttingBack(..) => {}
        }
        Ok(())
    }

    /// The old process stays, or its program is started again.
    fn refuse_swap(&mut self, reason: &str) -> anyhow::Result<()> {
        match std::mem::take(&mut self.changeover) {
            Changeover::Beside { order, mut process, .. } => {
                // The last lines of the new process state the reason, and may not have arrived yet.
                std::thread::sleep(Duration::from_millis(50));
                self.console.show_log();
                self.report_refusal(order.client, order.worker, reason);
                let folder = self.instance.folder();
                fault_point::pass(folder, "it is refused");
                process.ask_to_stop();
                fault_point::pass(folder, "the new one is asked to end");
                self.workers.retired.push(process);
                self.messages.beside = None;
                self.restore(order.pipeline_before)?;
                unfinished_swap::forget(self.instance.folder());
            }
            Changeover::InTurn(order, replacement) => {
                self.restore(order.pipeline_before)?;
                let process = self.workers.of_mut(order.worker)?;
                process.set_command(replacement.old_command);
                self.changeover = Changeover::PuttingBack(order.worker, process.generation);
                process.ask_to_restart();
                fault_point::pass(self.instance.folder(), "the old program is asked for");
                self.report_refusal(order.client, order.worker, reason);
            }
            Changeover::Nothing | Changeover::PuttingBack(..) => {}
        }
        Ok(())
    }

    fn report_refusal(&mut self, client: ClientId, worker: WorkerName, reason: &str) {
        let text = format!("{worker} is not swapped: {reason}");
        self.console.line(&text);
        self.server.reply(client, &Reply::Failed(text));
    }

    /// Ends a hand-over: once no other process of the worker is left, all processes count.
    pub(super) fn end_hand_over(&mut self, ports: &Ports) -> anyhow::Result<()> {
        let is_over = !matches!(self.changeover, Changeover::Beside { .. })
            && self.workers.retired.is_empty();
        match is_over && self.hand_over.is_under_way() {
            true => self.hand_over.announce(ports, HandOver::default()),
            false => Ok(()),
        }
    }
}

/// Sections of the configuration that a stage reads and that a swap may change.
fn own_keys(stage: StageName) -> &'static [&'static str] {
    match stage {
        StageName::Capture => &["source", "camera"],
        StageName::Simulator => &["simulator"],
        StageName::Inertial => &["inertial"],
        StageName::Egomotion => &["inertial"],
        StageName::Rectification => &["rectification"],
        StageName::Detection => &["detection"],
        StageName::Fusion => &["fusion", "search"],
        StageName::Autopilot => &["autopilot"],
        StageName::Gateway => &["gateway"],
        StageName::Ros2 => &["ros2"],
    }
}

/// Refuses a missing or non-executable program before anything is started.
fn check_program(program: &str) -> anyhow::Result<()> {
    use std::os::unix::fs::PermissionsExt;
    let is_program = |path: &std::path::Path| {
        std::fs::metadata(path)
            .is_ok_and(|found| found.is_file() && found.permissions().mode() & 0o111 != 0)
    };
    if program.contains('/') {
        let path = std::path::Path::new(program);
        ensure!(path.exists(), "there is no program {program}");
        ensure!(is_program(path), "{program} cannot be executed. Cure: chmod +x {program}");
        return Ok(());
    }
    let folders = std::env::var_os("PATH").unwrap_or_default();
    let is_found = std::env::split_paths(&folders).any(|folder| is_program(&folder.join(program)));
    ensure!(is_found, "there is no program {program} in PATH. Cure: write its path");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn programs_that_cannot_run_are_refused_first() {
        assert!(check_program("sh").is_ok());
        let why = |program| check_program(program).expect_err("refused").to_string();
        assert!(why("no-such-program-anywhere").contains("in PATH"));
        assert!(why("/nowhere/detector").contains("there is no program"));
        assert!(why("/etc/passwd").contains("chmod +x"));
    }
}
