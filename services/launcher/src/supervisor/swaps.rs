//! Replaces a process in flight: beside the old one where that can be, else after it has ended.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use flockeye_config::{Flow, Pipeline, Resolved};
use flockeye_contract::{HandOver, StageName};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::memory::{Budget, shared_memory_space};
use flockeye_runtime::ports::Ports;
use serde_json::Value;

use super::Supervisor;
use super::unfinished_swap::{self, UnfinishedSwap};
use crate::control::server::ClientId;
use crate::control::{Reply, SwapRequest, Worker};
use crate::fault_point;
use crate::process::{Condition, ProcessChange};
use crate::swap::changeover::{Candidate, Changeover, SwapOrder};
use crate::swap::judge::{Judge, Lives};
use crate::swap::replacement::{Progress, Replacement};
use crate::swap::shadow::{Shadow, can_shadow};
use crate::swap::verdict::Verdict;

impl Supervisor<'_> {
    /// Begins a swap.
    ///
    /// # Errors
    /// Why it cannot be begun; nothing has changed then.
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
        let mut order = SwapOrder { client, worker, pipeline_before };
        if !can_shadow(worker.stage) {
            let replacement = self.begin_in_turn(client, request)?;
            self.changeover = Changeover::InTurn(order, replacement);
            return Ok(());
        }
        match self.begin_beside(client, request, ports) {
            Ok(candidate) => {
                self.changeover = Changeover::Beside(order, candidate);
                Ok(())
            }
            Err(error) => {
                self.restore(&mut order)?;
                unfinished_swap::forget(self.instance.folder());
                Err(error)
            }
        }
    }

    /// Refuses a swap that cannot be done. Returns the configuration if the swap changes it.
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
    ) -> anyhow::Result<Candidate> {
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
        let mut own_ports = self.memory.ports(SharedCounters::default());
        let shadow = Shadow::open(worker, generations, &mut own_ports)?;
        let within = Duration::from_secs_f64(request.within_s);
        let judge = Judge::new(worker, generations, Instant::now(), within, request.accept_worse);
        // The announcement comes first, so that readers ignore the new process.
        self.hand_over.announce(ports, judge.begin())?;
        self.messages.keep_apart(Some((worker, process.generation)));
        if let Err(error) = process.start() {
            self.messages.keep_apart(None);
            return Err(error);
        }
        fault_point::pass(self.instance.folder(), "it is started");
        let pid = process.pid().unwrap_or(0);
        self.report_step(client, &format!("{worker}: process {pid} works in the old one's shadow"));
        Ok(Candidate { process, shadow, judge })
    }

    /// Asks the old process to end, so that the new one can have its device.
    fn begin_in_turn(
        &mut self,
        client: ClientId,
        request: &SwapRequest,
    ) -> anyhow::Result<Replacement> {
        let worker = request.worker;
        let newest = self.messages.newest().map(|stamp| stamp.order());
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
        // JSON is YAML.
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

    /// Changes the configuration, and returns that of before.
    fn change_pipeline(&mut self, resolved: Resolved) -> anyhow::Result<Pipeline> {
        self.instance.write_configuration(&resolved)?;
        Ok(std::mem::replace(&mut self.pipeline, resolved.pipeline))
    }

    /// Goes back to the configuration before a swap.
    fn restore(&mut self, order: &mut SwapOrder) -> anyhow::Result<()> {
        if let Some(before) = order.pipeline_before.take() {
            self.change_pipeline(Resolved::of(before)?)?;
        }
        Ok(())
    }

    /// Does what is to be done about a swap.
    ///
    /// # Errors
    /// A topic or a file of the instance cannot be used.
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
                let (client, worker, replacement) =
                    (order.client, order.worker, replacement.clone());
                let progress = self.progress_of(worker)?;
                (client, worker, replacement.judge(&progress, Instant::now()))
            }
            Changeover::Beside(order, candidate) => {
                candidate.shadow.receive()?;
                let new_ended = match candidate.process.attend(false, || {})? {
                    ProcessChange::Ended { how, .. } => Some(how),
                    _ => (candidate.process.condition() != Condition::Running)
                        .then(|| "ended".to_owned()),
                };
                let old = self.workers.of(order.worker)?;
                let old_runs = old.condition() == Condition::Running
                    && candidate.judge.is_of_generation(old.generation);
                let lives = Lives { new_ended: new_ended.as_deref(), old_runs };
                let comparison = &candidate.shadow.comparison;
                let verdict = candidate.judge.judge(comparison, lives, Instant::now());
                (order.client, order.worker, verdict)
            }
        };
        match verdict {
            Verdict::Wait => Ok(()),
            Verdict::TakeOver(hand_over, text) => {
                self.report_step(client, &format!("{worker}: {text}"));
                self.hand_over.announce(ports, hand_over)
            }
            Verdict::TakeBack(hand_over, reason) => {
                let text = format!("{worker}: the old process counts again: {reason}");
                self.report_step(client, &text);
                self.hand_over.announce(ports, hand_over)
            }
            Verdict::Done(text, report) => self.complete_swap(text, report),
            Verdict::Refused(reason) => self.refuse_swap(&reason),
        }
    }

    /// How far a worker is whose process is replaced.
    fn progress_of(&self, worker: Worker) -> anyhow::Result<Progress> {
        let process = self.workers.of(worker)?;
        Ok(Progress {
            generation: process.generation,
            runs: process.condition() == Condition::Running,
            is_ready: self.has_reported(worker, process.pid()) && self.is_ready(worker),
            newest_frame: self.messages.newest().map(|stamp| stamp.order()),
        })
    }

    /// The new process stays.
    fn complete_swap(&mut self, text: String, report: Value) -> anyhow::Result<()> {
        self.console.line(&text);
        let done = Reply::Done { text, report };
        match std::mem::take(&mut self.changeover) {
            Changeover::Beside(order, candidate) => {
                self.server.reply(order.client, &done);
                let folder = self.instance.folder();
                unfinished_swap::forget(folder);
                let process = self.workers.of_mut(order.worker)?;
                let mut old = candidate.process.takes_the_place_of(process);
                fault_point::pass(folder, "it is swapped");
                old.ask_to_stop();
                fault_point::pass(folder, "the old one is asked to end");
                self.workers.retired.push(old);
                self.messages.keep_apart(None);
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
            Changeover::Beside(mut order, candidate) => {
                // The last lines of the new process say why, and may not have arrived yet.
                std::thread::sleep(Duration::from_millis(50));
                self.console.show_log();
                self.report_refusal(&order, reason);
                let folder = self.instance.folder();
                let mut process = candidate.process;
                fault_point::pass(folder, "it is refused");
                process.ask_to_stop();
                fault_point::pass(folder, "the new one is asked to end");
                self.workers.retired.push(process);
                self.messages.keep_apart(None);
                self.restore(&mut order)?;
                unfinished_swap::forget(self.instance.folder());
            }
            Changeover::InTurn(mut order, replacement) => {
                self.restore(&mut order)?;
                let process = self.workers.of_mut(order.worker)?;
                process.set_command(replacement.old_command);
                self.changeover = Changeover::PuttingBack(order.worker, process.generation);
                process.ask_to_restart();
                fault_point::pass(self.instance.folder(), "the old program is asked for");
                self.report_refusal(&order, reason);
            }
            Changeover::Nothing | Changeover::PuttingBack(..) => {}
        }
        Ok(())
    }

    fn report_refusal(&mut self, order: &SwapOrder, reason: &str) {
        let text = format!("{} is not swapped: {reason}", order.worker);
        self.console.line(&text);
        self.server.reply(order.client, &Reply::Failed(text));
    }

    /// Ends a hand-over: once no other process of the worker is left, everybody counts.
    ///
    /// # Errors
    /// The topic cannot be written to.
    pub(super) fn end_hand_over(&mut self, ports: &Ports) -> anyhow::Result<()> {
        let is_over = !self.changeover.is_beside() && self.workers.retired.is_empty();
        match is_over && self.hand_over.is_under_way() {
            true => self.hand_over.announce(ports, HandOver::default()),
            false => Ok(()),
        }
    }
}

/// The parts of the configuration that a stage reads and that a swap may change.
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

/// Refuses a program that is not there or cannot be run, before anything is started.
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
