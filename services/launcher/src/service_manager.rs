//! Reports a run to systemd (`Type=notify`, sd_notify(3)).
//!
//! The pipeline is ready when its first frame has passed through all stages. Only ended frames feed
//! the watchdog, so it also notices faults that no heartbeat shows. While an operator has ended a
//! stage, frames may stay away, and the launcher feeds it.

use std::time::{Duration, Instant};

use flockeye_runtime::logs::Throttle;
use libsystemd::daemon::{NotifyState, notify, watchdog_enabled};

/// Minimum time between two status messages.
const STATUS_PERIOD: Duration = Duration::from_secs(1);

#[derive(Debug)]
pub(crate) struct ServiceManager {
    is_ready: bool,
    /// Period of the watchdog messages; `None`: there is no watchdog.
    feeding: Option<Duration>,
    frames_reported: u64,
    last_fed: Option<Instant>,
    last_status: Option<Instant>,
    failures: Throttle,
}

impl ServiceManager {
    /// The service manager that started this process, if there is one and it listens.
    pub(crate) fn of_environment() -> Option<Self> {
        std::env::var_os("NOTIFY_SOCKET")?;
        Some(Self::new(watchdog_enabled(false)))
    }

    fn new(watchdog: Option<Duration>) -> Self {
        Self {
            is_ready: false,
            // Half of the timeout, as sd_watchdog_enabled(3) advises.
            feeding: watchdog.map(|timeout| timeout / 2),
            frames_reported: 0,
            last_fed: None,
            last_status: None,
            failures: Throttle::default(),
        }
    }

    /// Sends the due messages. `frames_ended` counts frames that passed through all stages.
    /// `is_held_up`: an operator ended a stage, so frames may stay away. `status` returns a line
    /// once a second.
    pub(crate) fn report(
        &mut self,
        frames_ended: u64,
        is_held_up: bool,
        now: Instant,
        status: impl FnOnce() -> String,
    ) {
        let states = self.due(frames_ended, is_held_up, now, status);
        self.send(&states);
    }

    pub(crate) fn stopping(&mut self) {
        self.send(&[NotifyState::Stopping]);
    }

    fn due(
        &mut self,
        frames_ended: u64,
        is_held_up: bool,
        now: Instant,
        status: impl FnOnce() -> String,
    ) -> Vec<NotifyState> {
        let mut states = Vec::new();
        if !self.is_ready && frames_ended > 0 {
            self.is_ready = true;
            states.push(NotifyState::Ready);
        }
        let since = |last: Option<Instant>| last.map(|last| now.saturating_duration_since(last));
        let goes_on = frames_ended > self.frames_reported || is_held_up;
        if let Some(feeding) = self.feeding
            && goes_on
            && since(self.last_fed).is_none_or(|since| since >= feeding.min(STATUS_PERIOD))
        {
            self.last_fed = Some(now);
            self.frames_reported = frames_ended;
            states.push(NotifyState::Watchdog);
        }
        if since(self.last_status).is_none_or(|since| since >= STATUS_PERIOD) {
            self.last_status = Some(now);
            states.push(NotifyState::Status(status()));
        }
        states
    }

    fn send(&mut self, states: &[NotifyState]) {
        if states.is_empty() {
            return;
        }
        if let Err(error) = notify(false, states)
            && let Some(more) = self.failures.admit()
        {
            tracing::warn!("systemd was not told how the pipeline does ({more} more): {error}");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_is_ready_with_its_first_frame_and_feeds_the_watchdog_with_each_further_one() {
        let mut manager = ServiceManager::new(Some(Duration::from_secs(8)));
        let start = Instant::now();
        let mut at = |s: f64, frames_ended: u64, is_held_up: bool| {
            let now = start + Duration::from_secs_f64(s);
            let states = manager.due(frames_ended, is_held_up, now, || "a line".to_owned());
            let words: Vec<_> = states.iter().map(NotifyState::to_string).collect();
            words.join(" ")
        };
        assert_eq!(at(0.0, 0, false), "STATUS=a line");
        assert_eq!(at(0.5, 1, false), "READY=1 WATCHDOG=1");
        assert_eq!(at(1.0, 2, false), "STATUS=a line", "it was fed just now");
        assert_eq!(at(2.0, 3, false), "WATCHDOG=1 STATUS=a line");
        // Nothing ends any more: the time that goes by does not feed it.
        assert_eq!(at(60.0, 3, false), "STATUS=a line");
        // Somebody has ended a stage.
        assert_eq!(at(61.0, 3, true), "WATCHDOG=1 STATUS=a line");
    }

    #[test]
    fn without_a_watchdog_none_is_fed() {
        let mut manager = ServiceManager::new(None);
        let states = manager.due(1, false, Instant::now(), String::new);
        assert_eq!(states, [NotifyState::Ready, NotifyState::Status(String::new())]);
    }
}
