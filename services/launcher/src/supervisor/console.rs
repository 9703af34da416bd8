//! Display of a run: its lines, the live table, and its state for systemd.

use std::sync::mpsc::Receiver;
use std::time::{Duration, Instant};

use flockeye_cli::Screen;
use flockeye_runtime::clock;

use crate::dashboard::Dashboard;
use crate::process::LogLine;
use crate::service_manager::ServiceManager;

/// Periods of the live table, and of the printed line where there is no terminal.
const TABLE_PERIOD: Duration = Duration::from_millis(200);
const LINE_PERIOD: Duration = Duration::from_secs(1);

/// Shows a run to the user and to systemd.
pub(super) struct Console<'a> {
    screen: &'a mut Screen,
    /// Log lines of the processes.
    log: Receiver<LogLine>,
    started: Instant,
    next_show: Instant,
    service_manager: Option<ServiceManager>,
}

impl<'a> Console<'a> {
    /// Shows on `screen` a run that starts now and whose processes write to `log`.
    pub(super) fn new(screen: &'a mut Screen, log: Receiver<LogLine>) -> Self {
        let now = Instant::now();
        let service_manager = ServiceManager::of_environment();
        Self { screen, log, started: now, next_show: now, service_manager }
    }

    pub(super) fn line(&mut self, text: &str) {
        self.screen.line(text);
    }

    /// Shows the lines that processes have written.
    pub(super) fn show_log(&mut self) {
        while let Ok(LogLine { stage, text }) = self.log.try_recv() {
            self.screen.stage_line(self.started.elapsed().as_secs_f64(), &stage, &text);
        }
    }

    /// Shows the dashboard, once in each period.
    pub(super) fn show(&mut self, dashboard: &Dashboard) {
        if Instant::now() < self.next_show {
            return;
        }
        let now_ns = clock::monotonic_ns();
        if self.screen.is_live() {
            self.screen.table(&dashboard.table(now_ns));
            self.next_show = Instant::now() + TABLE_PERIOD;
        } else {
            // Under systemd the newest line is the unit's status, and the journal need not keep all
            // lines.
            if self.service_manager.is_none() && dashboard.frames_ended > 0 {
                self.screen.line(&dashboard.line(now_ns));
            }
            self.next_show = Instant::now() + LINE_PERIOD;
        }
    }

    /// Reports to systemd. `is_held_up`: an operator has ended a stage.
    pub(super) fn report_progress(&mut self, dashboard: &Dashboard, is_held_up: bool) {
        let Some(manager) = &mut self.service_manager else { return };
        let status = || dashboard.line(clock::monotonic_ns());
        manager.report(dashboard.frames_ended, is_held_up, Instant::now(), status);
    }

    /// Reports to systemd that the run ends.
    pub(super) fn report_stop(&mut self) {
        self.service_manager.iter_mut().for_each(ServiceManager::stopping);
    }
}
