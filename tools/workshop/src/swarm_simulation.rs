//! `flockeye swarm sim`: a swarm in one simulated world.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`watch`] | receives reports and truth from each pipeline |
//! | [`score`] | compares the reports with the truth |

mod score;
mod watch;

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use anyhow::ensure;
use clap::Args;
use flockeye_cli::text_table::TextTable;
use flockeye_cli::{Configuration, Screen, duration, signals};
use flockeye_contract::SwarmWay;
use flockeye_runtime::clock;
use flockeye_runtime::instance::Instance;

use self::score::{Claim, ClaimScore};
use self::watch::{SwarmEvent, watch};
use crate::fleet::{Fleet, free_ports};

/// Markers of the default body.
const MARKERS: u32 = 17;
/// Largest number of drones with separate markers in the default dictionary of 250.
const MOST_DRONES: u32 = 250 / MARKERS;
/// Time from the start of the pipelines to time 0 of the simulated world.
const START_TIME: Duration = Duration::from_secs(3);
/// Timeout for the first pose in the swarm.
const PATIENCE: Duration = Duration::from_secs(60);
/// Intervals of the table on a terminal, and of lines without a terminal.
const LIVE_PERIOD: Duration = Duration::from_millis(500);
const PRINT_PERIOD: Duration = Duration::from_secs(5);

/// Arguments of `swarm sim`.
#[derive(Debug, Args)]
pub(crate) struct SimArguments {
    /// How many drones fly, on a ring: 2 to 14.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u32).range(2..=i64::from(MOST_DRONES)))]
    pub drones: u32,
    /// Width and height of their images.
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value = "1280x640", value_parser = size)]
    pub size: [u32; 2],
    /// Frames a second of each camera. All pipelines share this machine.
    #[arg(long, default_value_t = 10.0)]
    pub rate: f64,
    /// For how long from the first pose on: 20s, 5m, 1h. Without it: until Ctrl-C.
    #[arg(long = "for", value_name = "DURATION", value_parser = duration)]
    pub duration: Option<Duration>,
    /// The pipelines' instances are NAME-0, NAME-1 and so on; it is the swarm's name too.
    #[arg(long, value_name = "NAME", default_value = "sim")]
    pub instance: String,
    /// What all of them share otherwise.
    #[command(flatten)]
    pub configuration: Configuration,
    /// JSON: the report alone, at the end.
    #[arg(long)]
    pub json: bool,
}

/// Parses width and height, pixels.
fn size(text: &str) -> Result<[u32; 2], String> {
    let sides = text.split_once('x').map(|(width, height)| (width.parse(), height.parse()));
    match sides {
        Some((Ok(width), Ok(height))) => Ok([width, height]),
        _ => Err("write 1280x640".to_owned()),
    }
}

