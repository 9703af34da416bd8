//! `flockeye stage test`: a stage alone, against what the contract says.
//!
//! The candidate runs in an instance of its own. All other stages are played by the test: it sends what they
//! would send, also what is malformed, and checks every answer. Each finding names the field, the value, and
//! the part of docs/CONTRACT.md.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`bench`] | the instance, the candidate's process, and its health |
//! | [`report`] | what was checked, and what was found |
//! | [`pictures`] | views with markers, and a sphere whose every ray is known |
//! | [`detection`], [`rectification`], [`fusion`] | what is sent to each kind, and how the answers must be |

mod bench;
mod detection;
mod fusion;
mod pictures;
mod rectification;
mod report;

use anyhow::{bail, ensure};
use clap::Args;
use flockeye_cli::{Configuration, Screen};
use flockeye_config::Resolved;
use flockeye_contract::StageName;

use self::bench::Bench;
use self::report::Report;

/// Arguments of `stage test`.
#[derive(Debug, Args)]
pub struct TestArguments {
    /// Which stage the candidate is: detection, rectification or fusion.
    pub kind: String,
    /// Which configuration.
    #[command(flatten)]
    pub configuration: Configuration,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
    /// Program and arguments of the candidate; without them Flockeye's own is tested.
    #[arg(last = true)]
    pub command: Vec<String>,
}

/// Tests it.
///
/// # Errors
/// The candidate does not keep the contract, or the test cannot be made.
pub fn run(arguments: &TestArguments) -> anyhow::Result<()> {
    let script = match StageName::from_name(&arguments.kind) {
        Some(StageName::Detection) => detection::run,
        Some(StageName::Rectification) => rectification::run,
        Some(StageName::Fusion) => fusion::run,
        _ => bail!(
            "there is no test of a stage '{}'. Cure: one of detection, rectification, fusion",
            arguments.kind
        ),
    };
    let stage = StageName::from_name(&arguments.kind).unwrap_or(StageName::Detection);
    let own = [format!("instance=t{}", std::process::id()), "gateway.enabled=false".to_owned()];
    let resolved = Resolved::of(arguments.configuration.load_with(&[], &own)?)?;
    let mut report = Report::default();
    let mut bench = Bench::new(&resolved, stage, &arguments.command)?;
    if bench.start(&mut report)? {
        script(&mut bench, &resolved, &mut report)?;
        bench.stop(&mut report)?;
    }
    let log = bench.finish();
    let mut screen = Screen::new();
    match arguments.json {
        true => screen.line(&serde_json::to_string_pretty(&report)?),
        false => screen.line(&report.text()),
    }
    let failed = report.failed();
    ensure!(
        failed == 0,
        "{failed} checks failed{}",
        match log.is_empty() {
            true => String::new(),
            false => format!("; the candidate wrote:\n{log}"),
        }
    );
    Ok(())
}
