//! The sockets: who connects gets a thread, and there are only so many.

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use flockeye_runtime::logs::Throttle;

use crate::connection;
use crate::explaining::Explainer;
use crate::hub::Hub;
use crate::request::Access;

/// Connections at once: open pages, and requests that are answered.
const MOST_CONNECTIONS: usize = 64;
/// Stack of a connection's thread, bytes.
const STACK: usize = 512 * 1024;

/// Listens at `address`, in threads of its own that end with the process. Returns the address, with the port
/// that was chosen where it was 0.
///
/// # Errors
/// The address is taken or not this machine's, or there are no more threads.
pub fn start(
    address: SocketAddr,
    access: Access,
    hub: Arc<Hub>,
    explainer: Explainer,
) -> io::Result<SocketAddr> {
    let listener = TcpListener::bind(address)?;
    let bound = listener.local_addr()?;
    std::thread::Builder::new()
        .name("listener".into())
        .spawn(move || listen(&listener, access, &hub, explainer))?;
    Ok(bound)
}

fn listen(listener: &TcpListener, access: Access, hub: &Arc<Hub>, explainer: Explainer) {
    let (access, explainer) = (Arc::new(access), Arc::new(explainer));
    let open = Arc::new(AtomicUsize::new(0));
    let mut troubles = Throttle::default();
    loop {
        let stream = match listener.accept() {
            Ok((stream, _)) => stream,
            Err(error) => {
                // Accepting would fail again at once, for example without free descriptors.
                if let Some(more) = troubles.admit() {
                    tracing::warn!(more_since = more, "a connection cannot be accepted: {error}");
                }
                std::thread::sleep(Duration::from_millis(50));
                continue;
            }
        };
        if open.load(Ordering::Relaxed) >= MOST_CONNECTIONS {
            // All places are taken: the connection is closed without an answer.
            continue;
        }
        let place = Place::new(open.clone());
        let (access, hub, explainer) = (access.clone(), hub.clone(), explainer.clone());
        let thread = std::thread::Builder::new().name("connection".into()).stack_size(STACK);
        let spawned = thread.spawn(move || {
            let _place = place;
            connection::serve(stream, &access, &hub, &explainer);
        });
        if let Err(error) = spawned
            && let Some(more) = troubles.admit()
        {
            tracing::warn!(more_since = more, "a connection gets no thread: {error}");
        }
    }
}

/// One of the connections' places, until it is dropped.
struct Place(Arc<AtomicUsize>);

impl Place {
    fn new(open: Arc<AtomicUsize>) -> Self {
        open.fetch_add(1, Ordering::Relaxed);
        Self(open)
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}
