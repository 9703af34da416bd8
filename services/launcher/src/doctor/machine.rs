//! Processors, their clock frequency, and heat.

use flockeye_runtime::findings::Finding;

use super::Machine;

/// Minimum number of processors for 30 frames a second (docs/results/README.md is measured on two).
const FEWEST_PROCESSORS: usize = 2;
/// Temperature not far below the one at which processors throttle themselves, degrees Celsius.
const HOT_C: f64 = 85.0;

pub(crate) fn examine(machine: &Machine) -> Vec<Finding> {
    let mut findings = vec![features(), processors()];
    findings.push(governor(machine));
    findings.extend(heat(machine));
    findings
}

/// The instructions that the kernels for single views are written for.
fn features() -> Finding {
    const TOPIC: &str = "processor";
    #[cfg(target_arch = "x86_64")]
    let missing: Vec<&str> = [
        ("AVX2", std::arch::is_x86_feature_detected!("avx2")),
        ("FMA", std::arch::is_x86_feature_detected!("fma")),
    ]
    .into_iter()
    .filter_map(|(name, is_there)| (!is_there).then_some(name))
    .collect();
    #[cfg(not(target_arch = "x86_64"))]
    let missing = vec!["AVX2", "FMA"];
    match missing.is_empty() {
        true => Finding::fine(TOPIC, "AVX2 and FMA are there"),
        false => Finding::warning(
            TOPIC,
            format!("without {} views are cut and searched slower", missing.join(" and ")),
            "an Intel processor since Haswell, or one of AMD since Excavator",
        ),
    }
}

fn processors() -> Finding {
    let count = std::thread::available_parallelism().map_or(1, usize::from);
    match count >= FEWEST_PROCESSORS {
        true => Finding::fine("processor", format!("{count} processors")),
        false => Finding::warning(
            "processor",
            format!("{count} processor: frames will be skipped"),
            "a machine with two or more; `flockeye check --measure 10s` says what this one does",
        ),
    }
}

fn governor(machine: &Machine) -> Finding {
    const TOPIC: &str = "frequency";
    let folder = "/sys/devices/system/cpu";
    let mut governors: Vec<_> = machine
        .names(folder)
        .into_iter()
        .filter_map(|name| machine.text(&format!("{folder}/{name}/cpufreq/scaling_governor")))
        .collect();
    governors.sort();
    governors.dedup();
    match &governors[..] {
        [] => Finding::note(TOPIC, "this machine does not show its frequency governor"),
        [only] if only == "performance" => Finding::fine(TOPIC, "the governor is performance"),
        others => Finding::warning(
            TOPIC,
            format!(
                "the governor is {}: the clock is raised late when load comes in bursts",
                others.join(" and ")
            ),
            "cpupower frequency-set -g performance (package linux-cpupower), at the battery's expense",
        ),
    }
}

/// Temperatures of this machine's parts, degrees Celsius.
pub(crate) fn temperatures_c(machine: &Machine) -> Vec<(String, f64)> {
    let folder = "/sys/class/thermal";
    let zones = machine.names(folder).into_iter().filter(|name| name.starts_with("thermal_zone"));
    zones
        .filter_map(|zone| {
            let millidegrees: f64 = machine.text(&format!("{folder}/{zone}/temp"))?.parse().ok()?;
            let part = machine.text(&format!("{folder}/{zone}/type")).unwrap_or(zone);
            Some((part, millidegrees * 1e-3))
        })
        .collect()
}

/// Clock frequencies of the processors, Hz.
pub(crate) fn frequencies_hz(machine: &Machine) -> Vec<(String, f64)> {
    let folder = "/sys/devices/system/cpu";
    let cpus = machine.names(folder).into_iter();
    cpus.filter_map(|cpu| {
        let khz: f64 =
            machine.text(&format!("{folder}/{cpu}/cpufreq/scaling_cur_freq"))?.parse().ok()?;
        Some((cpu.trim_start_matches("cpu").to_owned(), khz * 1e3))
    })
    .collect()
}

fn heat(machine: &Machine) -> Option<Finding> {
    let temperatures = temperatures_c(machine).into_iter().map(|(_, c)| c);
    let hottest = temperatures.max_by(f64::total_cmp)?;
    Some(match hottest < HOT_C {
        true => Finding::fine("heat", format!("{hottest:.0} degrees Celsius at most")),
        false => Finding::warning(
            "heat",
            format!("{hottest:.0} degrees Celsius: the processor will slow down"),
            "air on the heat sink; fewer detection workers",
        ),
    })
}

#[cfg(test)]
mod tests {
    use super::super::fixture::machine;
    use super::*;
    use flockeye_runtime::findings::Gravity;

    #[test]
    fn a_slow_clock_and_heat_are_named() {
        let governor_of =
            |n: u32| format!("sys/devices/system/cpu/cpu{n}/cpufreq/scaling_governor");
        let (zero, one) = (governor_of(0), governor_of(1));
        let (_folder, slow) = machine(&[
            (&zero, "powersave\n"),
            (&one, "performance\n"),
            ("sys/class/thermal/thermal_zone0/temp", "41000\n"),
            ("sys/class/thermal/thermal_zone1/temp", "93500\n"),
        ]);
        let found = governor(&slow);
        assert_eq!(found.gravity, Gravity::Warning);
        assert!(found.what.contains("performance and powersave"), "{found:?}");
        assert!(heat(&slow).is_some_and(|heat| heat.what.starts_with("94 degrees")));

        let (_folder, fast) = machine(&[(&zero, "performance"), (&one, "performance")]);
        assert_eq!(governor(&fast).gravity, Gravity::Fine);
        assert_eq!(heat(&fast), None);

        let (_folder, bare) = machine(&[]);
        assert_eq!(governor(&bare).gravity, Gravity::Note);
    }

    #[test]
    fn temperatures_and_clocks_have_names() {
        let (_folder, nuc) = machine(&[
            ("sys/class/thermal/thermal_zone0/temp", "41000\n"),
            ("sys/class/thermal/thermal_zone0/type", "x86_pkg_temp\n"),
            ("sys/class/thermal/cooling_device0/type", "Processor\n"),
            ("sys/devices/system/cpu/cpu3/cpufreq/scaling_cur_freq", "2800000\n"),
        ]);
        assert_eq!(temperatures_c(&nuc), [("x86_pkg_temp".to_owned(), 41.0)]);
        assert_eq!(frequencies_hz(&nuc), [("3".to_owned(), 2.8e9)]);
    }
}
