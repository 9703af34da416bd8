//! `flockeye top`: where a running pipeline's time goes, and how old its poses are.

use std::io::Write;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use clap::Args;
use flockeye_cli::running::{PipelineChoice, attach};
use flockeye_cli::{Screen, duration, signals};
use flockeye_contract::{Healths, Tracks, Truths};
use flockeye_runtime::clock;

use crate::dashboard::Dashboard;
use crate::sweep_watch::SweepWatch;

/// Arguments of `top`.
#[derive(Debug, Args)]
pub(crate) struct TopArguments {
    /// Which pipeline.
    #[command(flatten)]
    pub running: PipelineChoice,
    /// Watch for two seconds, print once, and end.
    #[arg(long)]
    pub once: bool,
    /// JSON: one object per line each second, or a single one with --once.
    #[arg(long)]
    pub json: bool,
    /// Stop after this long: 20s, 5m, 1h.
    #[arg(long = "for", value_name = "DURATION", value_parser = duration)]
    pub duration: Option<Duration>,
}

/// Time after which rates average several reports. Health arrives four times a second.
const ONCE_AFTER: Duration = Duration::from_secs(2);
/// Periods of the table, and of a line or an object.
const LIVE_PERIOD: Duration = Duration::from_millis(250);
const PRINT_PERIOD: Duration = Duration::from_secs(1);

/// Shows the dashboard until Ctrl-C, or until the pipeline ends.
pub(crate) fn run(arguments: &TopArguments) -> anyhow::Result<()> {
    let stopping = signals::stop_flag()?;
    let (instance, resolved, mut ports) = attach(&arguments.running)?;
    let mut healths = ports.subscriber::<Healths>()?;
    let mut tracks = ports.subscriber::<Tracks>()?;
    let mut truths = ports.subscriber::<Truths>()?;
    let mut sweep = SweepWatch::open(&resolved, &mut ports)?;
    let mut dashboard = Dashboard::default();
    let mut screen = Screen::new();
    let start = Instant::now();
    let period = if screen.is_live() && !arguments.json { LIVE_PERIOD } else { PRINT_PERIOD };
    let mut next = start + if arguments.once { ONCE_AFTER } else { period };
    ports.attend(|| {
        while let Some(message) = healths.receive()? {
            dashboard.health(&message.header);
        }
        while let Some(message) = truths.receive()? {
            dashboard.truth(&message.header, message.items());
        }
        while let Some(message) = tracks.receive()? {
            let is_last = message.header.is_last != 0;
            let now_ns = clock::monotonic_ns();
            dashboard.tracks(&message.header.stamp, message.items(), is_last, now_ns);
        }
        if let Some(sweep) = &mut sweep {
            sweep.receive()?;
            dashboard.sphere = sweep.report();
        }
        let is_over = stopping.load(Ordering::Relaxed)
            || arguments.duration.is_some_and(|duration| start.elapsed() >= duration);
        if is_over {
            return Ok(None);
        }
        let now = Instant::now();
        if now >= next {
            next = now + period;
            if !instance.is_running() {
                screen.line(&format!("the pipeline '{}' has ended", instance.name()));
                return Ok(None);
            }
            let now_ns = clock::monotonic_ns();
            let is_read = match arguments.json {
                true => print(&serde_json::to_string(&dashboard.report(now_ns))?),
                false if screen.is_live() && !arguments.once => {
                    screen.table(&dashboard.table(now_ns));
                    true
                }
                false => print(&dashboard.table(now_ns)),
            };
            if arguments.once || !is_read {
                return Ok(None);
            }
        }
        Ok(Some(next.saturating_duration_since(now).min(Duration::from_millis(100))))
    })
}

/// Prints a line. Returns false if the pipe is closed.
fn print(text: &str) -> bool {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{text}").and_then(|()| out.flush()).is_ok()
}
