//! How to reach the ROS nodes, and the check of these parameters.

use serde::{Deserialize, Serialize};
use serde_json::json;

use flockeye_network::endpoint::{check_connect, check_listen, check_protocol};

use crate::error::Ros2Error;

/// The largest ROS domain.
const MAX_DOMAIN: u32 = 232;
/// Maximum characters of a namespace: the longest topic below it stays within ROS's 247.
const MAX_NAMESPACE_CHARS: usize = 100;
/// How long a link may take to open, milliseconds.
const OPEN_TIMEOUT_MS: u64 = 1_000;

/// What this session is to the ROS nodes' sessions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Ros2Mode {
    /// Talks to one router, which passes everything on to the ROS nodes that are linked with it.
    #[default]
    Client,
    /// Talks to ROS nodes directly, as they do among themselves: those that connect to `listen`, and those
    /// that a router in `connect` knows of.
    Peer,
}

/// How to reach the ROS nodes. By default through the router on this machine, which `ros2 run rmw_zenoh_cpp
/// rmw_zenohd` starts.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Ros2Parameters {
    /// The ROS domain, as the nodes have it in `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// What this session is to theirs.
    pub mode: Ros2Mode,
    /// Routers to connect to: `tcp/HOST:PORT` or `udp/ADDRESS:PORT`. A client uses the first that answers.
    pub connect: Vec<String>,
    /// Where a peer accepts links: `tcp/ADDRESS:PORT` or `udp/ADDRESS:PORT`, port 0 for any, one interface
    /// each: its own address, or `tcp/0.0.0.0:PORT#iface=NAME`. Not used by a client.
    pub listen: Vec<String>,
    /// What all topics but `/tf` are below, such as `/swarm`; empty: nothing.
    pub namespace: String,
}

impl Default for Ros2Parameters {
    fn default() -> Self {
        Self {
            domain: 0,
            mode: Ros2Mode::Client,
            connect: vec!["tcp/127.0.0.1:7447".into()],
            listen: vec!["tcp/127.0.0.1:0".into()],
            namespace: String::new(),
        }
    }
}

impl Ros2Parameters {
    /// Refuses what cannot work.
    ///
    /// # Errors
    /// [`Ros2Error::Parameter`] names the field and the cure.
    pub fn check(&self) -> Result<(), Ros2Error> {
        if self.domain > MAX_DOMAIN {
            let reason = format!("is no ROS domain, which is 0 to {MAX_DOMAIN}");
            return Err(wrong("domain", &self.domain.to_string(), reason));
        }
        // ROS 2 has certificates of its own, which this node has not.
        let in_the_clear = |endpoint: &str| check_protocol(endpoint, false);
        check_each("connect", &self.connect, in_the_clear)?;
        check_each("listen", &self.listen, in_the_clear)?;
        check_each("connect", &self.connect, check_connect)?;
        check_each("listen", &self.listen, check_listen)?;
        if self.mode == Ros2Mode::Client && self.connect.is_empty() {
            let reason = "needs a router to connect to. Cure: name one in connect";
            return Err(wrong("mode", "client", reason));
        }
        if self.mode == Ros2Mode::Peer && self.listen.is_empty() {
            let reason = "must listen, for other peers may be those who connect. Cure: an address \
                          of this machine in listen";
            return Err(wrong("mode", "peer", reason));
        }
        check_namespace(&self.namespace)
    }

    /// Where ROS nodes are looked for, for a log line.
    pub(crate) fn whereabouts(&self) -> String {
        match self.mode {
            Ros2Mode::Client => format!("through a router at {}", self.connect.join(", ")),
            Ros2Mode::Peer => format!("by listening on {}", self.listen.join(", ")),
        }
    }

    /// The parameters as Zenoh's configuration, in JSON. Zenoh's `DEFAULT_CONFIG.json5` explains each
    /// key.
    pub(crate) fn zenoh_config(&self) -> serde_json::Value {
        let client = self.mode == Ros2Mode::Client;
        json!({
            "mode": self.mode,
            "listen": {
                "endpoints": if client { &[][..] } else { &self.listen[..] },
                // A port that is in use fails at once, so that it is said. We retry ourselves.
                "timeout_ms": 0,
                "exit_on_failure": true,
            },
            "connect": {
                "endpoints": self.connect,
                // A client fails without a router; we retry ourselves, so that it can be cancelled. A peer
                // connects in the background.
                "timeout_ms": if client { OPEN_TIMEOUT_MS as i64 } else { -1 },
                "exit_on_failure": client,
                "retry": {
                    "period_init_ms": 500, "period_max_ms": 2_000, "period_increase_factor": 1.5,
                },
            },
            "scouting": { "multicast": { "enabled": false } },
            "transport": {
                "unicast": {
                    "open_timeout": OPEN_TIMEOUT_MS,
                    "accept_timeout": OPEN_TIMEOUT_MS,
                },
                "link": {
                    "tx": {
                        // Poses that wait while a link is stuck are stale when they are sent: so small
                        // batches, and a small socket buffer.
                        "batch_size": 8_192,
                        "queue": {
                            "congestion_control": { "block": { "wait_before_close": 2_000_000 } },
                        },
                    },
                    "tcp": { "so_sndbuf": 32_768 },
                    // Nothing long is meant for us; a long message must not take our memory (Zenoh's
                    // default is 1 GiB).
                    "rx": { "max_message_size": 65_536 },
                },
                "shared_memory": { "enabled": false },
            },
        })
    }
}

