//! `flockeye chaos`: disturbs a running pipeline at random, and reports how it recovers.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`disturbance`] | disturbances of processes |
//! | [`report`] | effects on the pipeline |

mod disturbance;
mod report;

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use clap::Args;
use flockeye_cli::running::{PipelineChoice, attach};
use flockeye_cli::{Screen, duration, signals};
use flockeye_contract::{Tracks, Truths};
use flockeye_runtime::clock;
use flockeye_runtime::instance::Instance;
use flockeye_runtime::ports::{Ports, Subscriber};

use self::disturbance::{Disturbance, DisturbanceKind};
use self::report::ChaosReport;
use crate::dice::Dice;
use flockeye_launcher::control::client::ask;
use flockeye_launcher::control::{ControlRequest, SwapRequest, WorkerName};

/// Arguments of `chaos`.
#[derive(Debug, Args)]
pub(crate) struct ChaosArguments {
    /// Which pipeline.
    #[command(flatten)]
    pub running: PipelineChoice,
    /// For how long: 20s, 5m, 1h.
    #[arg(long = "for", value_name = "DURATION", value_parser = duration, default_value = "60s")]
    pub duration: Duration,
    /// End after so many disturbances.
    #[arg(long, value_name = "COUNT")]
    pub count: Option<usize>,
    /// What is done to whom follows from this number.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Disturbances in a second at most. Each waits until the pipeline has recovered from the one
    /// before.
    #[arg(long, default_value_t = 1.0, value_parser = rate)]
    pub rate: f64,
    /// Only these kinds of disturbances.
    #[arg(long, value_delimiter = ',', value_name = "KIND")]
    pub only: Vec<DisturbanceKind>,
    /// Only these workers.
    #[arg(long, value_delimiter = ',', value_name = "STAGE[.REPLICA]")]
    pub workers: Vec<WorkerName>,
    /// JSON.
    #[arg(long)]
    pub json: bool,
}

/// Timeout of a recovery: the next pose must come within this time.
const RECOVERY_TIME: Duration = Duration::from_secs(15);
/// Time at the beginning and at the end in which poses must flow.
const SETTLING_TIME: Duration = Duration::from_secs(5);

fn rate(text: &str) -> Result<f64, String> {
    let rate = text.parse().map_err(|_| format!("'{text}' is not a number"))?;
    if (0.01..=20.0).contains(&rate) { Ok(rate) } else { Err("0.01 to 20".to_owned()) }
}

/// Receives the pipeline's messages while it is disturbed.
struct ChaosWatch {
    // Fields are dropped in this order: the subscribers before their ports.
    tracks: Subscriber<Tracks>,
    truths: Subscriber<Truths>,
    ports: Ports,
    report: ChaosReport,
}

/// Disturbs a pipeline and reports how it recovers.
///
/// # Errors
/// The pipeline does not run, ends meanwhile, has no pose at the beginning, or breaks a limit of
/// the report.
pub(crate) fn run(arguments: &ChaosArguments) -> anyhow::Result<()> {
    let stopping = signals::stop_flag()?;
    let (instance, _, mut ports) = attach(&arguments.running)?;
    let mut screen = Screen::new();
    let report = ChaosReport::default();
    // During a swap both processes of a stage send messages.
    ports.follow_hand_overs()?;
    let (tracks, truths) = (ports.subscriber()?, ports.subscriber()?);
    let mut watch = ChaosWatch { tracks, truths, ports, report };
    watch.for_(SETTLING_TIME, &stopping)?;
    ensure!(
        watch.report.has_poses(),
        "no neighbour is measured, so nothing can be said of recovery. Cure: begin when poses flow"
    );
    watch.report.begin(&instance);
    let mut dice = Dice::new(arguments.seed);
    let end = Instant::now() + arguments.duration;
    let mut done = 0;
    while Instant::now() < end
        && !stopping.load(Ordering::Relaxed)
        && arguments.count.is_none_or(|count| done < count)
    {
        let began = Instant::now();
        let victims = victims(&instance, arguments)?;
        let Some(disturbance) = dice.throw(&victims, &arguments.only) else {
            watch.for_(Duration::from_millis(100), &stopping)?;
            continue;
        };
        watch.disturb(&instance, &disturbance, &stopping)?;
        done += 1;
        if !arguments.json {
            screen.line(&watch.report.last_line());
        }
        let period = Duration::from_secs_f64(1.0 / arguments.rate);
        watch.for_(period.saturating_sub(began.elapsed()), &stopping)?;
    }
    watch.for_(SETTLING_TIME, &stopping)?;
    let report = &mut watch.report;
    report.end(&instance);
    screen.line(&if arguments.json { serde_json::to_string(&report)? } else { report.to_string() });
    let broken = report.broken_limits();
    ensure!(broken.is_empty(), "{}", broken.join("; "));
    Ok(())
}

