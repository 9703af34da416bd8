//! A process that runs: the launcher's own child, or one that an earlier launcher left flying.

use std::io;
use std::os::fd::OwnedFd;
use std::os::unix::process::ExitStatusExt;
use std::process::{Child, ExitStatus};

use flockeye_runtime::stage::CANNOT_START;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{Pid, PidfdFlags, pidfd_open};

pub(crate) enum RunningProcess {
    /// This launcher started it.
    Own(Child),
    /// Another launcher started it, so only the end can be seen and not its status.
    Adopted {
        pid: u32,
        /// Becomes readable at its end, even if the system has reused the number since.
        pidfd: OwnedFd,
    },
}

/// End of a process.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct End {
    /// The way it ended, in words.
    pub how: String,
    /// Whether its exit status means that another attempt is useless.
    pub is_hopeless: bool,
}

impl RunningProcess {
    /// A living process that another launcher started.
    pub(crate) fn adopt(pid: u32) -> io::Result<Self> {
        let number = Pid::from_raw(pid.cast_signed()).ok_or_else(|| {
            io::Error::new(io::ErrorKind::InvalidInput, "no process has number 0")
        })?;
        Ok(Self::Adopted { pid, pidfd: pidfd_open(number, PidfdFlags::empty())? })
    }

    pub(crate) fn pid(&self) -> u32 {
        match self {
            Self::Own(child) => child.id(),
            Self::Adopted { pid, .. } => *pid,
        }
    }

    /// Its end; `None` while it runs.
    pub(crate) fn end(&mut self) -> io::Result<Option<End>> {
        match self {
            Self::Own(child) => Ok(child.try_wait()?.map(End::of)),
            Self::Adopted { pidfd, .. } => {
                let mut polled = [PollFd::new(pidfd, PollFlags::IN)];
                let has_ended = poll(&mut polled, Some(&Timespec { tv_sec: 0, tv_nsec: 0 }))? > 0;
                let how = "ended (an earlier launcher had started it, so its status is not known)";
                Ok(has_ended.then(|| End { how: how.to_owned(), is_hopeless: false }))
            }
        }
    }
}

impl End {
    fn of(status: ExitStatus) -> Self {
        let how = match (status.code(), status.signal()) {
            (Some(code), _) => format!("ended with status {code}"),
            (None, Some(signal)) => format!("was killed by signal {signal}"),
            (None, None) => "ended".to_owned(),
        };
        Self { how, is_hopeless: status.code() == Some(i32::from(CANNOT_START)) }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use std::process::Command;
    use std::time::{Duration, Instant};

    #[test]
    fn ends_are_told_in_words() {
        assert_eq!(End::of(ExitStatus::from_raw(9)).how, "was killed by signal 9");
        let hopeless = End::of(ExitStatus::from_raw(i32::from(CANNOT_START) << 8));
        assert_eq!((hopeless.how.as_str(), hopeless.is_hopeless), ("ended with status 2", true));
    }

    #[test]
    fn the_end_of_an_adopted_process_is_seen() {
        let mut child = Command::new("sleep").arg("60").spawn().unwrap();
        let mut adopted = RunningProcess::adopt(child.id()).unwrap();
        assert_eq!((adopted.pid(), adopted.end().unwrap()), (child.id(), None));
        child.kill().unwrap();
        let start = Instant::now();
        while adopted.end().unwrap().is_none() {
            assert!(start.elapsed() < Duration::from_secs(20), "its end is not seen");
        }
        child.wait().unwrap();
    }
}
