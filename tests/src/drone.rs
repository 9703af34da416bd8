//! Drones at the stations of a radio ([`crate::air`]): pipelines with real gateways and a
//! `told-fusion`. No camera is simulated, so eight drones fit on two processors.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use flockeye_contract::{Peers, Tracks};
use flockeye_runtime::instance::Instance;
use flockeye_runtime::lock::lock;
use flockeye_runtime::onlooker;
use rustix::process::Signal;

use crate::air::{Air, Weather, address};
use crate::{Flight, flockeye, told};

/// Time between two frames, milliseconds.
pub const PERIOD_MS: u64 = 100;
/// Timeout of each wait.
const PATIENCE: Duration = Duration::from_secs(60);

/// A drone at a station: its pipeline and the listener to its gateway.
pub struct Drone {
    /// Pipeline of the drone.
    pub flight: Flight,
    /// Listener to the drone's gateway.
    pub ear: Ear,
}

/// Last arrival of each observer's reports, and arrivals of fusion's tracks.
#[derive(Default)]
struct Heard {
    peers: BTreeMap<String, Instant>,
    tracks: Vec<Instant>,
}

/// Listens to the messages of a gateway.
pub struct Ear {
    heard: Arc<Mutex<Heard>>,
    ending: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Ear {
    fn of(instance: &str) -> Self {
        let heard = Arc::new(Mutex::new(Heard::default()));
        let ending = Arc::new(AtomicBool::new(false));
        let (told, stopping) = (heard.clone(), ending.clone());
        let instance = Instance::named(instance);
        let thread = std::thread::spawn(move || {
            let (ports, mut peers, mut tracks) = loop {
                if stopping.load(Ordering::Relaxed) {
                    return;
                }
                let joined = onlooker::join(&instance).ok().and_then(|(mut ports, _)| {
                    let peers = ports.subscriber::<Peers>().ok()?;
                    let tracks = ports.subscriber::<Tracks>().ok()?;
                    Some((ports, peers, tracks))
                });
                match joined {
                    Some(joined) => break joined,
                    None => std::thread::sleep(Duration::from_millis(20)),
                }
            };
            // Errors are ignored: the pipeline may end first.
            drop(ports.attend(|| {
                let mut heard = lock(&told);
                while let Some(message) = peers.receive()? {
                    for sighting in message.items() {
                        heard.peers.insert(sighting.observer.to_string(), Instant::now());
                    }
                }
                while tracks.receive()?.is_some() {
                    heard.tracks.push(Instant::now());
                }
                Ok((!stopping.load(Ordering::Relaxed)).then_some(Duration::from_millis(20)))
            }));
        });
        Self { heard, ending, thread: Some(thread) }
    }

    /// Number of other drones whose reports arrived since then.
    pub fn heard_since(&self, since: Instant) -> usize {
        let heard = lock(&self.heard);
        heard.peers.values().filter(|at| **at >= since).count()
    }

    /// Last arrival of a drone's reports.
    pub fn last_of(&self, name: &str) -> Option<Instant> {
        lock(&self.heard).peers.get(name).copied()
    }

    /// The longest time between two messages of fusion, since then.
    pub fn longest_pause_since(&self, since: Instant) -> Duration {
        let heard = lock(&self.heard);
        let later: Vec<_> = heard.tracks.iter().filter(|at| **at >= since).collect();
        let pauses = later.windows(2).map(|pair| *pair[1] - *pair[0]);
        pauses.max().unwrap_or(Duration::MAX)
    }
}

impl Drop for Ear {
    fn drop(&mut self) {
        self.ending.store(true, Ordering::Relaxed);
        self.thread.take().map(JoinHandle::join);
    }
}

/// The name of the drone at a station.
pub fn name(station: usize) -> String {
    format!("d{station}")
}

/// The links between drones.
#[derive(Debug, Clone, Copy)]
pub enum Links {
    /// Links between all pairs: each drone connects to those at lower stations.
    Direct,
    /// Links from all drones to the router at a station.
    Router(usize),
}

impl Links {
    /// Settings of the gateway at a station.
    pub fn settings(self, station: usize) -> [String; 4] {
        let (mode, connect) = match self {
            Self::Direct => ("peer", (0..station).map(endpoint).collect()),
            Self::Router(router) => ("client", vec![endpoint(router)]),
        };
        [
            format!("gateway.mode={mode}"),
            format!("gateway.listen=[{}]", endpoint(station)),
            "gateway.unsecured=true".to_owned(),
            format!("gateway.connect=[{}]", connect.join(", ")),
        ]
    }