/// Runs a swarm, shows its state, and compares its poses with the truth.
///
/// # Errors
/// The configuration is wrong, a pipeline ends, or no drone was seen.
pub(crate) fn run(arguments: &SimArguments) -> anyhow::Result<()> {
    let stopping = signals::stop_flag()?;
    let pipelines = pipelines(arguments)?;
    let mut screen = Screen::new();
    let mut fleet = Fleet::start(&pipelines)?;
    let (sender, events) = channel();
    let watching = Arc::new(AtomicBool::new(false));
    let mut threads = Vec::new();
    for (drone, (instance, _)) in pipelines.iter().enumerate() {
        let instance = Instance::named(instance);
        threads.push(watch(instance, name(drone as u32), sender.clone(), watching.clone())?);
    }
    if !arguments.json {
        let folder = fleet.folder.display();
        screen.line(&format!("{} pipelines start; their output is in {folder}", pipelines.len()));
    }
    let mut swarm = SwarmKnowledge::default();
    let started = Instant::now();
    let mut shown = started;
    let period = if screen.is_live() { LIVE_PERIOD } else { PRINT_PERIOD };
    while !stopping.load(Ordering::Relaxed) {
        if let Ok(event) = events.recv_timeout(Duration::from_millis(100)) {
            swarm.take(event);
        }
        fleet.check()?;
        let end = arguments.duration.zip(swarm.first_pose);
        if end.is_some_and(|(duration, first)| first.elapsed() >= duration) {
            break;
        }
        ensure!(
            swarm.first_pose.is_some() || started.elapsed() < PATIENCE,
            "nobody is seen. Cure: nearer drones (--set simulator.distance_m=[0.5, 0.8]), larger images \
             (--size), or a slower rate (--rate)"
        );
        if !arguments.json && shown.elapsed() >= period {
            shown = Instant::now();
            if screen.is_live() {
                screen.table(&swarm.table());
            } else {
                screen.line(&format!(
                    "after {} s: {}",
                    started.elapsed().as_secs(),
                    swarm.counts()
                ));
            }
        }
    }
    watching.store(true, Ordering::Relaxed);
    fleet.end();
    // A failed reader only leaves a gap in the report, so its error is not fatal.
    for outcome in threads.into_iter().map(|thread| thread.join()) {
        if let Ok(Err(error)) = outcome {
            screen.line(&format!("{error:#}"));
        }
    }
    events.try_iter().for_each(|event| swarm.take(event));
    swarm.score.settle();
    let report = swarm.score.report();
    let text = if arguments.json { serde_json::to_string(&report)? } else { report.to_string() };
    screen.line(&text);
    ensure!(!report.ways.is_empty(), "no pose was compared with the truth");
    Ok(())
}

/// The name of a drone and of its body.
fn name(drone: u32) -> String {
    format!("drone-{drone}")
}

/// The instances' names and their arguments of `flockeye up`.
fn pipelines(arguments: &SimArguments) -> anyhow::Result<Vec<(String, Vec<OsString>)>> {
    let drones = arguments.drones;
    let start_ns = clock::monotonic_ns() + START_TIME.as_nanos() as i64;
    let ports = free_ports(drones as usize)?;
    let endpoint = |port: &u16| format!("tcp/127.0.0.1:{port}");
    let [width, height] = arguments.size;
    let defaults = [
        format!("camera.width={width}"),
        format!("camera.height={height}"),
        "simulator.distance_m=[0.6, 1.0]".to_owned(),
        "stages.detection.replicas=1".to_owned(),
    ];
    let mut pipelines = Vec::new();
    for drone in 0..drones {
        let instance = format!("{}-{drone}", arguments.instance);
        let others = (0..drones).filter(|&other| other != drone);
        let body = |other| format!("{{name: {}, first_id: {}}}", name(other), MARKERS * other);
        let bodies: Vec<String> = others.map(body).collect();
        let port = &ports[drone as usize];
        // Each drone connects to the earlier ones, so each pair is linked once.
        let earlier: Vec<String> = ports[..drone as usize].iter().map(endpoint).collect();
        let fixed = [
            format!("instance={instance}"),
            format!("observer.name={}", name(drone)),
            format!("observer.swarm={}", arguments.instance),
            format!("bodies.list=[{}]", bodies.join(", ")),
            format!("simulator.neighbours={}", drones - 1),
            format!("simulator.frames_per_second={}", arguments.rate),
            format!("simulator.swarm={{drone: {drone}, start_ns: {start_ns}}}"),
            format!("gateway.listen=[{}]", endpoint(port)),
            format!("gateway.connect=[{}]", earlier.join(", ")),
        ];
        // Configuration errors are reported before any process starts.
        arguments.configuration.load_with(&defaults, &fixed)?;
        pipelines.push((instance, arguments.configuration.to_arguments(&defaults, &fixed)));
    }
    Ok(pipelines)
}

/// The collected data about a swarm.
#[derive(Debug, Default)]
struct SwarmKnowledge {
    score: ClaimScore,
    first_pose: Option<Instant>,
    /// Each drone's newest claims.
    newest: BTreeMap<String, Vec<Claim>>,
}

