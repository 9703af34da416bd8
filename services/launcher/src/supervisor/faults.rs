//! Notices processes that end, hang, start too slowly or do not do what they must, and replaces
//! them.

use std::time::{Duration, Instant};

use anyhow::bail;
use flockeye_config::Flow;
use flockeye_contract::{Complaint, ComplaintKind, StageName, StageState};
use flockeye_runtime::clock;
use rustix::process::Signal;

use super::Supervisor;
use crate::complaints::{MOST_REFUSED, MOST_SILENCES, rest_before_next};
use crate::control::WorkerName;
use crate::heartbeat::ProcessStat;
use crate::process::{Condition, End, ProcessChange};

/// Factor on timeouts in a lossless run, where a frame may take a stage longer than in flight.
const LOSSLESS_PATIENCE: f64 = 5.0;
/// Factor on timeouts of stages that open drivers and networks in their loop, which may block it. A
/// reconnected camera must not cause a kill.
const DEVICE_PATIENCE: f64 = 15.0;
/// Minimum age, added to the answer timeout, at which a process is responsible for complaints.
/// Earlier ones may concern its predecessor.
const YOUTH: Duration = Duration::from_millis(500);

/// Functions that still work without a stage, in words.
fn what_is_left(stage: StageName) -> &'static str {
    match stage {
        StageName::Capture | StageName::Simulator => "nothing: no frame comes any more",
        StageName::Inertial => "the picture alone measures how the camera turns",
        StageName::Egomotion => "neighbours are tracked as if the camera did not turn",
        StageName::Rectification => "nothing is searched: tracks coast and end",
        StageName::Detection => {
            "tracked neighbours are measured by their pixels; no other is found"
        }
        StageName::Fusion => "the sphere is swept, and no pose is made of what is found",
        StageName::Autopilot => "the autopilot gets no poses, and reports have no odometry",
        StageName::Gateway => "poses are made, and the swarm does not get them",
        StageName::Ros2 => "ROS 2 gets no poses",
    }
}

