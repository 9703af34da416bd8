//! An autopilot over real UDP sockets on loopback, and over real (pseudo) serial lines.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::fs::File;
use std::io::Write;
use std::net::{SocketAddr, UdpSocket};
use std::os::unix::fs::symlink;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use common::neighbour;
use flockeye_autopilot::link::decode;
use flockeye_autopilot::{AutopilotLine, AutopilotStatus};
use flockeye_config::Autopilot;
use flockeye_require::loopback::watched;
use flockeye_runtime::clock;
use mavlink::dialects::ardupilotmega::{MavMessage as ArduPilotMessage, OBSTACLE_DISTANCE_3D_DATA};
use mavlink::dialects::development::{HEARTBEAT_DATA, MavMessage, TIMESYNC_DATA};
use mavlink::{MavHeader, MavlinkReader, MavlinkVersion, MessageData, write_v2_msg};
use rand::rngs::StdRng;
use rand::{Rng, RngExt, SeedableRng};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use tracing_subscriber::fmt::MakeWriter;

const AUTOPILOT: MavHeader = MavHeader { system_id: 1, component_id: 1, sequence: 0 };

fn open(link: String) -> AutopilotLine {
    let settings = Autopilot { link, target: Some("kite".into()), ..Default::default() };
    AutopilotLine::open(&settings).unwrap()
}

/// A port of loopback that nobody has.
fn free() -> SocketAddr {
    UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap()
}

fn bytes_of(message: &MavMessage) -> Vec<u8> {
    let mut bytes = Vec::new();
    write_v2_msg(&mut bytes, AUTOPILOT, message).unwrap();
    bytes
}

fn heartbeat() -> Vec<u8> {
    bytes_of(&MavMessage::HEARTBEAT(HEARTBEAT_DATA::DEFAULT))
}

fn time(tc1: i64, ts1: i64) -> Vec<u8> {
    bytes_of(&MavMessage::TIMESYNC(TIMESYNC_DATA { tc1, ts1, ..TIMESYNC_DATA::DEFAULT }))
}

/// The next messages that come to a socket; none within a tenth of a second.
fn receive(socket: &UdpSocket) -> Vec<MavMessage> {
    socket.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
    let (mut datagram, mut messages) = ([0; 2048], Vec::new());
    if let Ok(length) = socket.recv(&mut datagram) {
        decode(&datagram[..length], |_, message| messages.push(message.clone()));
    }
    messages
}

