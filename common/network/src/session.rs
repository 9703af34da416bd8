//! The session as the rest of the program sees it.

use std::sync::Arc;

use crate::connection::Connection;
use crate::error::NetworkError;
use crate::listener::Listener;
use crate::parameters::NetworkParameters;
use crate::reporter::Reporter;

/// A Zenoh session. [`Reporter`]s and [`Listener`]s made from it keep it open by themselves, so
/// they may outlive this value.
#[derive(Debug)]
pub struct Network {
    swarm: String,
    observer: String,
    connection: Arc<Connection>,
    is_onlooker: bool,
}

impl Network {
    /// Opens a session. Peers and routers are ready on return, within a few hundred milliseconds, even if
    /// there is no other drone. A client needs its router: if there is none yet, it keeps trying in the
    /// background. Lost links are restored in the background too.
    ///
    /// # Errors
    /// [`NetworkError::Parameter`] and [`NetworkError::Listen`] say what to change. An address of
    /// an interface that is not up yet is no error: it is listened on once it is there.
    pub fn open(parameters: &NetworkParameters) -> Result<Self, NetworkError> {
        parameters.check()?;
        Ok(Self {
            swarm: parameters.swarm.clone(),
            observer: parameters.observer.clone(),
            connection: Connection::open(parameters)?,
            is_onlooker: parameters.is_onlooker,
        })
    }

    /// Publishes that this drone is alive, until the reporter is dropped.
    ///
    /// # Errors
    /// [`NetworkError::Thread`].
    pub fn reporter(&self) -> Result<Reporter, NetworkError> {
        Reporter::start(self.connection.clone(), &self.swarm, &self.observer)
    }

    /// Receives from all drones of the swarm, this session's own reporter included.
    ///
    /// # Errors
    /// [`NetworkError::Thread`].
    pub fn listener(&self) -> Result<Listener, NetworkError> {
        let own = (!self.is_onlooker).then(|| self.observer.clone());
        Listener::start(self.connection.clone(), &self.swarm, own)
    }

    /// Whether the session is open. Only a client can be without one, while it looks for its
    /// router.
    pub fn is_open(&self) -> bool {
        self.connection.is_open()
    }
}
