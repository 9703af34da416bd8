//! The session's interface for the rest of the program.

use std::sync::Arc;

use flockeye_identity::{Member, Trust};

use crate::connection::Connection;
use crate::error::NetworkError;
use crate::listener::Listener;
use crate::parameters::NetworkParameters;
use crate::refused_links;
use crate::reporter::Reporter;

/// A Zenoh session. [`Reporter`]s and [`Listener`]s made from it keep it open by themselves, so
/// they may outlive this value.
#[derive(Debug)]
pub struct Network {
    swarm: String,
    observer: String,
    connection: Arc<Connection>,
    is_onlooker: bool,
    member: Option<Arc<Member>>,
}

impl Network {
    /// Opens a session. Peers and routers are ready on return, within a few hundred milliseconds,
    /// even without any other drone. A client needs its router, and retries in the background until
    /// it is there. Lost links are restored in the background too.
    ///
    /// # Errors
    /// [`NetworkError::Parameter`], [`NetworkError::Listen`], [`NetworkError::Identity`] and
    /// [`NetworkError::Another`] contain the cure. An address of an interface that is not up yet is
    /// no error: Zenoh retries it.
    pub fn open(parameters: &NetworkParameters) -> Result<Self, NetworkError> {
        parameters.check_values()?;
        let member = parameters.member()?.map(Arc::new);
        if member.is_some() {
            refused_links::log();
        }
        let roster = member.as_ref().map(|member| &member.roster);
        Ok(Self {
            swarm: parameters.swarm.clone(),
            observer: parameters.observer.clone(),
            connection: Connection::open(parameters, roster)?,
            is_onlooker: parameters.is_onlooker,
            member,
        })
    }

    /// Publishes that this drone is alive, until the reporter is dropped.
    ///
    /// # Errors
    /// [`NetworkError::Thread`].
    pub fn reporter(&self) -> Result<Reporter, NetworkError> {
        let member = self.member.clone();
        Reporter::start(self.connection.clone(), &self.swarm, &self.observer, member)
    }

    /// Receives from all drones of the swarm, this session's own reporter included.
    ///
    /// # Errors
    /// [`NetworkError::Thread`].
    pub fn listener(&self) -> Result<Listener, NetworkError> {
        let own = (!self.is_onlooker).then(|| self.observer.clone());
        let trust = self.member.clone().map(Trust::of);
        Listener::start(self.connection.clone(), &self.swarm, own, trust)
    }

    /// Number of links that all sessions of this process refused, and the reason for the last
    /// refusal. The other end showed no certificate of the swarm. Zero where
    /// [`flockeye_runtime::logs::init`] was not called.
    pub fn refused_links(&self) -> (u64, String) {
        refused_links::refused_links()
    }

    /// Expiry of this session's certificate, seconds since 1970-01-01 UTC; none without a
    /// certificate.
    pub fn expires_s(&self) -> Option<i64> {
        self.member.as_ref().map(|member| member.certificate.not_after_s)
    }

    /// Whether the session is open. Only a client can lack one, while it waits for its router.
    pub fn is_open(&self) -> bool {
        self.connection.is_open()
    }
}
