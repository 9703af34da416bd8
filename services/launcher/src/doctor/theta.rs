//! A Ricoh Theta on the USB.

use std::fs::File;

use flockeye_runtime::findings::Finding;

use super::Machine;

const TOPIC: &str = "camera";
const RICOH: &str = "05ca";

/// Products that stream live video (deploy/udev).
const LIVE: [(&str, &str); 4] =
    [("2711", "Theta S"), ("2712", "Theta V"), ("2715", "Theta Z1"), ("2717", "Theta X")];

const WAKE: &str = "switch it on, press its mode button until LIVE shows (or hold it while switching on), and plug it \
                    in with a data cable; it must not sleep: set its sleep time and power-off time to never";

/// Looks for a Theta, if it is the configured source or one is plugged in.
pub(crate) fn examine(machine: &Machine, source: &str) -> Vec<Finding> {
    let is_wanted = source == "theta" || source.contains("thetauvcsrc");
    let folder = "/sys/bus/usb/devices";
    let ricohs: Vec<_> = machine
        .names(folder)
        .into_iter()
        .filter(|device| {
            machine.text(&format!("{folder}/{device}/idVendor")).as_deref() == Some(RICOH)
        })
        .collect();
    if ricohs.is_empty() {
        let missing = Finding::problem(TOPIC, "no Theta is plugged in, or it sleeps", WAKE);
        return is_wanted.then_some(missing).into_iter().collect();
    }
    ricohs.iter().map(|device| found(machine, &format!("{folder}/{device}"), is_wanted)).collect()
}

fn found(machine: &Machine, device: &str, is_wanted: bool) -> Finding {
    let of = |name: &str| machine.text(&format!("{device}/{name}")).unwrap_or_default();
    let product = of("idProduct");
    let Some((_, name)) = LIVE.iter().find(|(number, _)| *number == product) else {
        let what = format!(
            "'{}' ({RICOH}:{product}) is plugged in as storage, not as a live camera",
            of("product")
        );
        return match is_wanted {
            true => Finding::problem(TOPIC, what, WAKE),
            false => Finding::note(TOPIC, what).with_cure(WAKE),
        };
    };
    let number = |name: &str| of(name).parse::<u32>().unwrap_or(0);
    let node = format!("/dev/bus/usb/{:03}/{:03}", number("busnum"), number("devnum"));
    match File::options().read(true).write(true).open(machine.path(&node)) {
        Ok(_) => Finding::fine(TOPIC, format!("{name} is in live mode ({node})")),
        Err(error) => Finding::problem(
            TOPIC,
            format!("{name} is in live mode, but {node}: {error}"),
            "the udev rules of deploy/udev, the group video, and plug it in again",
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::super::fixture::machine;
    use super::*;
    use flockeye_runtime::findings::Gravity;

    const DEVICE: &str = "sys/bus/usb/devices/1-2";

    fn plugged(product: &str, more: &[(&str, &str)]) -> Vec<Finding> {
        let at = |name: &str| format!("{DEVICE}/{name}");
        let (vendor, number, bus, device) =
            (at("idVendor"), at("idProduct"), at("busnum"), at("devnum"));
        let mut files =
            vec![(&*vendor, "05ca\n"), (&*number, product), (&*bus, "1\n"), (&*device, "7\n")];
        files.extend(more);
        let (_folder, machine) = machine(&files);
        examine(&machine, "theta")
    }

    #[test]
    fn a_theta_is_live_or_storage_or_asleep() {
        let node = ("dev/bus/usb/001/007", "");
        let live = plugged("2712\n", &[node]);
        assert_eq!(live, [Finding::fine(TOPIC, "Theta V is in live mode (/dev/bus/usb/001/007)")]);
        let forbidden = plugged("2712\n", &[]);
        assert_eq!(forbidden[0].gravity, Gravity::Problem);
        assert!(forbidden[0].what.contains("/dev/bus/usb/001/007: No such file"), "{forbidden:?}");
        let storage = plugged("0368\n", &[]);
        assert!(storage[0].what.contains("as storage"), "{storage:?}");
        let (_folder, bare) = machine(&[]);
        assert_eq!(examine(&bare, "theta")[0].gravity, Gravity::Problem);
        assert_eq!(examine(&bare, "sim"), []);
    }
}