impl SwarmKnowledge {
    fn take(&mut self, event: SwarmEvent) {
        match event {
            SwarmEvent::PoseSent { from, frame, sent_ns } => self.score.sent(&from, frame, sent_ns),
            SwarmEvent::ReportArrived {
                observer,
                frame,
                arrived_ns,
                exposure_ns,
                deviation_ns,
            } => {
                self.score.arrived(&observer, frame, arrived_ns);
                self.score.timed(&observer, frame, exposure_ns, deviation_ns);
            }
            SwarmEvent::Truth { from, frame, at_ns, others } => {
                self.score.exposed(&from, frame, at_ns);
                for (to, from_from_to) in others {
                    self.score.truth(&from, &to, at_ns, from_from_to);
                }
                self.score.settle();
            }
            SwarmEvent::Places { from, claims } => {
                if !claims.is_empty() {
                    self.first_pose.get_or_insert_with(Instant::now);
                }
                claims.iter().for_each(|claim| self.score.claim(claim.clone()));
                self.newest.insert(from, claims);
            }
        }
    }

    /// Number of present claims in each way, as text.
    fn counts(&self) -> String {
        let claims = || self.newest.values().flatten();
        let counts = SwarmWay::ALL.iter().map(|&way| {
            let count = claims().filter(|claim| claim.way == way).count();
            format!("{count} {}", way.name())
        });
        counts.collect::<Vec<_>>().join(", ")
    }

    /// A table of the claims of each drone by their way, and the errors so far.
    fn table(&self) -> String {
        let titles = ["drone", "direct", "mutual", "reported", "chained"];
        let mut table = TextTable::new(1, &titles).at_least(&[12, 8, 8, 8, 8]);
        for (from, claims) in &self.newest {
            let count = |way| {
                let is_so = |claim: &&Claim| claim.way == way;
                claims.iter().filter(is_so).count().to_string()
            };
            table.row(
                std::iter::once(from.clone()).chain(SwarmWay::ALL.iter().map(|&way| count(way))),
            );
        }
        format!("{}\n\n{}", table.text(), self.score.report())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use clap::Parser;

    #[derive(Debug, Parser)]
    struct Program {
        #[command(flatten)]
        arguments: SimArguments,
    }

    #[test]
    fn each_drone_has_the_others_as_bodies_and_links_with_those_before_it() {
        let arguments = Program::parse_from(["sim", "--drones", "3", "--set", "simulator.seed=5"]);
        let pipelines = pipelines(&arguments.arguments).unwrap();
        let names: Vec<&str> = pipelines.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["sim-0", "sim-1", "sim-2"]);
        let told = |at: usize| -> String {
            let told = pipelines[at].1.iter().map(|text| text.to_string_lossy().into_owned());
            told.collect::<Vec<_>>().join("\n")
        };
        assert!(told(1).contains("[{name: drone-0, first_id: 0}, {name: drone-2, first_id: 34}]"));
        assert!(told(0).contains("gateway.connect=[]") && told(0).contains("simulator.seed=5"));
        assert_eq!(told(2).matches("tcp/127.0.0.1:").count(), 3);
    }

    #[test]
    fn mistakes_are_told_before_anything_starts() {
        let parsed = |arguments: &[&str]| Program::try_parse_from([&["sim"], arguments].concat());
        for (wrong, what) in [
            (["--drones", "1"], "2..=14"),
            (["--size", "large"], "write 1280x640"),
            (["--for", "soon"], "write 20s"),
        ] {
            let told = parsed(&wrong).unwrap_err().to_string();
            assert!(told.contains(what), "{told}");
        }
        let arguments = parsed(&["--rate", "1000"]).unwrap().arguments;
        let told = pipelines(&arguments).unwrap_err().to_string();
        assert!(told.contains("simulator.frames_per_second"), "{told}");
    }
}