/// Waits until the line is as wanted; the watchdog ends a test that waits in vain.
fn wait(
    autopilot: &AutopilotLine,
    is_wanted: impl Fn(&AutopilotStatus) -> bool,
) -> AutopilotStatus {
    loop {
        let status = autopilot.status();
        if is_wanted(&status) {
            return status;
        }
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_wrong_clock_is_found_though_answers_are_late_by_chance() {
    // It started 1234 s before this machine.
    const AHEAD_NS: i64 = 1_234_000_000_000;
    watched(|| {
        let address = free();
        let ours = open(format!("udpin:{address}"));
        let theirs = UdpSocket::bind("127.0.0.1:0").unwrap();
        let is_done = AtomicBool::new(false);
        let offset = std::thread::scope(|scope| {
            scope.spawn(|| {
                let mut random = StdRng::seed_from_u64(7);
                // Late ways, there more than back.
                let mut dawdle = |most_us: u64| {
                    std::thread::sleep(Duration::from_micros(random.random_range(0..most_us)));
                };
                while !is_done.load(Relaxed) {
                    theirs.send_to(&heartbeat(), address).unwrap();
                    for message in receive(&theirs) {
                        let MavMessage::TIMESYNC(question) = message else { continue };
                        dawdle(8000);
                        let answer = time(clock::monotonic_ns() + AHEAD_NS, question.ts1);
                        dawdle(2000);
                        theirs.send_to(&answer, address).unwrap();
                    }
                }
            });
            let status = wait(&ours, |status| {
                status.time_offset.is_some_and(|offset| offset.bound_ns < 4_000_000)
            });
            is_done.store(true, Relaxed);
            status.time_offset.unwrap()
        });
        let error_ns = offset.autopilot_less_monotonic_ns - AHEAD_NS;
        assert!(error_ns.abs() <= offset.bound_ns, "{error_ns} {offset:?}");
    });
}

#[test]
fn a_stranger_does_not_take_the_line_of_an_autopilot_that_speaks() {
    watched(|| {
        let address = free();
        let ours = open(format!("udpin:{address}"));
        let [theirs, stranger] = [(); 2].map(|()| UdpSocket::bind("127.0.0.1:0").unwrap());
        // Its messages come to the autopilot, however often the stranger claims to be it.
        let mut questions = 0;
        while questions < 8 {
            theirs.send_to(&heartbeat(), address).unwrap();
            for message in receive(&theirs) {
                questions += u32::from(matches!(message, MavMessage::TIMESYNC(_)));
                stranger.send_to(&heartbeat(), address).unwrap();
            }
        }
        wait(&ours, |status| status.received > 8);
        assert_eq!(receive(&stranger), []);
    });
}

#[test]
fn questions_are_answered_between_hostile_datagrams() {
    watched(|| {
        let address = free();
        let _ours = open(format!("udpin:{address}"));
        let theirs = UdpSocket::bind("127.0.0.1:0").unwrap();
        let stranger = UdpSocket::bind("127.0.0.1:0").unwrap();
        let mut random = StdRng::seed_from_u64(11);
        let mut hostile = move |bytes: &mut Vec<u8>| {
            bytes.resize(random.random_range(0..3000), 0);
            random.fill_bytes(bytes);
            if random.random() {
                // Half of a message.
                let half = time(0, 5)[..random.random_range(1..20)].to_vec();
                bytes.splice(..0, half);
            }
        };
        let mut bytes = Vec::new();
        for question in 1..100 {
            let is_answer = |message: &MavMessage| matches!(message, MavMessage::TIMESYNC(time) if time.tc1 != 0 && time.ts1 == question);
            let mut is_answered = false;
            while !is_answered {
                // No more than the system holds for a reader that is late, or the question would be
                // dropped.
                for sender in [&theirs, &stranger].into_iter().cycle().take(20) {
                    hostile(&mut bytes);
                    sender.send_to(&bytes, address).unwrap();
                }
                theirs.send_to(&time(0, question), address).unwrap();
                // Some of ours come between.
                let heard = std::iter::repeat_with(|| receive(&theirs)).take(4);
                is_answered = heard.flatten().any(|message| is_answer(&message));
            }
        }
    });
}

#[test]
fn who_is_not_there_yet_is_told_when_it_comes() {
    watched(|| {
        let address = free();
        // Nobody has the port: the system says so after each message, which is no reason to give
        // the line up.
        let ours = open(format!("udpout:{address}"));
        wait(&ours, |status| status.sent > 5);
        assert!(ours.status().is_open);
        let theirs = UdpSocket::bind(address).unwrap();
        while receive(&theirs).is_empty() {}
    });
}

#[test]
fn a_port_that_is_taken_is_opened_once_it_is_free() {
    watched(|| {
        let taken = UdpSocket::bind("127.0.0.1:0").unwrap();
        let ours = open(format!("udpin:{}", taken.local_addr().unwrap()));
        assert!(!ours.status().is_open);
        drop(taken);
        wait(&ours, |status| status.is_open);
    });
}

/// The other end of a serial line, whose device is there as `path`.
fn plug_in(path: &Path) -> File {
    let controller = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&controller).unwrap();
    unlockpt(&controller).unwrap();
    let device = ptsname(&controller, Vec::new()).unwrap().into_string().unwrap();
    std::fs::remove_file(path).ok();
    symlink(device, path).unwrap();
    File::from(controller)
}

/// Whether the neighbour is heard as an obstacle at the other end, before that ends.
fn hears_obstacle(line: &File) -> bool {
    let mut reader = MavlinkReader::new(line);
    loop {
        match reader.read_raw_message::<ArduPilotMessage>(MavlinkVersion::V2) {
            Ok(raw) if raw.message_id() == OBSTACLE_DISTANCE_3D_DATA::ID => return true,
            Ok(_) => {}
            Err(_) => return false,
        }
    }
}

/// What the library logs in this process.
#[derive(Clone, Default)]
struct Log(Arc<Mutex<Vec<u8>>>);

impl Log {
    fn lines_with(&self, text: &str) -> usize {
        let log = self.0.lock().unwrap();
        String::from_utf8_lossy(&log).lines().filter(|line| line.contains(text)).count()
    }
}

impl Write for Log {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl<'a> MakeWriter<'a> for Log {
    type Writer = Self;

    fn make_writer(&'a self) -> Self {
        self.clone()
    }
}

#[test]
fn a_cable_that_is_out_is_said_once_and_its_line_is_opened_when_it_is_in() {
    let log = Log::default();
    let subscriber = tracing_subscriber::fmt().with_writer(log.clone()).with_ansi(false).finish();
    tracing::subscriber::set_global_default(subscriber).unwrap();
    watched(move || {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("no-such-line");
        let ours = open(format!("serial:{}:115200", path.display()));
        while log.lines_with("no line to the autopilot") == 0 {
            std::thread::sleep(Duration::from_millis(5));
        }
        // It is in, out and in again.
        for _ in 0..2 {
            let theirs = plug_in(&path);
            wait(&ours, |status| status.is_open);
            let is_heard = AtomicBool::new(false);
            std::thread::scope(|scope| {
                scope.spawn(|| {
                    (&theirs).write_all(&[0x00, 0xfd, 0x13]).unwrap();
                    (&theirs).write_all(&heartbeat()).unwrap();
                    assert!(hears_obstacle(&theirs));
                    is_heard.store(true, Relaxed);
                });
                while !is_heard.load(Relaxed) {
                    ours.neighbour(&neighbour("kite", clock::monotonic_ns())).unwrap();
                    std::thread::sleep(Duration::from_millis(10));
                }
            });
            wait(&ours, |status| status.is_heard);
            drop(theirs);
            wait(&ours, |status| !status.is_open);
        }
        assert_eq!(log.lines_with("no-such-line"), 3, "one warning, and open twice");
        assert_eq!(log.lines_with("Cure: check the cable"), 1);
    });
}

#[test]
fn a_line_that_takes_no_more_holds_nobody_up() {
    watched(|| {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("line");
        // Nobody reads at the other end; the system holds some thousand bytes.
        let _theirs = plug_in(&path);
        let ours = open(format!("serial:{}:57600", path.display()));
        let mut held_up = 0;
        while ours.status().dropped < 5 {
            for number in 0..64 {
                let state = neighbour(&format!("n{number}"), clock::monotonic_ns());
                let began = Instant::now();
                ours.neighbour(&state).unwrap();
                held_up += u32::from(began.elapsed() > Duration::from_millis(50));
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        // Each message that is given up takes a tenth of a second. Once or twice a busy machine may
        // do that too.
        assert!(held_up < 3, "{held_up} of five");
        let began = Instant::now();
        drop(ours);
        assert!(began.elapsed() < Duration::from_secs(10));
    });
}

#[test]
fn noise_without_end_does_not_keep_the_line_from_ending() {
    watched(|| {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("line");
        let theirs = plug_in(&path);
        let ours = open(format!("serial:{}:57600", path.display()));
        wait(&ours, |status| status.is_open);
        let (is_done, written) = (AtomicBool::new(false), AtomicU32::new(0));
        std::thread::scope(|scope| {
            scope.spawn(|| {
                // Some 60 kilobytes a second, as a line with the wrong rate. It fails once the line
                // is closed.
                while !is_done.load(Relaxed) && (&theirs).write_all(&[0xfd; 64]).is_ok() {
                    written.fetch_add(1, Relaxed);
                    std::thread::sleep(Duration::from_millis(1));
                }
            });
            wait(&ours, |_| written.load(Relaxed) > 200);
            assert!(ours.status().is_open && !ours.status().is_heard);
            drop(ours);
            is_done.store(true, Relaxed);
        });
    });
}
