//! `flockeye peers`: what the whole swarm reports over Zenoh, as a live table or as JSON lines.

use std::io::Write;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use flockeye_network::{Listener, Network, NetworkParameters, Peers};
use nalgebra::Vector3;

use crate::cli;
use crate::screen::Screen;

/// Reports that may wait to be printed as JSON.
const WAITING_REPORTS: usize = 1_024;

/// Shows it until Ctrl-C.
///
/// # Errors
/// The configuration is wrong, or the network cannot be had.
pub fn run(arguments: &cli::Peers) -> anyhow::Result<()> {
    let stopping = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, stopping.clone()).context("cannot catch signals")?;
    }
    let pipeline = arguments.configuration.load()?;
    let network = Network::open(&NetworkParameters::of_onlooker(&pipeline))?;
    let listener = network.listener()?;
    let end = arguments.duration.map(|duration| Instant::now() + duration);
    let is_over =
        || stopping.load(Ordering::Relaxed) || end.is_some_and(|end| Instant::now() >= end);
    if arguments.json { print_json(&listener, is_over) } else { show_table(&listener, is_over) }
}

/// One JSON object a line for each report; a closed pipe ends it.
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

/// Everybody's latest reports.
fn table(peers: &Peers, now: Instant) -> String {
    let mut text = format!(
        "{:<16} {:<16} {:<10} {:>24} {:>8} {:>8} {:>7} {:>6}",
        "observer", "target", "state", "position m (x y z)", "dist m", "age ms", "per s", "marks"
    );
    for (observer, peer) in &peers.observers {
        if peer.targets.is_empty() {
            let state = if peer.alive { "sees nobody" } else { "gone" };
            text += &format!("\n{observer:<16} {state}");
        }
        for (target, received) in &peer.targets {
            let report = &received.report;
            let [x, y, z] = report.position;
            let state = if peer.alive {
                format!("{:?}", report.state).to_lowercase()
            } else {
                "gone".to_owned()
            };
            text += &format!(
                "\n{observer:<16} {target:<16} {state:<10} {:>24} {:>8.2} {:>8.0} {:>7} {:>6}",
                format!("{x:.3} {y:.3} {z:.3}"),
                Vector3::new(x, y, z).norm(),
                received.age(now).as_secs_f64() * 1e3,
                received.rate_hz(now).map_or("-".to_owned(), |rate| format!("{rate:.1}")),
                report.markers,
            );
        }
    }
    if peers.observers.is_empty() {
        text += "\nnobody is heard of yet";
    }
    text
}
