//! Parameters of the link to the swarm, and their check.

use flockeye_contract::wire::{MAX_FRAME_REPORT_BYTES, MAX_NAME_CHARS, is_name};
use flockeye_identity::{Member, MemberFiles, Roster};
use flockeye_runtime::clock::utc_s;
use serde::Serialize;
use serde_json::json;

use crate::access::access_rules;
use crate::endpoint::{check_connect, check_each, check_listen, check_protocol};
use crate::error::NetworkError;

/// The role of this session towards the others.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum NetworkMode {
    /// Connects to every other peer directly. Drones are peers.
    #[default]
    Peer,
    /// Connects to one router (or peer) only, at the first `connect` endpoint that answers.
    Client,
    /// Passes messages on between others.
    Router,
}

/// Parameters of the link to the swarm. By default nothing leaves the machine. For a flight, put
/// the radio's address into `listen`, and a neighbour into `connect`, or set `scout_interface`.
#[derive(Debug, Clone, PartialEq)]
pub struct NetworkParameters {
    /// Name of the swarm; messages of other swarms are not received. Letters, digits, `-`, `_`,
    /// `.`.
    pub swarm: String,
    /// Name of this drone, unique in the swarm.
    pub observer: String,
    /// The role of this session towards the others.
    pub mode: NetworkMode,
    /// Endpoints that accept links: `tcp/ADDRESS:PORT` or `udp/ADDRESS:PORT`, port 0 for any. Each
    /// is on one interface: its own address, or `tcp/0.0.0.0:PORT#iface=NAME`. Not used by a
    /// client.
    pub listen: Vec<String>,
    /// Endpoints to connect to: `tcp/HOST:PORT` or `udp/ADDRESS:PORT`. One that does not answer is
    /// retried in the background. Only one of two peers connects to the other.
    pub connect: Vec<String>,
    /// The interface, by name or address, for the search for peers by UDP multicast
    /// (224.0.0.224:7446); none: no search.
    pub scout_interface: Option<String>,
    /// Whether this session only observes, and is no drone of the swarm. Then the drones' clock
    /// offsets of `observer` are not those of this machine's clock.
    pub is_onlooker: bool,
    /// Files for authentication of the swarm's members; none: messages of any origin are accepted.
    pub security: Option<MemberFiles>,
    /// Timeout for opening a link, milliseconds. It covers several round trips, of which each may
    /// be lost and repeated after a second (docs/results/constants.md#links-over-a-bad-radio).
    pub open_timeout_ms: u64,
    /// Time for which a silent neighbour counts as connected, milliseconds.
    pub lease_ms: u64,
}

impl Default for NetworkParameters {
    fn default() -> Self {
        Self {
            swarm: "swarm".into(),
            observer: "observer".into(),
            mode: NetworkMode::Peer,
            listen: vec!["tcp/127.0.0.1:0".into()],
            connect: Vec::new(),
            scout_interface: None,
            is_onlooker: false,
            security: None,
            open_timeout_ms: 5_000,
            lease_ms: 3_000,
        }
    }
}

impl NetworkParameters {
    /// Refuses parameters, keys and certificates that cannot work.
    ///
    /// # Errors
    /// [`NetworkError::Parameter`], [`NetworkError::Identity`] or [`NetworkError::Another`] names
    /// the field or the file, and the cure.
    pub fn check(&self) -> Result<(), NetworkError> {
        self.check_values()?;
        self.member().map(drop)
    }

    /// The session's identity; none in a swarm without security.
    pub(crate) fn member(&self) -> Result<Option<Member>, NetworkError> {
        let Some(files) = &self.security else { return Ok(None) };
        let member = Member::load(files, utc_s())?;
        let same = |what, found: &str, wanted: &str| {
            if found == wanted {
                return Ok(());
            }
            Err(NetworkError::Another { what, found: found.into(), wanted: wanted.into() })
        };
        same("roster's swarm", &member.roster.swarm, &self.swarm)?;
        // An onlooker publishes nothing, so it may use any member's certificate.
        if !self.is_onlooker {
            same("certificate's name", &member.certificate.name, &self.observer)?;
        }
        Ok(Some(member))
    }

    pub(crate) fn check_values(&self) -> Result<(), NetworkError> {
        check_name("swarm", &self.swarm)?;
        check_name("observer", &self.observer)?;
        let check = |endpoint: &str| check_protocol(endpoint, self.security.is_some());
        check_each("listen", &self.listen, |endpoint| check(endpoint).and(check_listen(endpoint)))?;
        check_each("connect", &self.connect, |endpoint| {
            check(endpoint).and(check_connect(endpoint))
        })?;
        if let (Some(interface), Some(_)) = (&self.scout_interface, &self.security) {
            let reason = "cannot be used with security, because what comes by multicast is not protected. Cure: \
                          name the others in connect";
            return Err(NetworkError::parameter("scout_interface", interface, reason));
        }
        if self.mode == NetworkMode::Client && self.connect.is_empty() {
            let reason = "needs a router to connect to. Cure: name one in connect";
            return Err(NetworkError::parameter("mode", "client", reason));
        }
        self.scout_interface.as_deref().map_or(Ok(()), check_interface)?;
        check_range("open_timeout_ms", self.open_timeout_ms, 100, 10_000)?;
        check_range("lease_ms", self.lease_ms, 500, 60_000)
    }

