//! `flockeye stage test`: tests a stage alone against the contract.
//!
//! The candidate runs in an instance of its own. The test takes the place of all other stages. It
//! sends their messages, valid and malformed ones, and checks every answer. Each finding contains
//! the field, the value, and the part of docs/CONTRACT.md.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`bench`] | the instance, the candidate's process, and its health |
//! | [`beside`] | the candidate beside Flockeye's own stage, on a recording |
//! | [`report`] | checks and findings |
//! | [`pictures`] | views with markers, and a sphere with known brightness along every ray |
//! | [`source`], [`inertial`], [`egomotion`], [`rectification`] | messages to these stages, and checks |
//! | [`detection`], [`fusion`], [`gateway`], [`outlet`] | messages to these stages, and checks |

mod bench;
mod beside;
mod detection;
mod egomotion;
mod fusion;
mod gateway;
mod inertial;
mod outlet;
mod pictures;
mod rectification;
mod report;
mod source;

use anyhow::{Context as _, ensure};
use clap::Args;
use flockeye_cli::{Configuration, Screen};
use flockeye_config::Resolved;
use flockeye_contract::StageName;
use flockeye_launcher::control::stage_name;

use self::bench::Bench;
use crate::fleet::free_ports;

/// Arguments of `stage test`.
#[derive(Debug, Args)]
pub(crate) struct TestArguments {
    /// Which stage the candidate is: its name in pipeline.yaml.
    #[arg(value_parser = stage_name)]
    pub kind: StageName,
    /// Which configuration.
    #[command(flatten)]
    pub configuration: Configuration,
    /// Fly it beside Flockeye's own stage too, on this recording (with --bodies) or on `sim`.
    #[arg(long, value_name = "SRC")]
    pub beside: Option<String>,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
    /// Program and arguments of the candidate; without them Flockeye's own is tested.
    #[arg(last = true)]
    pub command: Vec<String>,
}

/// Tests the candidate.
///
/// # Errors
/// The candidate breaks the contract, or the test cannot run.
pub(crate) fn run(arguments: &TestArguments) -> anyhow::Result<()> {
    let stage = arguments.kind;
    let script = match stage {
        StageName::Capture | StageName::Simulator => source::run,
        StageName::Inertial => inertial::run,
        StageName::Egomotion => egomotion::run,
        StageName::Rectification => rectification::run,
        StageName::Detection => detection::run,
        StageName::Fusion => fusion::run,
        StageName::Gateway => gateway::run,
        StageName::Autopilot | StageName::Ros2 => outlet::run,
    };
    let name = format!("t{}", std::process::id());
    let mut own = vec![format!("instance={name}")];
    if stage != StageName::Gateway {
        own.push("gateway.enabled=false".to_owned());
    }
    match stage {
        // A separate swarm: no real peer receives the reports of the test.
        StageName::Gateway => own.extend([
            format!("gateway.listen=[tcp/127.0.0.1:{}]", free_ports(1)?[0]),
            "gateway.connect=[]".to_owned(),
            "gateway.scout_interface=null".to_owned(),
            format!("observer.swarm={name}"),
        ]),
        // The link has no receiver, so that no real autopilot or node gets artificial poses.
        StageName::Autopilot => own.push(format!("autopilot.link=udpin:{}", free_udp()?)),
        StageName::Ros2 => own.push(format!("ros2.connect=[tcp/127.0.0.1:{}]", free_ports(1)?[0])),
        _ => {}
    }
    let resolved = Resolved::of(arguments.configuration.load_with(&[], &own)?)?;
    if arguments.beside.is_some() {
        beside::check(stage)?;
    }
    let mut bench = Bench::new(&resolved, stage, &arguments.command)?;
    if bench.start()? {
        script(&mut bench, &resolved)?;
        bench.stop()?;
    }
    let (mut report, log) = bench.finish();
    let beside = arguments.beside.as_ref().map_or(Ok(()), |source| {
        let (configuration, command) = (&arguments.configuration, &arguments.command);
        beside::run(stage, configuration, source, command, &mut report)
    });
    let mut screen = Screen::new();
    match arguments.json {
        true => screen.line(&serde_json::to_string_pretty(&report)?),
        false => screen.line(&report.text()),
    }
    beside?;
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

/// A free UDP address of this machine.
fn free_udp() -> anyhow::Result<std::net::SocketAddr> {
    let socket = std::net::UdpSocket::bind("127.0.0.1:0").context("no port is free")?;
    socket.local_addr().context("no port is free")
}

#[cfg(test)]
mod tests {
    #[test]
    fn findings_name_headings_that_are_in_the_contract() {
        let contract = include_str!("../../../docs/CONTRACT.md");
        let sources = [
            include_str!("conformance/bench.rs"),
            include_str!("conformance/beside.rs"),
            include_str!("conformance/detection.rs"),
            include_str!("conformance/egomotion.rs"),
            include_str!("conformance/fusion.rs"),
            include_str!("conformance/gateway.rs"),
            include_str!("conformance/inertial.rs"),
            include_str!("conformance/outlet.rs"),
            include_str!("conformance/rectification.rs"),
            include_str!("conformance/report.rs"),
            include_str!("conformance/source.rs"),
        ];
        let mut count = 0;
        for line in sources.iter().flat_map(|source| source.lines()) {
            let Some((name, text)) = line.split_once(": &str = \"") else { continue };
            let name = name.trim_start_matches("pub(super) ");
            if ["const PAGE", "const OWES", "const MUST_PASS", "const TRACK_PAGE"].contains(&name) {
                let heading = text.trim_end_matches("\";");
                let is_there =
                    contract.lines().any(|line| line.trim_start_matches('#').trim() == heading);
                assert!(is_there, "no heading '{heading}'");
                count += 1;
            }
        }
        assert!(count >= 10, "{count} are named");
    }
}