fn wrong(field: &str, found: &str, reason: impl Into<String>) -> Ros2Error {
    Ros2Error::Parameter { field: field.into(), found: found.into(), reason: reason.into() }
}

fn check_each(
    field: &str,
    endpoints: &[String],
    check: fn(&str) -> Result<(), String>,
) -> Result<(), Ros2Error> {
    endpoints.iter().enumerate().try_for_each(|(index, endpoint)| {
        check(endpoint).map_err(|reason| wrong(&format!("{field}[{index}]"), endpoint, reason))
    })
}

fn check_namespace(namespace: &str) -> Result<(), Ros2Error> {
    let is_token = |token: &str| {
        token.starts_with(|first: char| first.is_ascii_alphabetic())
            && token.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
            && !token.contains("__")
    };
    let is_namespace = namespace.is_empty()
        || namespace.len() <= MAX_NAMESPACE_CHARS
            && namespace.strip_prefix('/').is_some_and(|rest| rest.split('/').all(is_token));
    if is_namespace {
        return Ok(());
    }
    let reason = format!(
        "is no namespace: '/' and letters, digits and single '_', beginning with a letter, once or \
         several times, at most {MAX_NAMESPACE_CHARS} characters; or nothing"
    );
    Err(wrong("namespace", namespace, reason))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    fn refused(change: impl FnOnce(&mut Ros2Parameters)) -> String {
        let mut parameters = Ros2Parameters::default();
        change(&mut parameters);
        parameters.check().expect_err("refused").to_string()
    }

    #[test]
    fn errors_name_the_field_and_the_cure() {
        let message = refused(|p| p.domain = 233);
        assert_eq!(message, "domain: '233' is no ROS domain, which is 0 to 232");
        let message = refused(|p| p.connect = vec!["quic/127.0.0.1:1".into()]);
        assert!(message.starts_with("connect[0]") && message.contains("tcp/ADDRESS:PORT"));
        let message = refused(|p| p.connect.push("tcp/127.0.0.1:0".into()));
        assert!(message.starts_with("connect[1]"), "{message}");
        let message = refused(|p| p.connect = vec!["udp/robot:7447".into()]);
        assert!(message.contains("names work with tcp and tls only"), "{message}");
        let message = refused(|p| p.connect.clear());
        assert!(message.contains("Cure: name one in connect"), "{message}");
        let message = refused(|p| p.listen = vec!["tcp/0.0.0.0:7447".into()]);
        assert!(message.starts_with("listen[0]") && message.contains("#iface=wlan0"), "{message}");
        let message = refused(|p| (p.mode, p.listen) = (Ros2Mode::Peer, Vec::new()));
        assert!(message.contains("must listen"), "{message}");
        for namespace in ["swarm", "/", "/a/", "/a//b", "/2", "/_a", "/a__b", "/a-b", "/ä"] {
            let message = refused(|p| p.namespace = namespace.into());
            assert!(message.starts_with("namespace") && message.contains(namespace), "{message}");
        }
    }

    #[test]
    fn what_flies_is_accepted() {
        Ros2Parameters::default().check().unwrap();
        let parameters = Ros2Parameters {
            domain: 232,
            mode: Ros2Mode::Peer,
            connect: Vec::new(),
            listen: vec!["tcp/0.0.0.0:7447#iface=wlan0".into(), "udp/[::1]:7447".into()],
            namespace: "/swarm/team_2".into(),
        };
        parameters.check().unwrap();
        let remote = Ros2Parameters { connect: vec!["tcp/robot:7447".into()], ..parameters };
        remote.check().unwrap();
    }

    #[test]
    fn zenoh_understands_its_configuration() {
        for (mode, timeout, listens) in
            [(Ros2Mode::Client, "1000", "[]"), (Ros2Mode::Peer, "-1", r#"["tcp/127.0.0.1:0"]"#)]
        {
            let parameters = Ros2Parameters { mode, ..Default::default() };
            let config = zenoh::Config::from_json5(&parameters.zenoh_config().to_string()).unwrap();
            let read = |key| config.get_json(key).unwrap();
            assert_eq!(read("scouting/multicast/enabled"), "false");
            assert_eq!(read("transport/shared_memory/enabled"), "false");
            assert_eq!(read("transport/link/tcp/so_sndbuf"), "32768");
            assert_eq!(read("connect/timeout_ms"), timeout);
            assert_eq!(read("listen/endpoints"), listens);
        }
    }
}
