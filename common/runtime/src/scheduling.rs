//! The scheduling policy of a thread (sched(7)).

use std::fmt;
use std::io;
use std::str::FromStr;

/// How the kernel chooses when a thread runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SchedulingPolicy {
    /// Shares of time by nice value.
    Normal,
    /// The usual policy for work without interaction.
    Batch,
    /// Runs when nothing else wants to.
    Idle,
    /// Real time: runs before all others until it waits.
    Fifo,
    /// Real time, by turns with others of the same priority.
    RoundRobin,
}

impl SchedulingPolicy {
    /// All of them.
    pub const ALL: [Self; 5] =
        [Self::Normal, Self::Batch, Self::Idle, Self::Fifo, Self::RoundRobin];

    /// Its name on a command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Normal => "normal",
            Self::Batch => "batch",
            Self::Idle => "idle",
            Self::Fifo => "fifo",
            Self::RoundRobin => "round-robin",
        }
    }

    /// Whether threads of this policy go before all threads that are not in real time.
    pub fn is_real_time(self) -> bool {
        matches!(self, Self::Fifo | Self::RoundRobin)
    }

    /// The policy of the calling thread. `None` for one that is not listed here.
    pub(crate) fn of_this_thread() -> Option<Self> {
        // SAFETY: the call takes a number alone; 0 is the calling thread.
        let code = unsafe { libc::sched_getscheduler(0) } & !libc::SCHED_RESET_ON_FORK;
        Self::ALL.into_iter().find(|policy| policy.code() == code)
    }

    /// Gives the calling thread this policy. `priority` counts in real time only.
    ///
    /// # Errors
    /// The system refuses: real time needs CAP_SYS_NICE or a limit (RLIMIT_RTPRIO).
    pub fn apply_to_this_thread(self, priority: u8) -> io::Result<()> {
        let priority = if self.is_real_time() { priority } else { 0 };
        let parameters = libc::sched_param { sched_priority: priority.into() };
        // SAFETY: `parameters` lives until the call returns, which reads it only; 0 is the calling
        // thread.
        let status = unsafe { libc::sched_setscheduler(0, self.code(), &raw const parameters) };
        if status == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
    }

    fn code(self) -> libc::c_int {
        match self {
            Self::Normal => libc::SCHED_OTHER,
            Self::Batch => libc::SCHED_BATCH,
            Self::Idle => libc::SCHED_IDLE,
            Self::Fifo => libc::SCHED_FIFO,
            Self::RoundRobin => libc::SCHED_RR,
        }
    }
}

impl fmt::Display for SchedulingPolicy {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for SchedulingPolicy {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let names = || Self::ALL.map(Self::name).join(", ");
        let found = Self::ALL.into_iter().find(|policy| policy.name() == text);
        found.ok_or_else(|| format!("'{text}' is none of {}", names()))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_thread_gets_the_policy_it_asks_for() {
        // Every thread may go from normal to batch and to idle.
        let policies = [SchedulingPolicy::Batch, SchedulingPolicy::Idle];
        let found = std::thread::spawn(move || {
            policies.map(|policy| {
                policy.apply_to_this_thread(50).unwrap();
                SchedulingPolicy::of_this_thread()
            })
        });
        assert_eq!(found.join().unwrap(), policies.map(Some));
        assert_ne!(
            SchedulingPolicy::of_this_thread(),
            Some(SchedulingPolicy::Idle),
            "another thread"
        );
    }

    #[test]
    fn real_time_is_given_or_refused_with_the_reason() {
        let asked = std::thread::spawn(|| {
            let outcome = SchedulingPolicy::Fifo.apply_to_this_thread(1);
            (outcome, SchedulingPolicy::of_this_thread())
        });
        match asked.join().unwrap() {
            (Ok(()), policy) => assert_eq!(policy, Some(SchedulingPolicy::Fifo)),
            (Err(error), policy) => {
                assert_eq!(error.kind(), io::ErrorKind::PermissionDenied);
                assert!(!policy.unwrap().is_real_time());
            }
        }
    }

    #[test]
    fn names_are_read_as_they_are_written() {
        for policy in SchedulingPolicy::ALL {
            assert_eq!(policy.to_string().parse(), Ok(policy));
        }
        let error = "real".parse::<SchedulingPolicy>().unwrap_err();
        assert_eq!(error, "'real' is none of normal, batch, idle, fifo, round-robin");
    }
}
