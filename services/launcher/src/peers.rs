//! `flockeye peers`: what the whole swarm reports over Zenoh, as a live table or as JSON lines.

use std::io::Write;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::ensure;
use clap::Args;
use flockeye_cli::text_table::TextTable;
use flockeye_cli::{Configuration, Screen, duration, signals};
use flockeye_network::{Listener, Network, NetworkParameters, Peers};
use nalgebra::Vector3;

use crate::attach::{PipelineChoice, choose};

/// Arguments of `peers`.
#[derive(Debug, Args)]
pub struct PeersArguments {
    /// Which configuration: the swarm and the network are taken from it.
    #[command(flatten)]
    pub configuration: Configuration,
    /// Take both from this running pipeline.
    #[arg(long, value_name = "NAME", conflicts_with_all = ["pipeline", "set"])]
    pub instance: Option<String>,
    /// Link with this endpoint (tcp/10.0.0.7:7447) in place of those of the configuration. May be repeated.
    #[arg(long, value_name = "ENDPOINT")]
    pub connect: Vec<String>,
    /// Print one JSON object per line for each report.
    #[arg(long)]
    pub json: bool,
    /// Stop after this long: 20s, 5m, 1h.
    #[arg(long = "for", value_name = "DURATION", value_parser = duration)]
    pub duration: Option<Duration>,
}

/// Reports that may wait to be printed as JSON.
const WAITING_REPORTS: usize = 1_024;

/// Shows the reports until Ctrl-C.
///
/// # Errors
/// The configuration is wrong, no such pipeline runs, or the network cannot be opened.
pub fn run(arguments: &PeersArguments) -> anyhow::Result<()> {
    let stopping = signals::stop_flag()?;
    let network = Network::open(&parameters(arguments)?)?;
    let listener = network.listener()?;
    let end = arguments.duration.map(|duration| Instant::now() + duration);
    let is_over =
        || stopping.load(Ordering::Relaxed) || end.is_some_and(|end| Instant::now() >= end);
    if arguments.json { print_json(&listener, is_over) } else { show_table(&listener, is_over) }
}

/// How the swarm is reached.
fn parameters(arguments: &PeersArguments) -> anyhow::Result<NetworkParameters> {
    let pipeline = match &arguments.instance {
        Some(name) => choose(&PipelineChoice { instance: Some(name.clone()) })?.pipeline()?,
        None => arguments.configuration.load()?,
    };
    let mut parameters = NetworkParameters::of_onlooker(&pipeline);
    if !arguments.connect.is_empty() {
        parameters.connect = arguments.connect.clone();
    }
    ensure!(
        !parameters.connect.is_empty() || parameters.scout_interface.is_some(),
        "there is nothing to link with: gateway.listen has port 0 alone. Cure: --connect ENDPOINT"
    );
    Ok(parameters)
}

/// Prints one JSON object per line for each report. A closed pipe ends it.
fn print_json(listener: &Listener, is_over: impl Fn() -> bool) -> anyhow::Result<()> {
    let reports = listener.stream(WAITING_REPORTS);
    let mut out = std::io::stdout().lock();
    while !is_over() {
        if let Some(heard) = reports.recv_timeout(Duration::from_millis(100)) {
            let line = serde_json::to_string(&heard)?;
            if writeln!(out, "{line}").and_then(|()| out.flush()).is_err() {
                return Ok(());
            }
        }
    }
    Ok(())
}

fn show_table(listener: &Listener, is_over: impl Fn() -> bool) -> anyhow::Result<()> {
    let mut screen = Screen::new();
    while !is_over() {
        let text = table(&listener.snapshot(), Instant::now());
        if screen.is_live() {
            screen.table(&text);
        } else {
            screen.line(&text);
        }
        let pause = if screen.is_live() { 200 } else { 1000 };
        std::thread::sleep(Duration::from_millis(pause));
    }
    Ok(())
}

/// The latest report of each observer on each target.
fn table(peers: &Peers, now: Instant) -> String {
    let titles =
        ["observer", "target", "state", "position m (x y z)", "dist m", "age ms", "per s", "marks"];
    let mut table = TextTable::new(3, &titles).at_least(&[16, 16, 10, 24, 8, 8, 7, 6]);
    for (observer, peer) in &peers.observers {
        if peer.targets.is_empty() {
            let state = if peer.alive { "sees nobody" } else { "gone" };
            table.row([observer.as_str(), state]);
        }
        for (target, received) in &peer.targets {
            let report = &received.report;
            let [x, y, z] = report.position;
            let state = if peer.alive {
                format!("{:?}", report.state).to_lowercase()
            } else {
                "gone".to_owned()
            };
            table.row([
                observer.to_string(),
                target.to_string(),
                state,
                format!("{x:.3} {y:.3} {z:.3}"),
                format!("{:.2}", Vector3::new(x, y, z).norm()),
                format!("{:.0}", received.age(now).as_secs_f64() * 1e3),
                received.rate_hz(now).map_or("-".to_owned(), |rate| format!("{rate:.1}")),
                report.markers.to_string(),
            ]);
        }
    }
    let mut text = table.text();
    if peers.observers.is_empty() {
        text += "\nno report has come yet";
    }
    text
}
