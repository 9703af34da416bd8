//! Parameters of the link to the ROS nodes, and their check.

use serde_json::json;

use flockeye_network::NetworkError;
use flockeye_network::endpoint::{check_connect, check_each, check_protocol};

/// The largest ROS domain.
const MAX_DOMAIN: u32 = 232;
/// Maximum characters of a namespace: the longest topic below it stays within ROS's 247.
const MAX_NAMESPACE_CHARS: usize = 100;
/// Timeout for opening a link, milliseconds.
const OPEN_TIMEOUT_MS: u64 = 1_000;

/// Parameters of the link to the ROS nodes. The default is the router on this machine, which `ros2
/// run rmw_zenoh_cpp rmw_zenohd` starts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Ros2Parameters {
    /// The ROS domain, equal to the nodes' `ROS_DOMAIN_ID`.
    pub domain: u32,
    /// Routers to connect to: `tcp/HOST:PORT` or `udp/ADDRESS:PORT`. The first that answers is
    /// used. It passes all messages on to the ROS nodes that are linked with it.
    pub connect: Vec<String>,
    /// The prefix of all topics but `/tf`, such as `/swarm`; empty: none.
    pub namespace: String,
}

impl Default for Ros2Parameters {
    fn default() -> Self {
        Self { domain: 0, connect: vec!["tcp/127.0.0.1:7447".into()], namespace: String::new() }
    }
}

impl Ros2Parameters {
    /// Refuses parameters that cannot work.
    ///
    /// # Errors
    /// [`NetworkError::Parameter`] names the field and the cure.
    pub fn check(&self) -> Result<(), NetworkError> {
        if self.domain > MAX_DOMAIN {
            let reason = format!("is no ROS domain, which is 0 to {MAX_DOMAIN}");
            return Err(NetworkError::parameter("domain", &self.domain.to_string(), reason));
        }
        // ROS 2 has certificates of its own, which this node lacks.
        check_each("connect", &self.connect, |endpoint| check_protocol(endpoint, false))?;
        check_each("connect", &self.connect, check_connect)?;
        if self.connect.is_empty() {
            let reason = "needs a router to connect to. Cure: name one in connect";
            return Err(NetworkError::parameter("mode", "client", reason));
        }
        check_namespace(&self.namespace)
    }

    /// The parameters as Zenoh's configuration, in JSON. Zenoh's `DEFAULT_CONFIG.json5` explains
    /// each key.
    pub(crate) fn zenoh_config(&self) -> serde_json::Value {
        json!({
            "mode": "client",
            "listen": { "endpoints": [] },
            "connect": {
                "endpoints": self.connect,
                // Opening fails without a router, and is retried outside of Zenoh, so that it can
                // be cancelled.
                "timeout_ms": OPEN_TIMEOUT_MS,
                "exit_on_failure": true,
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
                        // Poses that wait while a link is blocked are stale when they are sent. So
                        // batches are small, and the socket's buffer too.
                        "batch_size": 8_192,
                        "queue": {
                            "congestion_control": { "block": { "wait_before_close": 2_000_000 } },
                        },
                    },
                    "tcp": { "so_sndbuf": 32_768 },
                    // This node receives no long messages; a long one must not exhaust the memory
                    // (Zenoh's default is 1 GiB).
                    "rx": { "max_message_size": 65_536 },
                },
                "shared_memory": { "enabled": false },
            },
        })
    }
}

fn check_namespace(namespace: &str) -> Result<(), NetworkError> {
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
    Err(NetworkError::parameter("namespace", namespace, reason))
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
            connect: vec!["tcp/robot:7447".into(), "udp/[::1]:7447".into()],
            namespace: "/swarm/team_2".into(),
        };
        parameters.check().unwrap();
    }

    #[test]
    fn zenoh_understands_its_configuration() {
        let parameters = Ros2Parameters::default();
        let config = zenoh::Config::from_json5(&parameters.zenoh_config().to_string()).unwrap();
        let read = |key| config.get_json(key).unwrap();
        assert_eq!(read("scouting/multicast/enabled"), "false");
        assert_eq!(read("transport/shared_memory/enabled"), "false");
        assert_eq!(read("transport/link/tcp/so_sndbuf"), "32768");
        assert_eq!(read("connect/timeout_ms"), "1000");
        assert_eq!(read("listen/endpoints"), "[]");
    }
}
