//! `flockeye peers`: what the whole swarm reports over Zenoh, and where all are from one of them:
//! live tables and a map, or JSON lines.

mod swarm_map;

use std::io::Write;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::ensure;
use clap::Args;
use flockeye_cli::running::{PipelineChoice, choose};
use flockeye_cli::text_table::TextTable;
use flockeye_cli::{Configuration, Screen, duration, signals};
use flockeye_network::{
    Listener, Network, NetworkParameters, Peers, ReportStream, TimedSighting, monotonic_now_ns,
};
use flockeye_peer::{DronePlace, PeerReport, SwarmView};
use nalgebra::Vector3;
use serde_json::{Value, json};

use self::swarm_map::map;

/// Arguments of `peers`.
#[derive(Debug, Args)]
pub(crate) struct PeersArguments {
    /// Which configuration: the swarm and the network are taken from it.
    #[command(flatten)]
    pub configuration: Configuration,
    /// Take both from this running pipeline.
    #[arg(long, value_name = "NAME", conflicts_with_all = ["pipeline", "set"])]
    pub instance: Option<String>,
    /// Link with this endpoint (tcp/10.0.0.7:7447) in place of those of the configuration. May be
    /// repeated.
    #[arg(long, value_name = "ENDPOINT")]
    pub connect: Vec<String>,
    /// From whose place the others are shown. Without it: the observer of the configuration.
    #[arg(long, value_name = "DRONE")]
    pub from: Option<String>,
    /// Print one JSON object per line: each report, and where all are ten times a second.
    #[arg(long)]
    pub json: bool,
    /// Stop after this long: 20s, 5m, 1h.
    #[arg(long = "for", value_name = "DURATION", value_parser = duration)]
    pub duration: Option<Duration>,
}

/// Period of the poses of all drones.
const SWARM_PERIOD: Duration = Duration::from_millis(100);
/// Reports that may wait to be printed as JSON.
const WAITING_REPORTS: usize = 1_024;

/// Shows the reports until Ctrl-C.
pub(crate) fn run(arguments: &PeersArguments) -> anyhow::Result<()> {
    let stopping = signals::stop_flag()?;
    let parameters = parameters(arguments)?;
    let from = arguments.from.as_deref().unwrap_or(&parameters.observer);
    let listener = Network::open(&parameters)?.listener()?;
    let (reports, mut view) = (listener.stream(WAITING_REPORTS), SwarmView::from(from));
    let end = arguments.duration.map(|duration| Instant::now() + duration);
    let is_over =
        || stopping.load(Ordering::Relaxed) || end.is_some_and(|end| Instant::now() >= end);
    if arguments.json {
        print_json(&reports, &mut view, is_over)
    } else {
        show_table(&listener, &reports, &mut view, is_over)
    }
}

/// Access to the swarm's network.
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

/// Takes the next report into `view`, if one comes soon.
fn hear(reports: &ReportStream, view: &mut SwarmView, patience: Duration) -> Option<TimedSighting> {
    let heard = reports.recv_timeout(patience)?;
    view.hear(&PeerReport::from(&heard));
    Some(heard)
}

/// Pose of a drone in the frame of `from`, for a line of JSON: metres, and a quaternion x y z w.
/// The deviations are those of position (m) and rotation vector (rad).
fn place_line(place: &DronePlace, at_ns: i64) -> Value {
    let pose = &place.own_from_drone;
    let deviations: [f64; 6] = std::array::from_fn(|k| pose.covariance[(k, k)].max(0.0).sqrt());
    let mut line = json!({ "name": place.name, "way": place.way.name() });
    if let Some(through) = &place.through {
        line["through"] = json!(through);
    }
    line["age_ms"] = json!(age_ms(place, at_ns));
    line["position"] = json!(pose.a_from_b.translation.vector.as_slice());
    line["orientation"] = json!(pose.a_from_b.rotation.coords.as_slice());
    line["deviations"] = json!(deviations);
    line
}

fn age_ms(place: &DronePlace, at_ns: i64) -> f64 {
    at_ns as f64 * 1e-6 - place.seen_s * 1e3
}

