//! How to reach the swarm, and the check of these parameters.

use flockeye_contract::wire::{MAX_FRAME_REPORT_BYTES, MAX_NAME_CHARS, is_name};
use flockeye_identity::{Member, MemberFiles, Roster};
use flockeye_runtime::clock::utc_s;
use serde::Serialize;
use serde_json::json;

use crate::access::access_rules;
use crate::endpoint::{check_connect, check_each, check_listen, check_protocol};
use crate::error::NetworkError;

/// What this session is to the others.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum NetworkMode {
    /// Talks to every other peer directly. Drones are peers.
    #[default]
    Peer,
    /// Talks to one router (or peer) only, that of the first `connect` endpoint that answers.
    Client,
    /// Passes messages on between others.
    Router,
}

/// How to reach the swarm. By default nothing leaves the machine: name the radio's address in
/// `listen`, and a neighbour in `connect` or set `scout_interface`.
#[derive(Debug, Clone, PartialEq)]
pub struct NetworkParameters {
    /// Name of the swarm; drones of other swarms are not heard. Letters, digits, `-`, `_`, `.`.
    pub swarm: String,
    /// Name of this drone, unique in the swarm.
    pub observer: String,
    /// What this session is to the others.
    pub mode: NetworkMode,
    /// Where to accept links: `tcp/ADDRESS:PORT` or `udp/ADDRESS:PORT`, port 0 for any, one
    /// interface each: its own address, or `tcp/0.0.0.0:PORT#iface=NAME`. Not used by a client.
    pub listen: Vec<String>,
    /// Endpoints to connect to: `tcp/HOST:PORT` or `udp/ADDRESS:PORT`. One that does not answer is
    /// tried again in the background. One of two peers connects to the other.
    pub connect: Vec<String>,
    /// The interface, by name or address, on which peers are looked for by UDP multicast
    /// (224.0.0.224:7446); none: they are not.
    pub scout_interface: Option<String>,
    /// Whether this session only looks on, and is no drone of the swarm: what the drones say of
    /// `observer`'s clock is then not said of this machine's.
    pub is_onlooker: bool,
    /// The files by which members of the swarm know each other; none: anybody who can link can say
    /// anything.
    pub security: Option<MemberFiles>,
    /// How long a link may take to open, milliseconds: several round trips, of which each may be
    /// lost and sent again after a second (docs/results/constants.md#links-over-a-bad-radio).
    pub open_timeout_ms: u64,
    /// How long a silent neighbour counts as connected, milliseconds.
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
    /// Refuses what cannot work, also keys and certificates.
    ///
    /// # Errors
    /// [`NetworkError::Parameter`], [`NetworkError::Identity`] or [`NetworkError::Another`] names
    /// the field or the file, and the cure.
    pub fn check(&self) -> Result<(), NetworkError> {
        self.check_values()?;
        self.member().map(drop)
    }

    /// Who this session is to the others; none where anybody can say anything.
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
        // An onlooker says nothing, so it may look on in any member's name.
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

    /// The parameters as Zenoh's configuration, in JSON, where those on `roster` alone may speak.
    /// Zenoh's `DEFAULT_CONFIG.json5` explains each key.
    pub(crate) fn zenoh_config(&self, roster: Option<&Roster>) -> serde_json::Value {
        let client = self.mode == NetworkMode::Client;
        // No limit for peers, which connect in the background. A client fails without a router; we
        // retry ourselves, so that it can be cancelled.
        let connect_timeout_ms = if client { self.open_timeout_ms as i64 } else { -1 };
        let retry = json!({
            "period_init_ms": 500, "period_max_ms": 2_000, "period_increase_factor": 1.5,
        });
        let by_hearsay: &[&str] = if self.is_onlooker || self.scout_interface.is_some() {
            &["router", "peer"]
        } else {
            &[]
        };
        // When two drones find each other one of them connects: links that both open at once may
        // come to carry one way only. Nobody connects to an onlooker.
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
                // How long opening waits for the first links, whether or not anybody is there.
                "delay": 200,
                "multicast": {
                    "enabled": self.scout_interface.is_some(),
                    "interface": self.scout_interface.as_deref().unwrap_or("lo"),
                    "autoconnect_strategy": strategy,
                },
                // Whoever is linked with one drone is told of the others. Zenoh may not make a link
                // again that it made by hearsay, so drones have the links that are configured, or
                // find each other anew.
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
                        // Poses that wait while the radio is stuck are stale when they are sent: so
                        // one small batch in the queue, and a small socket buffer.
                        "batch_size": 8_192,
                        "queue": {
                            "size": { "real_time": 1 },
                            "congestion_control": { "block": { "wait_before_close": 2_000_000 } },
                        },
                    },
                    // No message here has more than 85 kilobytes; a larger one must not take
                    // our memory (Zenoh's default is 1 GiB).
                    "rx": { "max_message_size": 131_072 },
                    "tcp": { "so_sndbuf": SEND_BUFFER_BYTES },
                },
                "shared_memory": { "enabled": false },
            },
        });
        if let Some(files) = &self.security {
            config["transport"]["link"]["tls"] = tls_config(files);
            // An onlooker is told of others' endpoints, by whom it is linked with.
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

/// The configuration of a router (`zenohd`) of a swarm: it listens on all interfaces, and whoever
/// has no certificate of the swarm gets no link.
pub fn router_config(files: MemberFiles, roster: &Roster) -> serde_json::Value {
    let router = NetworkParameters {
        mode: NetworkMode::Router,
        listen: vec!["tls/[::]:7447".into()],
        security: Some(files),
        ..NetworkParameters::default()
    };
    router.zenoh_config(Some(roster))
}

/// What waits here is stale when it is sent.
const SEND_BUFFER_BYTES: usize = 32_768;

/// A longer message is no report with its signature.
const MOST_MESSAGE_BYTES: usize = MAX_FRAME_REPORT_BYTES + 4_096;

/// Mutual TLS: each end shows its certificate, and the same one whether it connects or is connected
/// to.
fn tls_config(files: &MemberFiles) -> serde_json::Value {
    json!({
        "root_ca_certificate": files.ca,
        "enable_mtls": true,
        "listen_private_key": files.key,
        "listen_certificate": files.certificate,
        "connect_private_key": files.key,
        "connect_certificate": files.certificate,
        // Certificates have drones' names, and links have addresses. Who is at the other end is
        // what the access rules ask.
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
