//! How a worker's process is started.

use std::time::Duration;

use anyhow::Context;
use flockeye_config::{Scheduling, StageInfo, StageProcess};
use flockeye_contract::StageName;
use flockeye_runtime::backoff::Backoff;
use flockeye_runtime::scheduling::SchedulingPolicy;

/// Program and arguments of a stage: as configured, or the one beside the launcher.
pub(super) fn program(stage: &str, configuration: &StageProcess) -> anyhow::Result<Vec<String>> {
    if !configuration.command.is_empty() {
        return Ok(configuration.command.clone());
    }
    let own = std::env::current_exe().context("cannot find the flockeye program")?;
    let path = own.with_file_name(format!("flockeye-{stage}"));
    anyhow::ensure!(
        path.exists(),
        "the program of {stage} is not at {}. Cure: build the whole workspace (cargo build --release --workspace)",
        path.display()
    );
    Ok(vec![path.to_string_lossy().into_owned()])
}

/// The waits between attempts.
pub(super) fn backoff([first_s, longest_s]: [f64; 2]) -> Backoff {
    let wait = |s: f64| Duration::try_from_secs_f64(s).unwrap_or(Duration::from_secs(1));
    Backoff::new(wait(first_s), wait(longest_s))
}

/// The arguments of `exec-stage` that say how and on which processors a stage runs.
pub(super) fn scheduling_arguments(stage: StageName, configuration: &StageProcess) -> Vec<String> {
    let usual = StageInfo::of(stage).nice;
    let mut arguments = vec![format!("--nice={}", configuration.nice.unwrap_or(usual))];
    if !configuration.cpus.is_empty() {
        let cpus: Vec<String> = configuration.cpus.iter().map(u32::to_string).collect();
        arguments.push(format!("--cpus={}", cpus.join(",")));
    }
    let policy = match configuration.scheduling {
        Scheduling::Normal => return arguments,
        Scheduling::Batch => SchedulingPolicy::Batch,
        Scheduling::Idle => SchedulingPolicy::Idle,
        Scheduling::Fifo => SchedulingPolicy::Fifo,
        Scheduling::RoundRobin => SchedulingPolicy::RoundRobin,
    };
    arguments.push(format!("--scheduling={policy}"));
    arguments.push(format!("--priority={}", configuration.priority));
    arguments
}
