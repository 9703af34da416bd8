//! Hang detection: distinguishes a hung process from one that has not had the processor.

/// State of a process from `/proc/PID/stat` (proc(5)).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ProcessStat {
    /// R running, S sleeping, D waiting for a disk, T stopped, t traced, Z dead.
    pub state: char,
    /// Processor time used by the process, nanoseconds.
    pub used_ns: i64,
}

impl ProcessStat {
    /// Reads the state of a process. `None` if it has ended.
    pub(crate) fn of(pid: u32) -> Option<Self> {
        Self::parse(&std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?)
    }

    fn parse(text: &str) -> Option<Self> {
        // The program's name may contain any character, including blanks and parentheses.
        let (_, rest) = text.rsplit_once(')')?;
        let mut fields = rest.split_whitespace();
        let state = fields.next()?.chars().next()?;
        let user: i64 = fields.nth(10)?.parse().ok()?;
        let system: i64 = fields.next()?.parse().ok()?;
        let ticks = i64::try_from(rustix::param::clock_ticks_per_second()).ok()?;
        Some(Self { state, used_ns: (user + system).checked_mul(1_000_000_000)? / ticks.max(1) })
    }
}

/// Hang detector of one process.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Heartbeat {
    /// Time of the newest report, and the processor time used until it was noticed.
    last: Option<(i64, i64)>,
}

impl Heartbeat {
    /// Whether a process hangs at `now_ns`, given its newest report of `sent_ns`.
    ///
    /// A process hangs if it sent nothing for `heartbeat_ns` although nothing kept it from its
    /// work. It is stopped, or it sleeps while no thread works, or it used that much processor time
    /// meanwhile. A process that waits for the processor or a disk is only slow.
    pub(crate) fn hangs(
        &mut self,
        sent_ns: i64,
        now_ns: i64,
        heartbeat_ns: i64,
        stat: ProcessStat,
    ) -> bool {
        let used_then = match self.last {
            Some((of, used_ns)) if of == sent_ns => used_ns,
            _ => {
                self.last = Some((sent_ns, stat.used_ns));
                stat.used_ns
            }
        };
        let is_silent = now_ns - sent_ns > heartbeat_ns;
        let worked_ns = stat.used_ns - used_then;
        let hangs = match stat.state {
            'T' | 't' => true,
            'S' => worked_ns >= heartbeat_ns || worked_ns * 10 < heartbeat_ns,
            _ => worked_ns >= heartbeat_ns,
        };
        is_silent && hangs
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    const S: i64 = 1_000_000_000;

    fn stat(state: char, used_ns: i64) -> ProcessStat {
        ProcessStat { state, used_ns }
    }

    #[test]
    fn the_system_tells_of_this_process() {
        let own = ProcessStat::of(std::process::id()).unwrap();
        assert!(matches!(own.state, 'R' | 'S'), "{own:?}");
        let odd = "7 (a) b (c) S 1 2 3 4 5 6 7 8 9 10 250 50 0 0";
        let ticks = rustix::param::clock_ticks_per_second() as i64;
        assert_eq!(ProcessStat::parse(odd), Some(stat('S', 300 * S / ticks)));
        assert_eq!(ProcessStat::parse("nonsense"), None);
    }

    #[test]
    fn who_is_stopped_or_spins_hangs_and_who_waits_for_the_processor_does_not() {
        for (state, used_ns, wanted) in [
            ('T', 0, true),
            ('S', 0, true),
            ('S', S / 2, false),
            ('R', 2 * S, true),
            ('R', S / 10, false),
            ('D', 0, false),
        ] {
            let mut heartbeat = Heartbeat::default();
            assert!(!heartbeat.hangs(0, S / 2, S, stat('R', 0)));
            assert_eq!(heartbeat.hangs(0, 2 * S, S, stat(state, used_ns)), wanted, "{state}");
        }
    }

    #[test]
    fn each_report_begins_anew() {
        let mut heartbeat = Heartbeat::default();
        assert!(!heartbeat.hangs(0, S / 2, S, stat('R', 0)));
        assert!(!heartbeat.hangs(2 * S, 5 * S / 2, S, stat('R', 2 * S)));
        assert!(!heartbeat.hangs(2 * S, 7 * S / 2, S, stat('R', 5 * S / 2)));
        assert!(heartbeat.hangs(2 * S, 4 * S, S, stat('R', 3 * S)));
    }
}
