//! Replaces a process in flight: beside the old one where that can be, else after it has ended.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use flockeye_config::{Flow, Pipeline, Resolved};
use flockeye_contract::{FrameOrder, HandOver, StageName};
use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::memory::{Budget, shared_memory_space};
use flockeye_runtime::ports::Ports;
use serde_json::json;

use super::Supervisor;
use super::unfinished::{self, UnfinishedSwap};
use crate::control::server::ClientId;
use crate::control::{Reply, SwapRequest, Worker};
use crate::fault_point;
use crate::process::{Condition, ProcessChange};
use crate::swap::Swap;
use crate::swap::judge::{Lives, Verdict};
use crate::swap::shadow::{Shadow, can_shadow};

/// A stage that owns a device or a port is being replaced: the old process ends first.
pub(super) struct Replacement {
    client: ClientId,
    worker: Worker,
    old_command: Vec<String>,
    pipeline_before: Option<Pipeline>,
    /// The generation that is replaced, and that of the new process.
    generation: u32,
    new_generation: u32,
    stopped: Instant,
    deadline: Instant,
    /// The newest frame before it.
    newest: Option<FrameOrder>,
}

impl Supervisor<'_> {
    /// Whether a process is being replaced.
    pub(super) fn is_swapping(&self) -> Option<Worker> {
        let swap = self.swap.as_ref().map(|swap| swap.worker);
        swap.or(self.replacement.as_ref().map(|replacement| replacement.worker))
    }

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
        if let Some(other) = self.is_swapping() {
            bail!("{other} is being swapped. Cure: wait until that is done");
        }
        ensure!(
            self.pipeline.flow == Flow::Latest,
            "a lossless run is for evaluation: what it gives must not depend on when a stage is swapped. \
             Cure: fly with flow: latest, or begin the run anew with the other stage"
        );
        let index = self.index_of(worker)?;
        ensure!(
            self.processes[index].condition() == Condition::Running,
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
        let changed = self.changed_pipeline(worker.stage, &request.set)?;
        let within = Duration::from_secs_f64(request.within_s);
        if self.is_kept {
            let process = &self.processes[index];
            let swap = UnfinishedSwap {
                worker,
                old_generation: process.generation,
                old_command: process.command().to_vec(),
                pipeline: changed.is_some().then(|| self.pipeline.clone()),
            };
            swap.keep(self.instance.folder())?;
            self.putting_back = None;
        }
        let pipeline_before = match changed {
            Some(resolved) => {
                self.instance.write_configuration(&resolved)?;
                fault_point::pass(self.instance.folder(), "settings are written");
                Some(std::mem::replace(&mut self.pipeline, resolved.pipeline))
            }
            None => None,
        };
        let begun = match can_shadow(worker.stage) {
            true => self.begin_beside(client, index, request, within, ports),
            false => {
                self.begin_replacement(client, index, request, within);
                Ok(())
            }
        };
        match (&begun, pipeline_before) {
            (Err(_), Some(before)) => {
                self.restore(before)?;
                unfinished::forget(self.instance.folder());
            }
            (Ok(()), before) => {
                if let Some(swap) = &mut self.swap {
                    swap.pipeline_before = before;
                } else if let Some(replacement) = &mut self.replacement {
                    replacement.pipeline_before = before;
                }
            }
            (Err(_), None) => unfinished::forget(self.instance.folder()),
        }
        begun
    }

    fn begin_beside(
        &mut self,
        client: ClientId,
        index: usize,
        request: &SwapRequest,
        within: Duration,
        ports: &Ports,
    ) -> anyhow::Result<()> {
        let worker = request.worker;
        let needed = self.budget.bytes_of(worker.stage) as u64;
        let (free, _) = shared_memory_space().context("cannot look at /dev/shm")?;
        ensure!(
            needed <= free,
            "a second process of {worker} needs {} MB of shared memory, and /dev/shm has {} MB free. \
             Cure: mount -o remount,size=... /dev/shm",
            needed / 1_000_000,
            free / 1_000_000
        );
        let old_generation = self.processes[index].generation;
        let candidate = self.processes[index].successor(&request.program);
        let mut own = Ports::new(self.node.clone(), self.budget.clone(), SharedCounters::default());
        let shadow = Shadow::open(worker, [old_generation, candidate.generation], &mut own)?;
        let mut swap =
            Swap::new(client, candidate, old_generation, shadow, within, request.accept_worse);
        // Nobody may listen to it before it says its first word.
        self.announce(ports, swap.judge.begin())?;
        self.messages.keep_apart(Some((worker, swap.candidate.generation)));
        if let Err(error) = swap.candidate.start() {
            self.messages.keep_apart(None);
            self.awaits_silence = true;
            return Err(error);
        }
        fault_point::pass(self.instance.folder(), "it is started");
        let pid = swap.candidate.pid().unwrap_or(0);
        self.say(client, &format!("{worker}: process {pid} works in the old one's shadow"));
        self.swap = Some(swap);
        Ok(())
    }

    fn begin_replacement(
        &mut self,
        client: ClientId,
        index: usize,
        request: &SwapRequest,
        within: Duration,
    ) {
        let newest = self.messages.newest().map(|stamp| stamp.order());
        let process = &mut self.processes[index];
        let old_command = match request.program.is_empty() {
            true => process.command().to_vec(),
            false => process.set_command(request.program.clone()),
        };
        let (generation, new_generation) = (process.generation, process.next_generation());
        process.ask_to_restart();
        let worker = request.worker;
        let now = Instant::now();
        self.replacement = Some(Replacement {
            client,
            worker,
            old_command,
            pipeline_before: None,
            generation,
            new_generation,
            stopped: now,
            deadline: now + within,
            newest,
        });
        fault_point::pass(self.instance.folder(), "the old one ends first");
        self.say(client, &format!("{worker} owns a device or a port: the old process ends first"));
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
            Budget::of(&resolved) == self.budget,
            "these settings change how much memory the stages share. Cure: start the pipeline anew"
        );
        Ok(Some(resolved))
    }

    fn restore(&mut self, pipeline: Pipeline) -> anyhow::Result<()> {
        let resolved = Resolved::of(pipeline)?;
        self.instance.write_configuration(&resolved)?;
        self.pipeline = resolved.pipeline;
        Ok(())
    }

    pub(super) fn look_after_swap(&mut self, ports: &Ports) -> anyhow::Result<()> {
        self.look_after_replacement()?;
        let Some(mut swap) = self.swap.take() else { return Ok(()) };
        let attended = swap.shadow.receive().and_then(|()| swap.candidate.attend(false, || {}));
        let attended = match attended {
            Ok(change) => change,
            Err(error) => {
                // With the others it is ended.
                self.swap = Some(swap);
                return Err(error);
            }
        };
        let new_ended = match attended {
            ProcessChange::Ended { how, .. } => Some(how),
            _ => (swap.candidate.condition() != Condition::Running).then(|| "ended".to_owned()),
        };
        let index = self.index_of(swap.worker)?;
        let old = &self.processes[index];
        let old_runs =
            old.condition() == Condition::Running && swap.judge.is_of_generation(old.generation);
        let lives = Lives { new_ended: new_ended.as_deref(), old_runs };
        match swap.judge(lives, Instant::now()) {
            Verdict::Wait => {
                self.swap = Some(swap);
                return Ok(());
            }
            Verdict::TakeOver(word, text) => {
                self.say(swap.client, &format!("{}: {text}", swap.worker));
                self.swap = Some(swap);
                return self.announce(ports, word);
            }
            Verdict::TakeBack(word, reason) => {
                let worker = swap.worker;
                self.say(swap.client, &format!("{worker}: the old process counts again: {reason}"));
                self.swap = Some(swap);
                return self.announce(ports, word);
            }
            Verdict::Done(text, report) => {
                self.screen.line(&text);
                self.server.reply(swap.client, &Reply::Done { text, report });
                unfinished::forget(self.instance.folder());
                let mut old = swap.candidate.takes_the_place_of(&mut self.processes[index]);
                fault_point::pass(self.instance.folder(), "it is swapped");
                old.ask_to_stop();
                fault_point::pass(self.instance.folder(), "the old one is asked to end");
                self.retired.push(old);
            }
            Verdict::Refused(reason) => {
                // Its last lines say why, and may not have arrived yet.
                std::thread::sleep(Duration::from_millis(50));
                self.show_log();
                let text = format!("{} is not swapped: {reason}", swap.worker);
                self.screen.line(&text);
                self.server.reply(swap.client, &Reply::Failed(text));
                let mut candidate = swap.candidate;
                fault_point::pass(self.instance.folder(), "it is refused");
                candidate.ask_to_stop();
                fault_point::pass(self.instance.folder(), "the new one is asked to end");
                self.retired.push(candidate);
                if let Some(before) = swap.pipeline_before {
                    self.restore(before)?;
                }
                unfinished::forget(self.instance.folder());
            }
        }
        self.messages.keep_apart(None);
        self.awaits_silence = true;
        Ok(())
    }

    /// Ends a hand-over: once no retired process is left, everybody counts.
    pub(super) fn end_hand_over(&mut self, ports: &Ports) -> anyhow::Result<()> {
        if self.awaits_silence && self.swap.is_none() && self.retired.is_empty() {
            self.awaits_silence = false;
            self.announce(ports, HandOver::default())?;
        }
        Ok(())
    }

    fn look_after_replacement(&mut self) -> anyhow::Result<()> {
        if let Some((worker, generation)) = self.putting_back {
            let process = &self.processes[self.index_of(worker)?];
            if process.generation > generation && process.condition() == Condition::Running {
                self.putting_back = None;
                unfinished::forget(self.instance.folder());
            }
        }
        let Some(replacement) = &self.replacement else { return Ok(()) };
        let worker = replacement.worker;
        let index = self.index_of(worker)?;
        let process = &self.processes[index];
        let is_new = process.generation == replacement.new_generation;
        let runs = process.condition() == Condition::Running;
        let has_failed = process.generation > replacement.new_generation
            || (is_new && !runs)
            || Instant::now() >= replacement.deadline;
        let works = is_new && runs && self.replacement_works(replacement, process.pid());
        if !works && !has_failed {
            return Ok(());
        }
        let Some(replacement) = self.replacement.take() else { return Ok(()) };
        let gap_s = replacement.stopped.elapsed().as_secs_f64();
        if works {
            let text = format!("{worker} is swapped; {gap_s:.2} s passed without it");
            let generation = self.processes[index].generation;
            let report = json!({ "worker": worker, "generation": generation, "gap_s": gap_s });
            self.screen.line(&text);
            fault_point::pass(self.instance.folder(), "it is replaced");
            self.server.reply(replacement.client, &Reply::Done { text, report });
            unfinished::forget(self.instance.folder());
            return Ok(());
        }
        if let Some(before) = replacement.pipeline_before {
            self.restore(before)?;
        }
        let process = &mut self.processes[index];
        process.set_command(replacement.old_command);
        self.putting_back = Some((worker, process.generation));
        process.ask_to_restart();
        fault_point::pass(self.instance.folder(), "the old program is asked for");
        let text = format!(
            "{worker} is not swapped: the new process did not work within {gap_s:.1} s. The old \
             program is started again"
        );
        self.screen.line(&text);
        self.server.reply(replacement.client, &Reply::Failed(text));
        Ok(())
    }

    /// Whether a process that took another's place does its work: a source gives frames, others are ready.
    fn replacement_works(&self, replacement: &Replacement, pid: Option<u32>) -> bool {
        let Worker { stage, replica } = replacement.worker;
        if stage.is_source() {
            let newest = self.messages.newest().map(|stamp| stamp.order());
            return newest.is_some_and(|newest| {
                newest.0 > replacement.generation && Some(newest) > replacement.newest
            });
        }
        let report =
            pid.and_then(|pid| self.messages.dashboard.last_report(stage.name(), replica, pid));
        report.is_some() && self.is_ready(replacement.worker)
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
