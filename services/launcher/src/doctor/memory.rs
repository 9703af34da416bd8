//! Shared memory, its limits, and services that would remove it.

use flockeye_config::Resolved;
use flockeye_runtime::findings::Finding;
use flockeye_runtime::instance::Instance;
use flockeye_runtime::memory::{Budget, shared_memory_space};
use rustix::process::{Resource, getrlimit, getuid};

use super::Machine;

const TOPIC: &str = "memory";

/// Required limit of open files. The default pipeline's processes had 121 to 174 each, and more
/// workers need more.
const FEWEST_FILES: u64 = 1024;
/// First number of a regular user on Debian.
const FIRST_REGULAR_USER: u32 = 1000;

pub(crate) fn examine(machine: &Machine, resolved: &Resolved) -> Vec<Finding> {
    let mut findings = vec![shared_memory(&Budget::of(resolved))];
    findings.extend(removed_at_logout(machine, getuid().as_raw()));
    findings.extend(files());
    findings.extend(priorities(resolved));
    findings.extend(leftovers());
    findings
}

fn shared_memory(budget: &Budget) -> Finding {
    let (free, total) = match shared_memory_space() {
        Ok(space) => space,
        Err(error) => {
            return Finding::problem(
                TOPIC,
                format!("cannot look at /dev/shm: {error}"),
                "mount -t tmpfs tmpfs /dev/shm",
            );
        }
    };
    let mb = |bytes: u64| bytes as f64 / 1e6;
    match budget.check(free, total) {
        Ok(()) => Finding::fine(
            TOPIC,
            format!(
                "/dev/shm has {:.0} MB free, {:.0} MB are needed",
                mb(free),
                budget.bytes() as f64 / 1e6
            ),
        ),
        Err(error) => Finding::problem(
            TOPIC,
            error.to_string(),
            "mount -o remount,size=1G /dev/shm, for good in /etc/fstab; `flockeye clean`",
        ),
    }
}

/// systemd-logind removes a regular user's shared memory at logout, even under a running pipeline.
fn removed_at_logout(machine: &Machine, user: u32) -> Option<Finding> {
    let has_logind = machine.path("/run/systemd/seats").exists();
    if user < FIRST_REGULAR_USER || !has_logind {
        return None;
    }
    let folder = "/etc/systemd/logind.conf.d";
    let more = machine.names(folder).into_iter().map(|name| format!("{folder}/{name}"));
    let texts = std::iter::once("/etc/systemd/logind.conf".to_owned()).chain(more);
    let set = texts.filter_map(|path| machine.text(&path)).flat_map(|text| {
        let lines: Vec<_> = text
            .lines()
            .filter_map(|line| line.trim().strip_prefix("RemoveIPC="))
            .map(str::to_owned)
            .collect();
        lines
    });
    let is_kept = set.last().is_some_and(|value| matches!(&*value, "no" | "false" | "0" | "off"));
    Some(match is_kept {
        true => Finding::fine(TOPIC, "RemoveIPC=no: shared memory outlives a logout"),
        false => Finding::warning(
            TOPIC,
            "shared memory is removed when this user logs out, under a running pipeline too",
            "run as a system user, as the unit does, or RemoveIPC=no in /etc/systemd/logind.conf",
        ),
    })
}

fn files() -> Option<Finding> {
    let most = getrlimit(Resource::Nofile).current.unwrap_or(u64::MAX);
    (most < FEWEST_FILES).then(|| {
        Finding::warning(
            "limits",
            format!("a process may open {most} files"),
            format!("ulimit -n {FEWEST_FILES}, or LimitNOFILE= of the unit"),
        )
    })
}

/// Whether this user may set the configured priorities.
fn priorities(resolved: &Resolved) -> Vec<Finding> {
    let is_root = getuid().is_root();
    let highest = getrlimit(Resource::Rtprio).current.unwrap_or(u64::MAX);
    // setrlimit(2): the limit is 20 less the lowest nice value.
    let lowest = 20 - getrlimit(Resource::Nice).current.unwrap_or(40).min(40) as i64;
    let mut findings = Vec::new();
    for (stage, process) in resolved.pipeline.stages.iter() {
        let name = stage.name();
        if process.scheduling.is_real_time() && !is_root && highest < u64::from(process.priority) {
            findings.push(Finding::warning(
                "limits",
                format!(
                    "stages.{name}.priority {} is refused: {highest} is allowed",
                    process.priority
                ),
                "LimitRTPRIO= of the unit, or /etc/security/limits.d",
            ));
        }
        if let Some(nice) = process.nice
            && i64::from(nice) < lowest
            && nice < 0
            && !is_root
        {
            findings.push(Finding::warning(
                "limits",
                format!("stages.{name}.nice {nice} is refused: {lowest} is allowed"),
                "LimitNICE= of the unit, or /etc/security/limits.d",
            ));
        }
    }
    findings
}

/// Leftovers of dead runs of this user.
fn leftovers() -> Option<Finding> {
    let dead = Instance::all().into_iter().filter(|instance| !instance.is_running());
    let left: Vec<_> = dead
        .filter(|instance| !instance.shared_memory().is_empty())
        .map(|instance| instance.name().to_owned())
        .collect();
    (!left.is_empty()).then(|| {
        let cure = "flockeye clean";
        Finding::note(TOPIC, format!("dead runs left shared memory: {}", left.join(", ")))
            .with_cure(cure)
    })
}

#[cfg(test)]
mod tests {
    use super::super::fixture::machine;
    use super::*;
    use flockeye_runtime::findings::Gravity;

    #[test]
    fn who_logs_out_loses_his_pipeline_unless_told_otherwise() {
        let seats = ("run/systemd/seats/seat0", "");
        let gravity = |files: &[(&str, &str)], user| {
            let (_folder, machine) = machine(files);
            removed_at_logout(&machine, user).map(|found| found.gravity)
        };
        assert_eq!(gravity(&[seats], 1000), Some(Gravity::Warning));
        assert_eq!(gravity(&[seats], 997), None, "a system user");
        assert_eq!(gravity(&[], 1000), None, "no logind");
        let commented = ("etc/systemd/logind.conf", "[Login]\n#RemoveIPC=no\n");
        assert_eq!(gravity(&[seats, commented], 1000), Some(Gravity::Warning));
        let set = ("etc/systemd/logind.conf.d/flockeye.conf", "[Login]\nRemoveIPC=no\n");
        assert_eq!(gravity(&[seats, commented, set], 1000), Some(Gravity::Fine));
    }
}