    /// The endpoint at which an onlooker receives all reports.
    pub fn hub(self) -> String {
        match self {
            Self::Direct => endpoint(0),
            Self::Router(router) => endpoint(router),
        }
    }
}

/// Starts a drone at a station. It reports the next drone on a ring of `count`.
pub fn start(air: &Air, station: usize, count: usize, swarm: &str, links: Links) -> Drone {
    let instance = format!("{swarm}-{station}");
    let mut set = told::settings(PERIOD_MS, &[&name((station + 1) % count)]);
    set.extend([
        format!("instance={instance}"),
        format!("observer.name={}", name(station)),
        format!("observer.swarm={swarm}"),
    ]);
    set.extend(links.settings(station));
    let mut command = air.at(station, &flockeye());
    command.arg("up").args(set.iter().flat_map(|setting| ["--set", setting]));
    Drone { flight: Flight::launch(&instance, command), ear: Ear::of(&instance) }
}

/// The endpoint of a station.
pub fn endpoint(station: usize) -> String {
    format!("tcp/{}:7447", address(station))
}

/// For each drone: times since the last report of each other one, and its warnings.
fn state(drones: &[Drone]) -> String {
    let of = |drone: &Drone| {
        let heard = lock(&drone.ear.heard);
        let ages = heard
            .peers
            .iter()
            .map(|(name, at)| format!("{name} {:.1} s ago", at.elapsed().as_secs_f64()));
        let output = drone.flight.output();
        let warnings = output.lines().filter(|line| line.contains("WARN"));
        let lines: Vec<String> = std::iter::once(ages.collect::<Vec<_>>().join(", "))
            .chain(warnings.map(str::to_owned))
            .collect();
        format!("{} heard {}", drone.flight.instance.name(), lines.join("\n"))
    };
    drones.iter().map(of).collect::<Vec<_>>().join("\n")
}

/// Waits until the condition is true, and returns the time.
pub fn wait_until(what: &str, drones: &[Drone], is_so: impl Fn() -> bool) -> Duration {
    let start = Instant::now();
    while !is_so() {
        assert!(start.elapsed() < PATIENCE, "{what}: in vain\n{}", state(drones));
        std::thread::sleep(Duration::from_millis(10));
    }
    println!("{what}: {:.2} s", start.elapsed().as_secs_f64());
    start.elapsed()
}

/// Ends all drones, and checks that nothing is left.
pub fn end(drones: Vec<Drone>) {
    for drone in &drones {
        drone.flight.signal(Signal::TERM);
    }
    for mut drone in drones {
        drone.flight.wait();
        drone.flight.assert_nothing_left();
    }
}

/// Two drones that receive each other's reports.
pub fn pair(air: &Air, swarm: &str) -> Vec<Drone> {
    let drones: Vec<Drone> =
        (0..2).map(|station| start(air, station, 2, swarm, Links::Direct)).collect();
    let begun = Instant::now();
    wait_until("both are heard", &drones, || {
        drones.iter().all(|drone| drone.ear.heard_since(begun) == 1)
    });
    drones
}

/// The effect of a cut of the radio.
#[derive(Debug, Clone, Copy)]
pub struct Recovery {
    /// Time from its end until each drone has received a report of the other.
    pub heard_after: Duration,
    /// Longest time between two messages of fusion: in bad weather, in the cut and after it.
    pub fusion_pause: Duration,
}

/// Two drones in bad weather, then without radio for the time `cut`, and then in the weather
/// `after`.
pub fn cut(air: &Air, drones: &[Drone], cut: Duration, after: Weather) -> Recovery {
    let hear = |since: Instant| drones.iter().all(|drone| drone.ear.heard_since(since) == 1);
    air.set(Weather::BAD);
    let since = Instant::now();
    std::thread::sleep(Duration::from_secs(3));
    wait_until("both are heard in bad weather", drones, || hear(since));
    air.set(Weather::CUT);
    std::thread::sleep(cut);
    air.set(after);
    let back = Instant::now();
    let heard_after = wait_until("both are heard after the cut", drones, || hear(back));
    let pauses = drones.iter().map(|drone| drone.ear.longest_pause_since(since));
    Recovery { heard_after, fusion_pause: pauses.max().unwrap_or_default() }
}
