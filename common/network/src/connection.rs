//! The Zenoh session, which may not be open yet.

use std::{
    io,
    net::{TcpListener, UdpSocket},
    sync::{Arc, Condvar, Mutex, Weak},
    thread::{self, JoinHandle},
    time::Duration,
};

use flockeye_identity::Roster;
use zenoh::{Session, Wait};

use crate::endpoint::listen_address;
use crate::error::NetworkError;
use crate::parameters::{NetworkMode, NetworkParameters};
use flockeye_runtime::lock::lock;

/// Time between a client's attempts to reach its router.
const RETRY: Duration = Duration::from_secs(1);
/// Period at which a thread that waits for the session checks whether to stop.
const LOOK: Duration = Duration::from_millis(50);

/// A session that is open, or is being opened.
#[derive(Debug, Default)]
pub(crate) struct Connection {
    session: Mutex<Option<Session>>,
    opened: Condvar,
}

impl Connection {
    /// Opens a peer's or a router's session, or starts a thread that opens a client's.
    pub(crate) fn open(
        parameters: &NetworkParameters,
        roster: Option<&Roster>,
    ) -> Result<Arc<Self>, NetworkError> {
        let config = parameters.zenoh_config(roster).to_string();
        let connection = Arc::new(Self::default());
        if parameters.mode == NetworkMode::Client {
            let weak = Arc::downgrade(&connection);
            let routers = parameters.connect.join(", ");
            spawn("zenoh-client", move || look_for_router(&config, &routers, &weak))?;
        } else {
            parameters.listen.iter().try_for_each(|endpoint| probe(endpoint))?;
            *lock(&connection.session) = Some(open_session(&config)?);
        }
        Ok(connection)
    }

    /// Waits until the session is open and returns it; `None` once `stop` returns true.
    pub(crate) fn session(&self, stop: impl Fn() -> bool) -> Option<Session> {
        let mut session = lock(&self.session);
        loop {
            if let Some(session) = &*session {
                return Some(session.clone());
            }
            if stop() {
                return None;
            }
            session = match self.opened.wait_timeout(session, LOOK) {
                Ok((session, _)) => session,
                Err(poisoned) => poisoned.into_inner().0,
            };
        }
    }

    pub(crate) fn is_open(&self) -> bool {
        lock(&self.session).is_some()
    }
}

/// Starts a thread.
///
/// # Errors
/// [`NetworkError::Thread`].
pub fn spawn(
    name: &'static str,
    work: impl FnOnce() + Send + 'static,
) -> Result<JoinHandle<()>, NetworkError> {
    let spawned = thread::Builder::new().name(name.into()).spawn(work);
    spawned.map_err(|source| NetworkError::Thread { name, source })
}

/// Opens a session with this configuration, JSON.
///
/// # Errors
/// [`NetworkError::Zenoh`].
pub fn open_session(config: &str) -> Result<Session, NetworkError> {
    let failed =
        |what| move |error: zenoh::Error| NetworkError::Zenoh { what, reason: error.to_string() };
    let config = zenoh::Config::from_json5(config).map_err(failed("read its configuration"))?;
    zenoh::open(config).wait().map_err(failed("open a session"))
}

/// Tries to open a client's session until it succeeds or the connection is dropped.
fn look_for_router(config: &str, routers: &str, connection: &Weak<Connection>) {
    let mut told = false;
    while connection.strong_count() > 0 {
        match open_session(config) {
            Ok(session) => {
                if let Some(connection) = connection.upgrade() {
                    *lock(&connection.session) = Some(session);
                    connection.opened.notify_all();
                }
                return;
            }
            Err(error) if !told => {
                tracing::warn!("no router at {routers} yet, still trying: {error}");
                told = true;
            }
            Err(_) => {}
        }
        thread::sleep(RETRY);
    }
}

/// Checks whether `endpoint` can be listened on. Zenoh itself retries silently for any reason. That
/// is right for an interface that is not up yet, and wrong for a port that is in use.
fn probe(endpoint: &str) -> Result<(), NetworkError> {
    let Ok(address) = listen_address(endpoint) else { return Ok(()) };
    let bound = if endpoint.starts_with("udp") {
        UdpSocket::bind(address).map(drop)
    } else {
        TcpListener::bind(address).map(drop)
    };
    match bound {
        Err(error) if error.kind() == io::ErrorKind::AddrNotAvailable => {
            tracing::warn!("{endpoint}: no interface has this address yet; still trying");
            Ok(())
        }
        Err(source) => Err(NetworkError::Listen { endpoint: endpoint.into(), source }),
        Ok(()) => Ok(()),
    }
}
