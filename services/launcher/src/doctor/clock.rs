//! Clock synchronisation: poses are stamped in UTC, and reports to peers state whether the stamps
//! can be trusted.

use flockeye_network::utc_from_monotonic;
use flockeye_runtime::clock::monotonic_ns;
use flockeye_runtime::findings::Finding;

use super::Machine;

const TOPIC: &str = "clock";

/// Programs that synchronise clocks, by the names of their processes (15 characters at most,
/// proc(5)).
const SYNCHRONISERS: [(&str, &str); 5] = [
    ("systemd-timesyn", "systemd-timesyncd"),
    ("chronyd", "chrony"),
    ("ntpd", "ntpd"),
    ("ptp4l", "linuxptp"),
    ("phc2sys", "linuxptp"),
];

pub(crate) fn examine(machine: &Machine) -> Vec<Finding> {
    let (_, is_synchronised) = utc_from_monotonic(monotonic_ns());
    vec![finding(is_synchronised, &synchronisers(machine))]
}

fn finding(is_synchronised: bool, running: &[&str]) -> Finding {
    let names = running.join(" and ");
    match (is_synchronised, running) {
        (true, []) => Finding::fine(TOPIC, "it is synchronised"),
        (true, _) => Finding::fine(TOPIC, format!("it is synchronised, by {names}")),
        (false, []) => Finding::warning(
            TOPIC,
            "nothing synchronises it: peers are told not to trust the times of poses",
            "install systemd-timesyncd or chrony; docs/PEERS.md says how good it must be",
        ),
        (false, ["systemd-timesyncd"]) => Finding::warning(
            TOPIC,
            "systemd-timesyncd runs and has not reached a server",
            "timedatectl timesync-status; name one that this drone reaches in /etc/systemd/timesyncd.conf",
        ),
        (false, _) => Finding::warning(
            TOPIC,
            format!(
                "{names} runs, but there is no /run/systemd/timesync/synchronized, so peers are told not to trust it"
            ),
            "have its unit create that file: docs/PEERS.md",
        ),
    }
}

/// The synchronisers that run.
fn synchronisers(machine: &Machine) -> Vec<&'static str> {
    let processes = machine.names("/proc");
    let names: Vec<_> = processes
        .iter()
        .filter(|name| name.bytes().all(|byte| byte.is_ascii_digit()))
        .filter_map(|process| machine.text(&format!("/proc/{process}/comm")))
        .collect();
    let mut running: Vec<_> = SYNCHRONISERS
        .into_iter()
        .filter(|(process, _)| names.iter().any(|name| name == process))
        .map(|(_, name)| name)
        .collect();
    running.dedup();
    running
}

#[cfg(test)]
mod tests {
    use super::super::fixture::machine;
    use super::*;

    #[test]
    fn what_synchronises_is_named() {
        let (_folder, ptp) = machine(&[
            ("proc/17/comm", "ptp4l\n"),
            ("proc/18/comm", "phc2sys\n"),
            ("proc/self/comm", "chronyd\n"),
        ]);
        assert_eq!(synchronisers(&ptp), ["linuxptp"]);
        assert!(finding(false, &["linuxptp"]).what.contains("peers are told not to trust it"));
        assert!(finding(false, &[]).what.contains("nothing synchronises it"));
        assert_eq!(finding(true, &["chrony"]).what, "it is synchronised, by chrony");
    }
}
