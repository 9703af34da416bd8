//! Drones in network namespaces of their own, over a radio that loses, delays and cuts ([`flockeye_tests::air`]).
//!
//! Each drone is a pipeline with its real gateway, whose fusion says what it is told. So no camera is simulated, and
//! eight of them fit on two processors.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use flockeye_contract::{Peers, Tracks};
use flockeye_runtime::instance::Instance;
use flockeye_runtime::lock::lock;
use flockeye_runtime::onlooker;
use flockeye_tests::air::{Air, Weather, address};
use flockeye_tests::{Beside, Flight, flockeye, run, told, unique};
use rustix::process::Signal;

/// From frame to frame, milliseconds.
const PERIOD_MS: u64 = 100;
/// Nothing here takes this long.
const PATIENCE: Duration = Duration::from_secs(60);
/// A machine that does other things takes longer than what a drone may take. It is printed how long it took.
const SLOW: u32 = 3;

/// A drone at a station: its pipeline, and what its gateway hears.
struct Drone {
    flight: Flight,
    ear: Ear,
}

/// When reports of each observer came in last, and when fusion's tracks came.
#[derive(Default)]
struct Heard {
    peers: BTreeMap<String, Instant>,
    tracks: Vec<Instant>,
}

struct Ear {
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
            // It ends with its pipeline, whichever is first.
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

    /// How many others were heard since then.
    fn heard_since(&self, since: Instant) -> usize {
        let heard = lock(&self.heard);
        heard.peers.values().filter(|at| **at >= since).count()
    }

    /// When one was heard last.
    fn last_of(&self, name: &str) -> Option<Instant> {
        lock(&self.heard).peers.get(name).copied()
    }

