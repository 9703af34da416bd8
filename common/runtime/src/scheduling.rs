//! The scheduling policy of a thread (sched(7)).

use std::io;

use flockeye_config::Scheduling;

const ALL: [Scheduling; 5] = [
    Scheduling::Normal,
    Scheduling::Batch,
    Scheduling::Idle,
    Scheduling::Fifo,
    Scheduling::RoundRobin,
];

/// The name of a policy on a command line.
pub fn name(policy: Scheduling) -> &'static str {
    match policy {
        Scheduling::Normal => "normal",
        Scheduling::Batch => "batch",
        Scheduling::Idle => "idle",
        Scheduling::Fifo => "fifo",
        Scheduling::RoundRobin => "round-robin",
    }
}

/// The policy of this name on a command line.
///
/// # Errors
/// There is no such policy; the message lists all of them.
pub fn from_name(text: &str) -> Result<Scheduling, String> {
    let found = ALL.into_iter().find(|policy| name(*policy) == text);
    found.ok_or_else(|| format!("'{text}' is none of {}", ALL.map(name).join(", ")))
}

/// The policy of the calling thread. `None` for one that is not listed here.
pub(crate) fn of_this_thread() -> Option<Scheduling> {
    // SAFETY: the call takes a number alone; 0 is the calling thread.
    let found = unsafe { libc::sched_getscheduler(0) } & !libc::SCHED_RESET_ON_FORK;
    ALL.into_iter().find(|policy| code(*policy) == found)
}

/// Sets the policy of the calling thread. `priority` counts in real time only.
///
/// # Errors
/// The system refuses: real time needs CAP_SYS_NICE or a limit (RLIMIT_RTPRIO).
pub fn apply_to_this_thread(policy: Scheduling, priority: u8) -> io::Result<()> {
    let priority = if policy.is_real_time() { priority } else { 0 };
    let parameters = libc::sched_param { sched_priority: priority.into() };
    // SAFETY: `parameters` lives until the call returns, which reads it only; 0 is the calling
    // thread.
    let status = unsafe { libc::sched_setscheduler(0, code(policy), &raw const parameters) };
    if status == 0 { Ok(()) } else { Err(io::Error::last_os_error()) }
}

fn code(policy: Scheduling) -> libc::c_int {
    match policy {
        Scheduling::Normal => libc::SCHED_OTHER,
        Scheduling::Batch => libc::SCHED_BATCH,
        Scheduling::Idle => libc::SCHED_IDLE,
        Scheduling::Fifo => libc::SCHED_FIFO,
        Scheduling::RoundRobin => libc::SCHED_RR,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_thread_gets_the_policy_it_asks_for() {
        // Every thread may go from normal to batch and to idle.
        let policies = [Scheduling::Batch, Scheduling::Idle];
        let found = std::thread::spawn(move || {
            policies.map(|policy| {
                apply_to_this_thread(policy, 50).unwrap();
                of_this_thread()
            })
        });
        assert_eq!(found.join().unwrap(), policies.map(Some));
        assert_ne!(of_this_thread(), Some(Scheduling::Idle), "another thread");
    }

    #[test]
    fn real_time_is_given_or_refused_with_the_reason() {
        let asked = std::thread::spawn(|| {
            let outcome = apply_to_this_thread(Scheduling::Fifo, 1);
            (outcome, of_this_thread())
        });
        match asked.join().unwrap() {
            (Ok(()), policy) => assert_eq!(policy, Some(Scheduling::Fifo)),
            (Err(error), policy) => {
                assert_eq!(error.kind(), io::ErrorKind::PermissionDenied);
                assert!(!policy.unwrap().is_real_time());
            }
        }
    }

    #[test]
    fn names_are_read_as_they_are_written() {
        for policy in ALL {
            assert_eq!(from_name(name(policy)), Ok(policy));
        }
        let error = from_name("real").unwrap_err();
        assert_eq!(error, "'real' is none of normal, batch, idle, fifo, round-robin");
    }
}