/// Prints one JSON object per line: each report, and the poses of all drones. A closed pipe ends
/// the output.
fn print_json(
    reports: &ReportStream,
    view: &mut SwarmView,
    is_over: impl Fn() -> bool,
) -> anyhow::Result<()> {
    let mut out = std::io::stdout().lock();
    let mut next = Instant::now();
    while !is_over() {
        let mut lines = Vec::new();
        if let Some(heard) = hear(reports, view, SWARM_PERIOD) {
            lines.push(serde_json::to_string(&heard)?);
        }
        if Instant::now() >= next {
            next = Instant::now() + SWARM_PERIOD;
            let at_monotonic_ns = monotonic_now_ns();
            let places = view.places(at_monotonic_ns);
            let swarm = places.iter().map(|place| place_line(place, at_monotonic_ns));
            let line = json!({
                "at_monotonic_ns": at_monotonic_ns,
                "from": view.own(),
                "left_out": view.left_out(),
                "swarm": swarm.collect::<Vec<_>>(),
            });
            lines.push(line.to_string());
        }
        for line in lines {
            if writeln!(out, "{line}").and_then(|()| out.flush()).is_err() {
                return Ok(());
            }
        }
    }
    Ok(())
}

fn show_table(
    listener: &Listener,
    reports: &ReportStream,
    view: &mut SwarmView,
    is_over: impl Fn() -> bool,
) -> anyhow::Result<()> {
    let mut screen = Screen::new();
    let pause = Duration::from_millis(if screen.is_live() { 200 } else { 1_000 });
    while !is_over() {
        let shown = Instant::now();
        while shown.elapsed() < pause {
            hear(reports, view, pause.saturating_sub(shown.elapsed()));
        }
        let mut text = table(&listener.snapshot(), Instant::now());
        let at_ns = monotonic_now_ns();
        let places = view.places(at_ns);
        if !places.is_empty() {
            text += &format!("\n\n{}", swarm_table(&places, at_ns));
            for observer in view.left_out() {
                text += &format!("\n{observer} contradicts the others and is left out");
            }
            text += &format!("\n\n{}", map(view.own(), &places));
        }
        if screen.is_live() {
            screen.table(&text);
        } else {
            screen.line(&text);
        }
    }
    Ok(())
}

/// Position of each drone, and the sightings behind it.
fn swarm_table(places: &[DronePlace], at_ns: i64) -> String {
    let titles = ["drone", "known", "position m (x y z)", "dist m", "\u{b1} mm", "age ms"];
    let mut table = TextTable::new(2, &titles).at_least(&[16, 24, 24, 8, 6, 8]);
    for place in places {
        let pose = &place.own_from_drone;
        let position = pose.a_from_b.translation.vector;
        let deviation_m = pose.covariance.fixed_view::<3, 3>(0, 0).trace().max(0.0).sqrt();
        let through = place.through.as_ref().map(|drone| format!(" through {drone}"));
        table.row([
            place.name.clone(),
            format!("{}{}", place.way.name(), through.unwrap_or_default()),
            format!("{:.3} {:.3} {:.3}", position.x, position.y, position.z),
            format!("{:.2}", position.norm()),
            format!("{:.1}", deviation_m * 1e3),
            format!("{:.0}", age_ms(place, at_ns)),
        ]);
    }
    table.text()
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
            let [x, y, z] = report.target.position;
            let state = if peer.alive {
                format!("{:?}", report.target.state).to_lowercase()
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
                report.target.markers.to_string(),
            ]);
        }
    }
    let mut text = table.text();
    for (observer, peer) in peers.observers.iter().filter(|(_, peer)| peer.refused.total() > 0) {
        let refused = &peer.refused;
        text += &format!(
            "\n{observer}: refused {} malformed, {} stale, {} from the future, {} replayed, {} untrusted",
            refused.malformed, refused.stale, refused.future, refused.replayed, refused.untrusted
        );
    }
    if peers.observers.is_empty() {
        text += "\nno report has come yet";
    }
    text
}
