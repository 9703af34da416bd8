//! A text for people on the state of all peers.

use std::time::Instant;

use flockeye_network::Peers;

/// Text with the peers that are alive, their sightings, and refused messages.
pub(crate) fn in_words(peers: &Peers, own_name: &str, left_out: &[String]) -> String {
    let now = Instant::now();
    let others = peers.observers.iter().filter(|(name, _)| *name != own_name);
    let mut parts: Vec<String> = others
        .map(|(name, peer)| {
            let seen: Vec<_> = peer
                .targets
                .iter()
                .map(|(target, received)| match received.rate_hz(now) {
                    Some(rate) => format!("{target} {rate:.0}/s"),
                    None => target.clone(),
                })
                .collect();
            if left_out.contains(name) {
                return format!("{name} contradicts the others and is left out");
            }
            match (peer.alive, seen.is_empty()) {
                (false, _) => format!("{name} is gone"),
                (true, true) => format!("{name} is there"),
                (true, false) => format!("{name} sees {}", seen.join(" ")),
            }
        })
        .collect();
    for (name, peer) in &peers.observers {
        if peer.refused.total() > 0 {
            parts.push(format!("{} refused in the name of {name}", peer.refused.total()));
        }
    }
    if parts.is_empty() {
        parts.push("no peers".into());
    }
    parts.join(", ")
}