    /// The longest time from one of fusion's messages to the next, since then.
    fn longest_pause_since(&self, since: Instant) -> Duration {
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

fn name(station: usize) -> String {
    format!("d{station}")
}

/// How drones are linked.
#[derive(Debug, Clone, Copy)]
enum Links {
    /// Each with each: it connects to those of lower stations.
    Direct,
    /// All with the router at a station alone.
    Router(usize),
}

impl Links {
    /// Settings of the gateway at a station.
    fn settings(self, station: usize) -> [String; 4] {
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

    /// Where an onlooker hears all.
    fn hub(self) -> String {
        match self {
            Self::Direct => endpoint(0),
            Self::Router(router) => endpoint(router),
        }
    }
}

/// Starts a drone at a station, which sees the next one on a ring of `count`.
fn start(air: &Air, station: usize, count: usize, swarm: &str, links: Links) -> Drone {
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
fn endpoint(station: usize) -> String {
    format!("tcp/{}:7447", address(station))
}

/// Who heard whom how long ago, and the warnings of each drone.
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

/// Waits until it is so, and says how long that took.
fn wait_until(what: &str, drones: &[Drone], is_so: impl Fn() -> bool) -> Duration {
    let start = Instant::now();
    while !is_so() {
        assert!(start.elapsed() < PATIENCE, "{what}: in vain\n{}", state(drones));
        std::thread::sleep(Duration::from_millis(10));
    }
    println!("{what}: {:.2} s", start.elapsed().as_secs_f64());
    start.elapsed()
}

fn end(drones: Vec<Drone>) {
    for drone in &drones {
        drone.flight.signal(Signal::TERM);
    }
    for mut drone in drones {
        drone.flight.wait();
        drone.flight.assert_nothing_left();
    }
}

/// Eight drones hear each other soon, notice who leaves, and hear it soon when it is back.
fn eight_find_each_other(air: &Air, links: Links) {
    let (swarm, count) = (unique("air"), 8);
    let drones: Vec<Drone> =
        (0..count).map(|station| start(air, station, count, &swarm, links)).collect();
    let limit = Duration::from_secs(3) * SLOW;
    let since = Instant::now();
    let took = wait_until("all are heard by all", &drones, || {
        drones.iter().all(|drone| drone.ear.heard_since(since) == count - 1)
    });
    assert!(took < limit, "{took:?}");
    let gone = name(3);
    let mut look_on = air.at(0, &flockeye());
    look_on.args(["peers", "--connect", &links.hub()]);
    look_on.args(["--set", &format!("observer.swarm={swarm}")]);
    let mut look_on = Flight::launch(&unique("look"), look_on);
    look_on.wait_for(&gone);
    air.set_away(3, true);
    let left = Instant::now();
    look_on.wait_for("gone");
    // Two leases, and a second until it is printed.
    assert!(left.elapsed() < Duration::from_secs(7) * SLOW, "{:?}", left.elapsed());
    println!("it is known to be gone: {:.2} s", left.elapsed().as_secs_f64());
    air.set_away(3, false);
    let back = Instant::now();
    let others = || drones.iter().enumerate().filter(|(station, _)| *station != 3);
    let took = wait_until("it is heard by all again", &drones, || {
        others().all(|(_, drone)| drone.ear.last_of(&gone).is_some_and(|at| at >= back))
            && drones[3].ear.heard_since(back) == count - 1
    });
    assert!(took < limit, "{took:?}");
    drop(look_on);
    end(drones);
}

#[test]
fn eight_drones_find_each_other_directly() {
    let Some(air) = Air::between(8) else { return };
    eight_find_each_other(&air, Links::Direct);
}

#[test]
fn eight_drones_find_each_other_through_a_router() {
    let Some(air) = Air::between(9) else { return };
    let mut router = air.at(8, &flockeye().with_file_name("zenoh-router"));
    router.arg(endpoint(8));
    let _router = Beside::start(router);
    eight_find_each_other(&air, Links::Router(8));
}

/// Two drones that hear each other.
fn pair(air: &Air, swarm: &str) -> Vec<Drone> {
    let drones: Vec<Drone> =
        (0..2).map(|station| start(air, station, 2, swarm, Links::Direct)).collect();
    let begun = Instant::now();
    wait_until("both are heard", &drones, || {
        drones.iter().all(|drone| drone.ear.heard_since(begun) == 1)
    });
    drones
}

/// The drones have said where their neighbours are, and say no more: what is heard is the last pose.
#[test]
fn who_joins_late_has_the_last_pose_soon() {
    let Some(air) = Air::between(3) else { return };
    let swarm = unique("late");
    let drones = pair(&air, &swarm);
    for drone in &drones {
        let (succeeded, output) =
            run(&["stop", "fusion", "--instance", drone.flight.instance.name()]);
        assert!(succeeded, "{output}");
    }
    let mut join = air.at(2, &flockeye());
    join.args(["peers", "--json", "--connect", &endpoint(0)]);
    join.args(["--set", &format!("observer.swarm={swarm}")]);
    let joined = Instant::now();
    let mut join = Flight::launch(&unique("join"), join);
    join.wait_for("\"target\":\"d1\"");
    let took = joined.elapsed();
    println!("the last pose is there: {:.2} s after the start of the program", took.as_secs_f64());
    assert!(took < Duration::from_secs(1) * SLOW, "{took:?}");
    drop(join);
    end(drones);
}

#[test]
fn a_bad_radio_and_a_cut_one_hold_nobody_up_and_poses_flow_again() {
    let Some(air) = Air::between(2) else { return };
    let swarm = unique("cut");
    let drones = pair(&air, &swarm);
    let hear = |since: Instant| drones.iter().all(|drone| drone.ear.heard_since(since) == 1);
    let bad =
        Weather { loss: 0.2, delay: Duration::from_millis(100), jitter: Duration::from_millis(50) };
    for _ in 0..2 {
        air.set(bad);
        let since = Instant::now();
        std::thread::sleep(Duration::from_secs(3));
        wait_until("both are heard in bad weather", &drones, || hear(since));
        air.set(Weather::CUT);
        std::thread::sleep(Duration::from_secs(8));
        air.set(Weather::CLEAR);
        let back = Instant::now();
        let took = wait_until("both are heard after the cut", &drones, || hear(back));
        assert!(took < Duration::from_secs(8) * SLOW, "{took:?}");
        let pauses = drones.iter().map(|drone| drone.ear.longest_pause_since(since));
        let longest = pauses.max().unwrap_or_default();
        assert!(longest < Duration::from_millis(20 * PERIOD_MS), "fusion was held up: {longest:?}");
    }
    end(drones);
}