    /// The parameters as Zenoh's configuration in JSON, with access for the members on `roster`
    /// only. Zenoh's `DEFAULT_CONFIG.json5` explains each key.
    pub(crate) fn zenoh_config(&self, roster: Option<&Roster>) -> serde_json::Value {
        let client = self.mode == NetworkMode::Client;
        // Peers connect in the background without a limit. A client fails without a router, and
        // retries outside of Zenoh, so that it can be cancelled.
        let connect_timeout_ms = if client { self.open_timeout_ms as i64 } else { -1 };
        let retry = json!({
            "period_init_ms": 500, "period_max_ms": 2_000, "period_increase_factor": 1.5,
        });
        let by_hearsay: &[&str] = if self.is_onlooker || self.scout_interface.is_some() {
            &["router", "peer"]
        } else {
            &[]
        };
        // Only one of two drones connects to the other: two links that open at once may end up as
        // one-way links. No drone connects to an onlooker.
        let to_peer = if self.is_onlooker { "always" } else { "greater-zid" };
        let strategy = json!({ "peer": { "to_router": "always", "to_peer": to_peer } });
        let mut config = json!({
            "mode": self.mode,
            "listen": {
                "endpoints": if client { &[][..] } else { &self.listen[..] },
                "timeout_ms": -1,
                "exit_on_failure": false,
                "retry": retry,
            },
            "connect": {
                "endpoints": self.connect,
                "timeout_ms": connect_timeout_ms,
                "exit_on_failure": client,
                "retry": retry,
            },
            "scouting": {
                // Time for which opening waits for the first links, even if there are no others,
                // milliseconds.
                "delay": 200,
                "multicast": {
                    "enabled": self.scout_interface.is_some(),
                    "interface": self.scout_interface.as_deref().unwrap_or("lo"),
                    "autoconnect_strategy": strategy,
                },
                // Gossip announces all drones to a session that is linked with one. Zenoh may not
                // restore a link that it made by gossip, so drones use configured links or
                // multicast.
                "gossip": {
                    "autoconnect": { "peer": by_hearsay },
                    "autoconnect_strategy": strategy,
                },
            },
            "transport": {
                "unicast": {
                    "open_timeout": self.open_timeout_ms,
                    "accept_timeout": self.open_timeout_ms,
                },
                "link": {
                    "tx": {
                        "lease": self.lease_ms,
                        // Poses that wait while the radio is blocked are stale when they are sent.
                        // So the queue has one small batch, and the socket a small buffer.
                        "batch_size": 8_192,
                        "queue": {
                            "size": { "real_time": 1 },
                            "congestion_control": { "block": { "wait_before_close": 2_000_000 } },
                        },
                    },
                    // Messages here have at most 85 kilobytes. A larger one must not exhaust the
                    // memory (Zenoh's default is 1 GiB).
                    "rx": { "max_message_size": 131_072 },
                    "tcp": { "so_sndbuf": SEND_BUFFER_BYTES },
                },
                "shared_memory": { "enabled": false },
            },
        });
        if let Some(files) = &self.security {
            config["transport"]["link"]["tls"] = tls_config(files);
            // An onlooker receives other endpoints by gossip, so unencrypted protocols are
            // excluded.
            config["transport"]["link"]["protocols"] = json!(["tls"]);
        }
        if let Some(roster) = roster {
            config["access_control"] = access_rules(roster, self.mode == NetworkMode::Router);
            config["low_pass_filter"] = json!([{
                "id": "size",
                "flows": ["ingress"],
                "messages": ["put", "delete", "query", "reply"],
                "key_exprs": ["**"],
                "size_limit": MOST_MESSAGE_BYTES,
            }]);
        }
        config
    }
}

/// The configuration of a router (`zenohd`) of a swarm. It listens on all interfaces, and refuses
/// links without a certificate of the swarm.
pub fn router_config(files: MemberFiles, roster: &Roster) -> serde_json::Value {
    let router = NetworkParameters {
        mode: NetworkMode::Router,
        listen: vec!["tls/[::]:7447".into()],
        security: Some(files),
        ..NetworkParameters::default()
    };
    router.zenoh_config(Some(roster))
}

/// Size of the socket's send buffer: data that waits there is stale when it is sent.
const SEND_BUFFER_BYTES: usize = 32_768;

/// Maximum length of a report with its signature, bytes.
const MOST_MESSAGE_BYTES: usize = MAX_FRAME_REPORT_BYTES + 4_096;

