//! The sockets: each connection gets a thread, up to a maximum.

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::time::Duration;

use flockeye_runtime::logs::Throttle;

use crate::connection;
use crate::explaining::Explainer;
use crate::pages::Pages;
use crate::request::Access;

/// Maximum connections at once: open pages, and requests that are being answered.
const MOST_CONNECTIONS: usize = 64;
/// Stack of a connection's thread, bytes.
const STACK: usize = 512 * 1024;

/// Listens at `address`, in threads of its own that end with the process. Returns the bound
/// address, which has the chosen port where the given one was 0.
///
/// # Errors
/// The address is in use or not this machine's, or no thread can be started.
pub(crate) fn start(
    address: SocketAddr,
    access: Access,
    pages: Arc<Pages>,
    explainer: Explainer,
) -> io::Result<SocketAddr> {
    let listener = TcpListener::bind(address)?;
    let bound = listener.local_addr()?;
    std::thread::Builder::new()
        .name("listener".into())
        .spawn(move || listen(&listener, access, &pages, explainer))?;
    Ok(bound)
}

fn listen(listener: &TcpListener, access: Access, pages: &Arc<Pages>, explainer: Explainer) {
    let (access, explainer) = (Arc::new(access), Arc::new(explainer));
    // Each open connection holds a clone, which counts it.
    let open = Arc::new(());
    let mut troubles = Throttle::default();
    loop {
        let stream = match listener.accept() {
            Ok((stream, _)) => stream,
            Err(error) => {
                // Accepting would fail again at once, for example without free file descriptors.
                if let Some(more) = troubles.admit() {
                    tracing::warn!(more_since = more, "a connection cannot be accepted: {error}");
                }
                std::thread::sleep(Duration::from_millis(50));
                continue;
            }
        };
        if Arc::strong_count(&open) > MOST_CONNECTIONS {
            // The maximum is reached: the connection is closed without an answer.
            continue;
        }
        let place = open.clone();
        let (access, pages, explainer) = (access.clone(), pages.clone(), explainer.clone());
        let thread = std::thread::Builder::new().name("connection".into()).stack_size(STACK);
        let spawned = thread.spawn(move || {
            let _place = place;
            connection::serve(stream, &access, &pages, &explainer);
        });
        if let Err(error) = spawned
            && let Some(more) = troubles.admit()
        {
            tracing::warn!(more_since = more, "a connection gets no thread: {error}");
        }
    }
}
