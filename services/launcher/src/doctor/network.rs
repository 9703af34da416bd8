//! The gateway's addresses and interface, and the keys of a swarm.

use std::net::{IpAddr, TcpListener};

use flockeye_config::Pipeline;
use flockeye_identity::Member;
use flockeye_network::NetworkParameters;
use flockeye_runtime::clock::utc_s;
use flockeye_runtime::findings::{Finding, Gravity};

use super::Machine;

const TOPIC: &str = "network";
const KEYS: &str = "keys";
/// Minimum remaining validity of a certificate, days. A shorter one should be renewed before the
/// next campaign.
const SOON_DAYS: i64 = 7;
const DAY_S: i64 = 86_400;

pub(crate) fn examine(machine: &Machine, pipeline: &Pipeline) -> Vec<Finding> {
    let gateway = &pipeline.gateway;
    if !gateway.enabled {
        return vec![Finding::note(
            TOPIC,
            "nothing goes over the network (gateway.enabled: false)",
        )];
    }
    let parameters = NetworkParameters::of_drone(pipeline);
    let mut findings = keys(&parameters);
    let have_keys = findings.iter().all(|finding| finding.gravity != Gravity::Problem);
    // The check also reads the keys: their faults are reported once.
    if have_keys && let Err(error) = parameters.check() {
        let cure = "gateway in the configuration";
        findings.push(Finding::problem(TOPIC, error.to_string(), cure));
    }
    findings.extend(gateway.listen.iter().filter_map(|endpoint| address(endpoint)));
    if gateway.listen.is_empty() {
        findings.push(
            Finding::note(
                TOPIC,
                "no address to listen on: other drones cannot connect to this one",
            )
            .with_cure("gateway.listen"),
        );
    }
    findings.extend(gateway.scout_interface.as_deref().and_then(|name| interface(machine, name)));
    findings
}

/// Whether this machine has the address of an endpoint.
fn address(endpoint: &str) -> Option<Finding> {
    let (_, rest) = endpoint.split_once('/')?;
    let host = rest.split('#').next()?.rsplit_once(':')?.0;
    let ip: IpAddr = host.trim_matches(['[', ']']).parse().ok()?;
    Some(match TcpListener::bind((ip, 0)) {
        Ok(_) => Finding::fine(TOPIC, format!("{endpoint} can be listened on")),
        Err(error) => Finding::problem(
            TOPIC,
            format!("gateway.listen {endpoint}: {error}"),
            "an address of this machine (ip address shows them), once its interface is up",
        ),
    })
}

/// `IFF_UP` and `IFF_MULTICAST` of netdevice(7).
const UP: u32 = 0x1;
const MULTICAST: u32 = 0x1000;

/// Whether peers can be scouted on an interface. One that is given as an address is not examined.
fn interface(machine: &Machine, name: &str) -> Option<Finding> {
    if name.parse::<IpAddr>().is_ok() {
        return None;
    }
    let flags = machine.text(&format!("/sys/class/net/{name}/flags"));
    let flags = flags.and_then(|text| u32::from_str_radix(text.trim_start_matches("0x"), 16).ok());
    Some(match flags {
        None => Finding::problem(
            TOPIC,
            format!("gateway.scout_interface: there is no {name}"),
            format!("one of {}", machine.names("/sys/class/net").join(", ")),
        ),
        Some(flags) if flags & UP == 0 => {
            Finding::problem(TOPIC, format!("{name} is down"), format!("ip link set {name} up"))
        }
        Some(flags) if flags & MULTICAST == 0 => Finding::problem(
            TOPIC,
            format!("{name} has no multicast, by which peers are looked for"),
            format!("ip link set {name} multicast on, or gateway.connect in place of it"),
        ),
        Some(_) => Finding::fine(TOPIC, format!("{name} is up, with multicast")),
    })
}

fn keys(parameters: &NetworkParameters) -> Vec<Finding> {
    let Some(files) = &parameters.security else {
        return vec![
            Finding::note(KEYS, "none: whoever can link can speak in every drone's name")
                .with_cure("flockeye keys (docs/SECURITY.md)"),
        ];
    };
    let now_s = utc_s();
    let member = match Member::load(files, now_s) {
        Ok(member) => member,
        Err(error) => {
            let cure = "flockeye keys issue, and copy its files again (docs/SECURITY.md)";
            return vec![Finding::problem(KEYS, error.to_string(), cure)];
        }
    };
    let ends = [("certificate", &member.certificate), ("authority", &member.authority)];
    ends.map(|(what, certificate)| {
        ending(what, (certificate.not_after_s - now_s).div_euclid(DAY_S))
    })
    .into()
}

fn ending(what: &str, days: i64) -> Finding {
    match days > SOON_DAYS {
        true => Finding::fine(KEYS, format!("the {what} holds for {days} days")),
        false => Finding::warning(
            KEYS,
            format!("the {what} ends in {days} days"),
            "flockeye keys issue renews certificates, a new authority needs new ones for all",
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::super::fixture::machine;
    use super::*;

    #[test]
    fn addresses_of_others_cannot_be_listened_on() {
        let gravity = |endpoint: &str| address(endpoint).map(|found| found.gravity);
        assert_eq!(gravity("tcp/127.0.0.1:7447"), Some(Gravity::Fine));
        assert_eq!(gravity("tls/[::]:7447#iface=wlan0"), Some(Gravity::Fine));
        // TEST-NET-1 (RFC 5737) is nobody's.
        assert_eq!(gravity("tcp/192.0.2.7:7447"), Some(Gravity::Problem));
        assert_eq!(gravity("tcp/drone.local:7447"), None, "names are the resolver's");
    }

    #[test]
    fn an_interface_is_up_with_multicast_or_named() {
        let (_folder, machine) = machine(&[
            ("sys/class/net/wlan0/flags", "0x1003\n"),
            ("sys/class/net/eth0/flags", "0x1002\n"),
            ("sys/class/net/wg0/flags", "0x91\n"),
        ]);
        let what = |name: &str| interface(&machine, name).map_or(String::new(), |found| found.what);
        assert_eq!(what("wlan0"), "wlan0 is up, with multicast");
        assert_eq!(what("eth0"), "eth0 is down");
        assert_eq!(what("wg0"), "wg0 has no multicast, by which peers are looked for");
        let missing = interface(&machine, "wlan1");
        let cure = missing.and_then(|found| found.cure);
        assert_eq!(cure.as_deref(), Some("one of eth0, wg0, wlan0"));
        assert_eq!(what("10.0.0.7"), "");
    }

    #[test]
    fn a_certificate_that_ends_soon_is_named() {
        assert_eq!(ending("certificate", 30).gravity, Gravity::Fine);
        assert_eq!(ending("certificate", 6).gravity, Gravity::Warning);
    }
}
