//! What the tests with real sessions share.

#![allow(clippy::unwrap_used, clippy::expect_used, dead_code)]

use std::{
    io::{Read, Write},
    net::{Shutdown, TcpListener, TcpStream},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering::SeqCst},
        mpsc,
    },
    thread,
    time::Duration,
};

use flockeye_ros2::{NeighbourPose, ObserverSeen, RelativePose, Ros2Parameters, Velocity};
use zenoh::{Session, Wait};

/// How long a test may take.
pub const WATCHDOG: Duration = Duration::from_secs(120);

/// Runs `body` and fails when it does not come back.
pub fn watched(body: impl FnOnce() + Send + 'static) {
    let (done, finished) = mpsc::channel();
    let test = thread::spawn(move || {
        body();
        done.send(()).ok();
    });
    match finished.recv_timeout(WATCHDOG) {
        Err(mpsc::RecvTimeoutError::Timeout) => panic!("still not done after {WATCHDOG:?}"),
        _ => test.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)),
    }
}

/// Looks again and again until there is something to see.
pub fn until<T>(mut look: impl FnMut() -> Option<T>) -> T {
    loop {
        if let Some(seen) = look() {
            return seen;
        }
        thread::sleep(Duration::from_millis(10));
    }
}

pub fn free_port() -> u16 {
    TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port()
}

pub fn tcp(port: u16) -> String {
    format!("tcp/127.0.0.1:{port}")
}

/// A node that connects to a router at `port`, in domain 3.
pub fn parameters(port: u16) -> Ros2Parameters {
    Ros2Parameters { domain: 3, connect: vec![tcp(port)], ..Default::default() }
}

/// A session that is not ours, without multicast, as rmw_zenoh's are.
pub fn session(mode: &str, listen: Option<u16>, connect: Option<u16>) -> Session {
    let endpoints =
        |port: Option<u16>| port.map(|port| format!("\"{}\"", tcp(port))).unwrap_or_default();
    let config = format!(
        r#"{{ mode: "{mode}", listen: {{ endpoints: [{}] }}, connect: {{ endpoints: [{}] }},
             scouting: {{ multicast: {{ enabled: false }} }} }}"#,
        endpoints(listen),
        endpoints(connect)
    );
    zenoh::open(zenoh::Config::from_json5(&config).unwrap()).wait().unwrap()
}

/// A router at `port`, as rmw_zenohd is.
pub fn router(port: u16) -> Session {
    session("router", Some(port), None)
}

fn pose() -> RelativePose {
    RelativePose {
        stamp_utc_ns: 1_700_000_000_000_000_123,
        position: [1.0, -2.0, 0.5],
        orientation: [0.0, 0.0, 0.6, 0.8],
        covariance: std::array::from_fn(|k| k as f64 / 1024.0),
    }
}

/// Where the observer sees `target`.
pub fn neighbour(target: &str) -> NeighbourPose {
    NeighbourPose { target: target.into(), pose: pose() }
}

/// Where `peer` sees the observer, which flies to the peer's left at 2 m/s.
pub fn seen(peer: &str) -> ObserverSeen {
    let velocity = Velocity { linear: [0.0, 2.0, 0.0], angular: [0.0, 0.0, 0.1] };
    ObserverSeen { peer: peer.into(), pose: pose(), velocity: Some(velocity) }
}

/// Passes bytes on between whoever connects and `to`, or holds them while it is stalled.
pub struct Relay {
    pub port: u16,
    pub stalled: Arc<AtomicBool>,
    /// How many have connected.
    pub links: Arc<AtomicUsize>,
}

impl Relay {
    pub fn start(to: u16) -> Self {
        let socket = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = socket.local_addr().unwrap().port();
        let stalled = Arc::new(AtomicBool::new(false));
        let links = Arc::new(AtomicUsize::new(0));
        let (gate, count) = (stalled.clone(), links.clone());
        thread::spawn(move || {
            for near in socket.incoming().flatten() {
                count.fetch_add(1, SeqCst);
                let Ok(far) = TcpStream::connect(("127.0.0.1", to)) else { continue };
                for (from, into) in [(&near, &far), (&far, &near)] {
                    let (from, into) = (from.try_clone().unwrap(), into.try_clone().unwrap());
                    let gate = gate.clone();
                    thread::spawn(move || pass_on(from, into, &gate));
                }
            }
        });
        Self { port, stalled, links }
    }
}

fn pass_on(mut from: TcpStream, mut into: TcpStream, stalled: &AtomicBool) {
    let mut bytes = [0; 4_096];
    while let Ok(length @ 1..) = from.read(&mut bytes) {
        while stalled.load(SeqCst) {
            thread::sleep(Duration::from_millis(1));
        }
        if into.write_all(&bytes[..length]).is_err() {
            break;
        }
    }
    into.shutdown(Shutdown::Both).ok();
}
