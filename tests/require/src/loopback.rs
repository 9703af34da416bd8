//! Shared helpers of tests with real sockets on the loopback interface.

use std::io::{Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering::SeqCst};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread;
use std::time::Duration;

/// Time limit of a test.
pub const WATCHDOG: Duration = Duration::from_secs(60);

/// Runs `body`, and fails if it does not return.
///
/// # Panics
/// The body panics, or has not returned after [`WATCHDOG`].
pub fn watched(body: impl FnOnce() + Send + 'static) {
    let (done, finished) = channel();
    let test = thread::spawn(move || {
        body();
        done.send(()).ok();
    });
    match finished.recv_timeout(WATCHDOG) {
        Err(RecvTimeoutError::Timeout) => panic!("still not done after {WATCHDOG:?}"),
        _ => test.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)),
    }
}

/// Calls `look` repeatedly until it returns a value.
pub fn until<T>(mut look: impl FnMut() -> Option<T>) -> T {
    loop {
        if let Some(seen) = look() {
            return seen;
        }
        thread::sleep(Duration::from_millis(10));
    }
}

/// A free port.
///
/// # Panics
/// There is no free port.
pub fn free_port() -> u16 {
    let socket = TcpListener::bind("127.0.0.1:0").and_then(|socket| socket.local_addr());
    socket.unwrap_or_else(|error| panic!("no port is free: {error}")).port()
}

/// The Zenoh endpoint of a port.
pub fn tcp(port: u16) -> String {
    format!("tcp/127.0.0.1:{port}")
}

/// Passes bytes between its clients and another port, or holds them while it is stalled.
pub struct Relay {
    /// The port for clients.
    pub port: u16,
    /// Whether bytes are held.
    pub stalled: Arc<AtomicBool>,
    /// Number of clients that have connected.
    pub links: Arc<AtomicUsize>,
}

impl Relay {
    /// Starts a relay to the port `to`.
    ///
    /// # Panics
    /// No port is free.
    pub fn start(to: u16) -> Self {
        let socket = TcpListener::bind("127.0.0.1:0");
        let socket = socket.unwrap_or_else(|error| panic!("no port is free: {error}"));
        let port = socket.local_addr().map_or(0, |address| address.port());
        let stalled = Arc::new(AtomicBool::new(false));
        let links = Arc::new(AtomicUsize::new(0));
        let (gate, count) = (stalled.clone(), links.clone());
        thread::spawn(move || {
            for near in socket.incoming().flatten() {
                count.fetch_add(1, SeqCst);
                let Ok(far) = TcpStream::connect(("127.0.0.1", to)) else { continue };
                for (from, into) in [(&near, &far), (&far, &near)] {
                    let (Ok(from), Ok(into)) = (from.try_clone(), into.try_clone()) else {
                        continue;
                    };
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