impl Supervisor<'_> {
    pub(super) fn look_after_processes(&mut self) -> anyhow::Result<()> {
        self.kill_those_that_hang();
        self.name_those_that_are_late();
        self.act_on_complaints();
        let source_has_finished = self.source_has_finished();
        for index in 0..self.workers.processes.len() {
            let process = &mut self.workers.processes[index];
            let is_finished = process.worker.stage.is_source() && source_has_finished;
            let memory = &self.memory;
            // The dead process's ports are freed before its successor opens new ones.
            let change = process.attend(is_finished, || memory.clean_up())?;
            self.report(index, change)?;
        }
        for index in (0..self.workers.retired.len()).rev() {
            let process = &mut self.workers.retired[index];
            process.attend(false, || {})?;
            if process.pid().is_none() {
                self.workers.retired.remove(index);
                self.memory.clean_up();
            }
        }
        Ok(())
    }

    fn report(&mut self, index: usize, change: ProcessChange) -> anyhow::Result<()> {
        let process = &self.workers.processes[index];
        let (label, worker) = (process.label(), process.worker);
        match change {
            ProcessChange::None => {}
            ProcessChange::Stopped => self.console.line(&format!("{label} has stopped")),
            ProcessChange::Restarted => self.console.line(&format!("{label} is started again")),
            ProcessChange::Ended { end: End { how, is_hopeless }, retry_in } => {
                if is_hopeless && process.generation == 0 {
                    // Its last lines state the reason, and may not have arrived yet.
                    std::thread::sleep(Duration::from_millis(50));
                    bail!("{label} cannot start; its reason is above");
                }
                match retry_in {
                    Some(wait) => self.console.line(&format!(
                        "{label} {how}; it is started again in {:.1} s",
                        wait.as_secs_f64()
                    )),
                    None => self.give_up(
                        worker,
                        &format!("{how}, and its restart policy does not start it again"),
                    )?,
                }
            }
        }
        Ok(())
    }

    /// Gives a worker up. The flight continues without it, if anything still works.
    fn give_up(&mut self, worker: WorkerName, why: &str) -> anyhow::Result<()> {
        if worker.stage.is_source() || self.messages.dashboard.frames_ended == 0 {
            bail!("{worker} {why}");
        }
        let left = self.what_is_left_without(worker);
        self.console.line(&format!("{worker} {why}. It is given up; what is left: {left}"));
        Ok(())
    }

    fn what_is_left_without(&self, worker: WorkerName) -> String {
        let others = self.workers.processes.iter().filter(|process| {
            process.worker.stage == worker.stage
                && process.worker != worker
                && process.condition() == Condition::Running
        });
        match others.count() {
            0 => what_is_left(worker.stage).to_owned(),
            count => format!("{count} other of this stage go on"),
        }
    }

    /// Kills processes that have stopped sending health although nothing keeps them from it.
    fn kill_those_that_hang(&mut self) {
        let flow_patience = match self.pipeline.flow() {
            Flow::Latest => 1.0,
            Flow::Lossless => LOSSLESS_PATIENCE,
        };
        let now_ns = clock::monotonic_ns();
        for process in &mut self.workers.processes {
            let WorkerName { stage, replica } = process.worker;
            let patience = match stage {
                StageName::Capture
                | StageName::Inertial
                | StageName::Autopilot
                | StageName::Gateway
                | StageName::Ros2 => DEVICE_PATIENCE,
                _ => flow_patience,
            };
            let heartbeat_s = self.pipeline.supervision.heartbeat_s * patience;
            let Some(pid) = process.pid() else { continue };
            let dashboard = &self.messages.dashboard;
            let Some(report) = dashboard.last_report(stage.name(), replica, pid) else { continue };
            // A start may take a while, and an end has its own timeout.
            let works = matches!(
                StageState::try_from(report.state),
                Ok(StageState::Ready | StageState::Degraded | StageState::Finished)
            );
            let silence_ns = now_ns - report.sent_ns;
            let heartbeat_ns = (heartbeat_s * 1e9) as i64;
            if !works || silence_ns < heartbeat_ns / 2 {
                continue;
            }
            let Some(stat) = ProcessStat::of(pid) else { continue };
            if process.heartbeat.hangs(report.sent_ns, now_ns, heartbeat_ns, stat) {
                self.console.line(&format!(
                    "{} (process {pid}) hangs: no health for {:.1} s; it is killed and started again",
                    process.label(),
                    silence_ns as f64 * 1e-9
                ));
                process.signal(Signal::KILL);
            }
        }
    }

    /// Reports each process once that is not ready in time.
    fn name_those_that_are_late(&mut self) {
        let start_time = self.start_time();
        for process in &mut self.workers.processes {
            let WorkerName { stage, replica } = process.worker;
            let Some(pid) = process.pid() else { continue };
            if process.is_late || process.age() < start_time {
                continue;
            }
            process.is_late = true;
            let report = self.messages.dashboard.last_report(stage.name(), replica, pid);
            let what = match report.map(|report| StageState::try_from(report.state)) {
                None => "has sent no health",
                Some(Ok(StageState::Starting)) => "is not ready",
                Some(_) => continue,
            };
            self.console.line(&format!(
                "{} (process {pid}) {what} for {:.0} s after its start; it is left alone",
                process.label(),
                start_time.as_secs_f64()
            ));
        }
    }

    fn act_on_complaints(&mut self) {
        loop {
            match self.complaints.receive() {
                Ok(Some(message)) => self.act_on(&message.header),
                Ok(None) => return,
                Err(error) => {
                    tracing::debug!("complaints cannot be read: {error}");
                    return;
                }
            }
        }
    }

    fn act_on(&mut self, complaint: &Complaint) {
        let stage = complaint.stage.to_string_lossy().into_owned();
        let is_meant = |worker: WorkerName, pid: Option<u32>| match complaint.pid {
            0 => worker.stage.name() == stage && worker.replica == complaint.replica,
            meant => pid == Some(meant),
        };
        let detail = complaint.detail.to_string_lossy();
        let is_silent = complaint.kind == ComplaintKind::Unanswered.code();
        let found = self
            .workers
            .processes
            .iter_mut()
            .find(|process| is_meant(process.worker, process.pid()));
        let Some(process) = found.filter(|process| process.pid().is_some()) else {
            // The launcher replaces only the pipeline's own processes.
            if !is_silent && complaint.count <= 10 {
                let pid = complaint.pid;
                self.console.line(&format!("process {pid} sends bad messages ({detail}); refused"));
            }
            return;
        };
        let (label, pid) = (process.label(), process.pid().unwrap_or(0));
        // Views and messages of the predecessor do not count for this process.
        if process.age() < self.pipeline.view_overdue() + YOUTH {
            return;
        }
        let most = if is_silent { MOST_SILENCES } else { MOST_REFUSED };
        if complaint.count < most {
            let what = match is_silent {
                true => format!("{detail}: it gets none until it answers"),
                false => format!("{} messages refused ({detail})", complaint.count),
            };
            // The first complaint is only shown; further ones lead to a replacement.
            if !std::mem::replace(&mut process.is_silent, true) {
                self.console.line(&format!("{label} (process {pid}): {what}"));
            }
            return;
        }
        let Some(rest) = rest_before_next(&mut process.replaced, Instant::now()) else {
            self.console.line(&format!(
                "{label} (process {pid}): {detail}, {} times; it is killed and started again",
                complaint.count
            ));
            process.signal(Signal::KILL);
            return;
        };
        process.rest(rest);
        let worker = process.worker;
        let left = self.what_is_left_without(worker);
        self.console.line(&format!(
            "{worker} (process {pid}): {detail}, also after it was started again. It is given up for {} s; \
             what is left: {left}",
            rest.as_secs()
        ));
    }
}
