//! Programs of the stages: whether each exists, runs and is of this build, and its findings on the
//! machine.

use std::io::Write;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use flockeye_cli::program;
use flockeye_config::Pipeline;
use flockeye_contract::{CONTRACT_VERSION, StageName};
use flockeye_runtime::findings::{EXAMINE, Finding, Report};

const TOPIC: &str = "programs";
/// Timeout of a program's answer. Graphics drivers take seconds.
const PATIENCE: Duration = Duration::from_secs(20);

/// Runs the examination of every configured stage.
pub(crate) fn examine(pipeline: &Pipeline) -> Vec<Finding> {
    let json = match serde_json::to_vec(pipeline) {
        Ok(json) => json,
        Err(error) => {
            return vec![Finding::problem(TOPIC, error.to_string(), "another configuration")];
        }
    };
    let mut findings = Vec::new();
    let mut fine = Vec::new();
    for (stage, process) in pipeline.stages.iter() {
        if !pipeline.runs(stage) {
            continue;
        }
        if let [program, ..] = &process.command[..] {
            findings.push(foreign(stage, program));
            continue;
        }
        match ask(stage, &json) {
            Ok(report) => {
                fine.push(stage.name());
                findings.extend(report.findings);
            }
            Err(finding) => findings.push(finding),
        }
    }
    if !fine.is_empty() {
        findings.insert(0, Finding::fine(TOPIC, format!("of this build: {}", fine.join(", "))));
    }
    findings
}

/// Existence of a foreign program; nothing else of it is examined.
fn foreign(stage: StageName, program: &str) -> Finding {
    let name = stage.name();
    match program::find(program) {
        Ok(path) => {
            Finding::note(TOPIC, format!("{name} is {}, which is not examined", path.display()))
        }
        Err(_) => Finding::problem(
            TOPIC,
            format!("stages.{name}.command: there is no {program}"),
            "its whole path, or a program on the PATH",
        ),
    }
}

/// Report of a stage's program.
fn ask(stage: StageName, pipeline: &[u8]) -> Result<Report, Finding> {
    let program = format!("flockeye-{}", stage.name());
    let problem =
        |what: String, cure: &str| Finding::problem(TOPIC, format!("{program}: {what}"), cure);
    let path = program::find(&program)
        .map_err(|error| problem(format!("{error:#}"), "install the package flockeye again"))?;
    let libraries = "install the package flockeye again: apt-get install --reinstall flockeye";
    let mut child = Command::new(&path)
        .arg(EXAMINE)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .map_err(|error| problem(error.to_string(), libraries))?;
    if let Some(mut input) = child.stdin.take() {
        // A program that does not read has ended; its status is read below.
        drop(input.write_all(pipeline));
    }
    let started = Instant::now();
    while started.elapsed() < PATIENCE && matches!(child.try_wait(), Ok(None)) {
        std::thread::sleep(Duration::from_millis(5));
    }
    if matches!(child.try_wait(), Ok(None)) {
        // The program hangs in a driver, perhaps for ever.
        drop(child.kill());
        return Err(problem(
            format!("no answer in {} s", PATIENCE.as_secs()),
            "look at dmesg for a driver that hangs",
        ));
    }
    let output = child.wait_with_output().map_err(|error| problem(error.to_string(), libraries))?;
    let said = String::from_utf8_lossy(&output.stderr);
    let last = said.lines().last().unwrap_or_default().trim();
    if !output.status.success() {
        return Err(problem(format!("{} ({last})", output.status), libraries));
    }
    let report: Report = serde_json::from_slice(&output.stdout).map_err(|_| {
        problem("it is of another build, which does not answer".to_owned(), libraries)
    })?;
    match report.contract == CONTRACT_VERSION && report.version == env!("CARGO_PKG_VERSION") {
        true => Ok(report),
        false => Err(problem(
            format!(
                "it is of another build: version {} with contract {}, not {} with {CONTRACT_VERSION}",
                report.version,
                report.contract,
                env!("CARGO_PKG_VERSION")
            ),
            libraries,
        )),
    }
}
