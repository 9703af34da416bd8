//! A simulated radio between network namespaces, with losses, delays and cuts.
//!
//! Each station is a namespace with its own interface `radio`. A small program in it passes packets
//! to [`Air`] and back over Unix sockets. So programs in a station use the kernel's TCP, but not
//! the machine's network.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::io::{BufRead, BufReader};
use std::os::unix::net::UnixDatagram;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use flockeye_runtime::lock::lock;
use rustix::process::geteuid;

use crate::{Scratch, absent};

/// The program of a station.
const STATION: &str = include_str!("station.py");
/// Longest packet of the stations' interfaces.
const LONGEST_PACKET: usize = 2048;
/// Largest number of packets in transit between two stations; further ones are lost.
const MOST_ON_THE_WAY: usize = 4096;

/// Interval of the checks for the end.
const LOOK: Duration = Duration::from_millis(20);

/// The conditions of the radio for packets.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Weather {
    /// Share of lost packets.
    pub loss: f64,
    /// Delay of each packet.
    pub delay: Duration,
    /// Largest additional random delay. Packets of a link stay in order.
    pub jitter: Duration,
}

impl Weather {
    /// Nothing is lost or delayed.
    pub const CLEAR: Self = Self { loss: 0.0, delay: Duration::ZERO, jitter: Duration::ZERO };
    /// All packets are lost.
    pub const CUT: Self = Self { loss: 1.0, ..Self::CLEAR };
    /// At the edge of the radio's range.
    pub const BAD: Self =
        Self { loss: 0.2, delay: Duration::from_millis(100), jitter: Duration::from_millis(50) };
}

/// The stations and the radio between them. Dropping the value removes them.
pub struct Air {
    stations: Vec<Child>,
    weather: Arc<Mutex<Weather>>,
    /// Stations that are out of range.
    away: Arc<Mutex<Vec<usize>>>,
    ending: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
    _folder: Scratch,
}

impl Air {
    /// Sets up stations in clear weather. If this user may not create namespaces, prints a message
    /// and returns `None`.
    pub fn between(count: usize) -> Option<Self> {
        let folder = Scratch::new("air");
        let socket = UnixDatagram::bind(folder.path("air")).expect("a socket can be bound");
        let mut stations = Vec::new();
        for station in 0..count {
            let path = |name: &str| folder.path(name).to_string_lossy().into_owned();
            let mut command = Command::new("unshare");
            command.arg("--net").args(user_namespace(&["--map-root-user"]));
            command.args(["python3", "-c", STATION, &address(station)]);
            command.args([path(&station.to_string()), path("air")]);
            command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
            let Ok(mut child) = command.spawn() else {
                absent("radio", "unshare, or Python");
                return None;
            };
            let mut said = String::new();
            let output = child.stdout.take().map(BufReader::new);
            let is_ready = output.is_some_and(|mut output| output.read_line(&mut said).is_ok());
            if !is_ready || said.trim() != "ready" {
                drop(child.stdin.take());
                let reason = child.wait_with_output().map(|output| output.stderr);
                let reason = String::from_utf8_lossy(&reason.unwrap_or_default()).into_owned();
                absent(
                    "radio",
                    &format!("network namespaces of our own, with /dev/net/tun: {reason}"),
                );
                return None;
            }
            stations.push(child);
        }
        let weather = Arc::new(Mutex::new(Weather::CLEAR));
        let away = Arc::new(Mutex::new(Vec::new()));
        let ending = Arc::new(AtomicBool::new(false));
        let on_the_way = Arc::new(OnTheWay::default());
        let sender = UnixDatagram::unbound().expect("a socket can be made");
        let sockets: Vec<PathBuf> =
            (0..count).map(|station| folder.path(&station.to_string())).collect();
        let taking = {
            let (weather, away, ending) = (weather.clone(), away.clone(), ending.clone());
            let on_the_way = on_the_way.clone();
            std::thread::spawn(move || take(&socket, count, &on_the_way, &weather, &away, &ending))
        };
        let giving = {
            let ending = ending.clone();
            std::thread::spawn(move || give(&sender, &sockets, &on_the_way, &ending))
        };
        let threads = vec![taking, giving];
        Some(Self { stations, weather, away, ending, threads, _folder: folder })
    }

    /// Changes the weather.
    pub fn set(&self, weather: Weather) {
        *lock(&self.weather) = weather;
    }