/// The running workers that may be disturbed, each with its process number.
fn victims(
    instance: &Instance,
    arguments: &ChaosArguments,
) -> anyhow::Result<Vec<(WorkerName, i32)>> {
    let (_, status) = ask(instance, &ControlRequest::Status, |_| {})?;
    let workers = status["workers"].as_array().context("the launcher's answer has no workers")?;
    let victims = workers.iter().filter_map(|worker| {
        let state = worker["state"].as_str()?;
        let pid = i32::try_from(worker["pid"].as_u64()?).ok()?;
        let worker: WorkerName = worker["worker"].as_str()?.parse().ok()?;
        let is_meant = arguments.workers.is_empty() || arguments.workers.contains(&worker);
        let runs = matches!(state, "ready" | "degraded");
        (is_meant && runs).then_some((worker, pid))
    });
    Ok(victims.collect())
}

impl ChaosWatch {
    /// Receives messages for this time.
    fn for_(&mut self, time: Duration, stopping: &AtomicBool) -> anyhow::Result<()> {
        let end = Instant::now() + time;
        self.until(stopping, |_| Instant::now() >= end)
    }

    /// Receives messages until `is_enough`.
    fn until(
        &mut self,
        stopping: &AtomicBool,
        is_enough: impl Fn(&ChaosReport) -> bool,
    ) -> anyhow::Result<()> {
        let Self { tracks, truths, ports, report } = self;
        ports.attend(|| {
            while let Some(message) = truths.receive()? {
                report.truth(&message.header, message.items());
            }
            while let Some(message) = tracks.receive()? {
                report.tracks(&message.header, message.items(), clock::monotonic_ns());
            }
            let is_over = is_enough(report) || stopping.load(Ordering::Relaxed);
            Ok((!is_over).then_some(Duration::from_millis(5)))
        })
    }

    /// Disturbs the pipeline, and waits until a neighbour is measured in a frame that was exposed
    /// later.
    fn disturb(
        &mut self,
        instance: &Instance,
        disturbance: &Disturbance,
        stopping: &AtomicBool,
    ) -> anyhow::Result<()> {
        let worker = disturbance.worker;
        let failure = match disturbance.kind {
            DisturbanceKind::Swap => {
                let request = SwapRequest {
                    worker,
                    set: Vec::new(),
                    program: Vec::new(),
                    within_s: 20.0,
                    accept_worse: false,
                };
                self.report.strike(disturbance, clock::monotonic_ns());
                // Messages are received meanwhile, otherwise they would count as lost.
                let instance = instance.clone();
                let asking = std::thread::spawn(move || {
                    ask(&instance, &ControlRequest::Swap(request), |_| {})
                });
                while !asking.is_finished() {
                    self.for_(Duration::from_millis(5), stopping)?;
                }
                let answer = asking.join().unwrap_or_else(|_| bail!("the swap was not asked for"));
                answer.err().map(|error| error.to_string())
            }
            _ => {
                self.report.strike(disturbance, clock::monotonic_ns());
                let result = disturbance.strike(|pause| self.for_(pause, stopping));
                result.err().map(|error| error.to_string())
            }
        };
        if let Some(failure) = failure {
            self.report.note_failure(failure);
        }
        let end = Instant::now() + RECOVERY_TIME;
        self.until(stopping, |report| report.has_recovered() || Instant::now() >= end)
    }
}
