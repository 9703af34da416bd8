//! The session as the rest of the program sees it.

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
    /// even if there is no other drone. A client needs its router: if there is none yet, it keeps
    /// trying in the background. Lost links are restored in the background too.
    ///
    /// # Errors
    /// [`NetworkError::Parameter`], [`NetworkError::Listen`], [`NetworkError::Identity`] and
    /// [`NetworkError::Another`] say what to change. An address of
    /// an interface that is not up yet is no error: it is listened on once it is there.
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

    /// How many links were refused, by all sessions of this process, because the other end showed
    /// no certificate of the swarm, and why the last one was. Zero where
    /// [`flockeye_runtime::logs::init`] was not called.
    pub fn refused_links(&self) -> (u64, String) {
        refused_links::refused_links()
    }

    /// When this session's certificate expires, seconds since 1970-01-01 UTC; none where it has
    /// none.
    pub fn expires_s(&self) -> Option<i64> {
        self.member.as_ref().map(|member| member.certificate.not_after_s)
    }

    /// Whether the session is open. Only a client can be without one, while it looks for its
    /// router.
    pub fn is_open(&self) -> bool {
        self.connection.is_open()
    }
}