/// Mutual TLS: each end presents its certificate, the same for incoming and outgoing links.
fn tls_config(files: &MemberFiles) -> serde_json::Value {
    json!({
        "root_ca_certificate": files.ca,
        "enable_mtls": true,
        "listen_private_key": files.key,
        "listen_certificate": files.certificate,
        "connect_private_key": files.key,
        "connect_certificate": files.certificate,
        // Certificates contain drones' names, and endpoints have addresses. The access rules check
        // the name at the other end.
        "verify_name_on_connect": false,
        "close_link_on_expiration": true,
        "so_sndbuf": SEND_BUFFER_BYTES,
    })
}

fn check_name(field: &str, name: &str) -> Result<(), NetworkError> {
    if is_name(name) {
        return Ok(());
    }
    let reason = format!("is no name: 1 to {MAX_NAME_CHARS} letters, digits, '-', '_' or '.'");
    Err(NetworkError::parameter(field, name, reason))
}

fn check_range(field: &str, found: u64, least: u64, most: u64) -> Result<(), NetworkError> {
    if (least..=most).contains(&found) {
        return Ok(());
    }
    Err(NetworkError::parameter(field, &found.to_string(), format!("must be {least} to {most}")))
}

fn check_interface(name: &str) -> Result<(), NetworkError> {
    let is_plain = |byte: u8| byte.is_ascii_alphanumeric() || b"-_.:@".contains(&byte);
    if name == "auto" || name.is_empty() || !name.bytes().all(is_plain) {
        let reason = "must name one interface or its address, such as wlan0 or 10.0.0.7";
        return Err(NetworkError::parameter("scout_interface", name, reason));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    fn refused(change: impl FnOnce(&mut NetworkParameters)) -> String {
        let mut parameters = NetworkParameters::default();
        change(&mut parameters);
        parameters.check().expect_err("refused").to_string()
    }

    #[test]
    fn errors_name_the_field_and_the_cure() {
        NetworkParameters::default().check().unwrap();
        let message = refused(|p| p.observer = "a/b".into());
        assert!(message.starts_with("observer: 'a/b' is no name"), "{message}");
        let message = refused(|p| p.swarm = "*".into());
        assert!(message.starts_with("swarm"), "{message}");
        let message = refused(|p| p.listen.push("tcp/0.0.0.0:7447".into()));
        assert!(message.starts_with("listen[1]") && message.contains("#iface=wlan0"));
        let message = refused(|p| p.listen = vec!["quic/127.0.0.1:1".into()]);
        assert!(message.contains("tcp/ADDRESS:PORT"), "{message}");
        let message = refused(|p| p.listen = vec!["tcp/wlan0:7447".into()]);
        assert!(message.contains("'wlan0:7447'"), "{message}");
        let message = refused(|p| p.connect = vec!["tcp/127.0.0.1:0".into()]);
        assert!(message.starts_with("connect[0]"), "{message}");
        let message = refused(|p| p.connect = vec!["udp/kite.local:7447".into()]);
        assert!(message.contains("names work with tcp and tls only"), "{message}");
        let message = refused(|p| p.mode = NetworkMode::Client);
        assert!(message.contains("connect"), "{message}");
        let message = refused(|p| p.lease_ms = 3);
        assert!(message.contains("500 to 60000"), "{message}");
        let message = refused(|p| p.scout_interface = Some("auto".into()));
        assert!(message.contains("wlan0"), "{message}");
    }

    #[test]
    fn what_flies_is_accepted() {
        let parameters = NetworkParameters {
            listen: vec!["tcp/0.0.0.0:7447#iface=wlan0".into(), "udp/[::1]:7447".into()],
            connect: vec!["tcp/kite.local:7447".into(), "tcp/[fe80::1]:7447".into()],
            scout_interface: Some("wlan0".into()),
            ..Default::default()
        };
        parameters.check().unwrap();
    }

    #[test]
    fn zenoh_understands_its_configuration() {
        for mode in [NetworkMode::Peer, NetworkMode::Client, NetworkMode::Router] {
            let parameters = NetworkParameters {
                mode,
                connect: vec!["tcp/127.0.0.1:7447".into()],
                ..Default::default()
            };
            let config =
                zenoh::Config::from_json5(&parameters.zenoh_config(None).to_string()).unwrap();
            let read = |key| config.get_json(key).unwrap();
            assert_eq!(read("transport/shared_memory/enabled"), "false");
            assert_eq!(read("scouting/multicast/enabled"), "false");
            assert_eq!(read("transport/link/tx/lease"), "3000");
            assert_eq!(read("transport/link/tx/queue/size/real_time"), "1");
            assert_eq!(read("transport/link/tx/queue/size/control"), "2", "the rest stays");
            assert_eq!(
                read("transport/link/tx/queue/congestion_control/drop/wait_before_drop"),
                "1000"
            );
        }
    }
}