    /// Moves a station out of range, or back.
    pub fn set_away(&self, station: usize, is_away: bool) {
        let mut away = lock(&self.away);
        away.retain(|other| *other != station);
        away.extend(is_away.then_some(station));
    }

    /// A command that runs at a station.
    pub fn at(&self, station: usize, program: &std::path::Path) -> Command {
        let mut command = Command::new("nsenter");
        command.args(["--target", &self.stations[station].id().to_string(), "--net"]);
        command.args(user_namespace(&["--user", "--preserve-credentials"])).arg("--").arg(program);
        command
    }
}

impl Drop for Air {
    fn drop(&mut self) {
        self.ending.store(true, Ordering::Relaxed);
        for station in &mut self.stations {
            drop(station.stdin.take());
            drop(station.wait());
        }
        for thread in self.threads.drain(..) {
            drop(thread.join());
        }
    }
}

/// The address of a station.
pub fn address(station: usize) -> String {
    format!("10.77.0.{}", station + 1)
}

/// Adds the arguments that a user other than root needs.
fn user_namespace<'a>(arguments: &'a [&'a str]) -> &'a [&'a str] {
    if geteuid().is_root() { &[] } else { arguments }
}

/// Packets in transit, ordered by their time of arrival.
#[derive(Default)]
struct OnTheWay {
    packets: Mutex<BinaryHeap<Reverse<Packet>>>,
    changed: Condvar,
}

/// Time of arrival, number, receiving station, and bytes.
type Packet = (Instant, u64, usize, Vec<u8>);

/// Receives packets from the stations' socket, and delays or drops them by the weather. It never
/// waits for a station, because a blocked station would block all others.
fn take(
    socket: &UnixDatagram,
    stations: usize,
    on_the_way: &OnTheWay,
    weather: &Mutex<Weather>,
    away: &Mutex<Vec<usize>>,
    ending: &AtomicBool,
) {
    let mut packet = [0; LONGEST_PACKET];
    let mut last = vec![Instant::now(); stations * stations];
    let mut dice = 0x9e37_79b9_7f4a_7c15_u64;
    let mut chance = move || {
        // xorshift64 random numbers. Runs need not be reproducible.
        dice ^= dice << 13;
        dice ^= dice >> 7;
        dice ^= dice << 17;
        dice as f64 / u64::MAX as f64
    };
    let mut count = 0;
    socket.set_read_timeout(Some(LOOK)).expect("a time above zero");
    while !ending.load(Ordering::Relaxed) {
        let Ok(length) = socket.recv(&mut packet) else { continue };
        let ends = ends_of(&packet[..length], stations);
        let Weather { loss, delay, jitter } = *lock(weather);
        let away = lock(away).clone();
        let Some([from, to]) = ends.filter(|ends| !ends.iter().any(|end| away.contains(end)))
        else {
            continue;
        };
        let mut packets = lock(&on_the_way.packets);
        if chance() < loss || packets.len() >= MOST_ON_THE_WAY {
            continue;
        }
        let link = &mut last[from * stations + to];
        *link = (*link).max(Instant::now() + delay + jitter.mul_f64(chance()));
        count += 1;
        packets.push(Reverse((*link, count, to, packet[..length].to_vec())));
        on_the_way.changed.notify_one();
    }
}

/// Sends packets to the stations at their times of arrival.
fn give(socket: &UnixDatagram, sockets: &[PathBuf], on_the_way: &OnTheWay, ending: &AtomicBool) {
    while !ending.load(Ordering::Relaxed) {
        let mut packets = lock(&on_the_way.packets);
        let wait = packets.peek().map_or(LOOK, |Reverse((at, ..))| {
            at.saturating_duration_since(Instant::now()).min(LOOK)
        });
        if !wait.is_zero() {
            drop(on_the_way.changed.wait_timeout(packets, wait));
        } else if let Some(Reverse((_, _, to, packet))) = packets.pop() {
            drop(packets);
            // An error is ignored: the station may have ended.
            socket.send_to(&packet, &sockets[to]).ok();
        }
    }
}

/// The sending and the receiving station of an IPv4 packet.
fn ends_of(packet: &[u8], stations: usize) -> Option<[usize; 2]> {
    let ends = [*packet.get(15)?, *packet.get(19)?];
    let ends = ends.map(|end| usize::from(end).wrapping_sub(1));
    let is_ipv4 = packet[0] >> 4 == 4;
    (is_ipv4 && ends.iter().all(|end| *end < stations)).then_some(ends)
}
