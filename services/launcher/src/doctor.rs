//! `flockeye doctor`: everything that can be wrong on a machine before a flight, each with its
//! cure.
//!
//! | module | what it examines |
//! | --- | --- |
//! | [`machine`] | processors, clock frequency, heat |
//! | [`memory`] | shared memory, its limits, and services that would remove it |
//! | [`programs`] | the stages' programs, and what each of them needs |
//! | [`theta`] | a Ricoh Theta on the USB |
//! | [`clock`] | clock synchronisation |
//! | [`network`] | addresses, the interface, keys and certificates |

pub(crate) mod clock;
mod files;
pub(crate) mod machine;
pub(crate) mod memory;
pub(crate) mod network;
pub(crate) mod programs;
pub(crate) mod theta;

use anyhow::bail;
use flockeye_cli::{Configuration, Screen};
use flockeye_config::Resolved;
use flockeye_dictionary::Dictionary;
use flockeye_runtime::findings::{Finding, Gravity};
use serde_json::json;

pub(crate) use files::Machine;

/// Examines this machine, and shows the findings.
pub(crate) fn run(configuration: &Configuration, json: bool) -> anyhow::Result<()> {
    let pipeline = configuration.load()?;
    let mut findings = Vec::new();
    match Resolved::of(pipeline) {
        Err(error) => findings.push(Finding::problem(
            "configuration",
            error.to_string(),
            "pipeline.yaml has every key with its meaning, `flockeye schema` what is allowed",
        )),
        Ok(resolved) => findings.extend(examined(&resolved)),
    }
    let problems = findings.iter().filter(|finding| finding.gravity == Gravity::Problem).count();
    if json {
        let examination = json!({ "would_fly": problems == 0, "findings": findings });
        Screen::new().line(&serde_json::to_string_pretty(&examination)?);
    } else {
        show(&findings, problems);
    }
    if problems > 0 {
        bail!("problems: {problems}. With this configuration this machine would not fly");
    }
    Ok(())
}

fn examined(resolved: &Resolved) -> Vec<Finding> {
    let machine = Machine::this();
    let pipeline = &resolved.pipeline;
    let mut findings = vec![match Dictionary::of(&resolved.bodies) {
        Ok(_) => Finding::fine("configuration", "everything in it is in order"),
        Err(error) => Finding::problem("configuration", error.to_string(), "bodies.dictionary"),
    }];
    findings.extend(machine::examine(&machine));
    findings.extend(memory::examine(&machine, resolved));
    findings.extend(programs::examine(pipeline));
    findings.extend(theta::examine(&machine, &pipeline.source.input));
    findings.extend(clock::examine(&machine));
    findings.extend(network::examine(&machine, pipeline));
    findings
}

fn show(findings: &[Finding], problems: usize) {
    let mut screen = Screen::new();
    for finding in findings {
        let word = match finding.gravity {
            Gravity::Fine => "ok",
            Gravity::Note => "note",
            Gravity::Warning => "WARNING",
            Gravity::Problem => "PROBLEM",
        };
        screen.line(&format!("{word:<8} {:<14} {}", finding.topic, finding.what));
        if let Some(cure) = &finding.cure {
            screen.line(&format!("{:<23} Cure: {cure}", ""));
        }
    }
    let warnings = findings.iter().filter(|finding| finding.gravity == Gravity::Warning).count();
    if problems == 0 {
        screen.line(&format!("it would fly (warnings: {warnings})"));
    }
}

#[cfg(test)]
pub(crate) mod fixture {
    //! A machine of files.

    use tempfile::TempDir;

    use super::Machine;

    /// A machine with these files.
    pub(crate) fn machine(files: &[(&str, &str)]) -> (TempDir, Machine) {
        let folder = TempDir::new().expect("a temporary folder can be made");
        let machine = Machine::below(folder.path());
        for (path, text) in files {
            let path = machine.path(path);
            let parent = path.parent().expect("a file is in a folder");
            std::fs::create_dir_all(parent).expect("it can be made");
            std::fs::write(path, text).expect("it can be written");
        }
        (folder, machine)
    }
}
