//! A candidate beside Flockeye's own stage, in a pipeline that flies a recording or a simulated flight.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail, ensure};
use flockeye_cli::{Configuration, Screen};
use flockeye_contract::StageName;
use flockeye_runtime::instance::Instance;
use serde_json::Value;

use super::report::Report;
use crate::control::client::ask;
use crate::control::{Request, SwapRequest, Worker};
use crate::run_log::RunOptions;
use crate::swap::shadow::can_shadow;
use crate::up::run_pipeline;

const PAGE: &str = "While a stage is swapped";

/// So long the pipeline may take until its first frame.
const START: Duration = Duration::from_secs(30);
/// So long the two are compared at most, seconds.
const WITHIN_S: f64 = 60.0;
const TAKES_OVER: &str = "takes over from Flockeye's own stage";

/// Refuses a stage that cannot run twice at once.
///
/// # Errors
/// It owns a device or a port.
pub fn check(stage: StageName) -> anyhow::Result<()> {
    ensure!(
        can_shadow(stage),
        "--beside: {} owns a device or a port, so it cannot run beside another. Cure: leave --beside out",
        stage.name()
    );
    Ok(())
}

/// Flies `source` with Flockeye's own stage, lets the candidate answer in its shadow and then in its place,
/// and notes how they compare.
///
/// # Errors
/// The pipeline does not start, or ends before both were compared.
pub fn run(
    stage: StageName,
    configuration: &Configuration,
    source: &str,
    program: &[String],
    report: &mut Report,
) -> anyhow::Result<()> {
    let name = format!("t{}b", std::process::id());
    let fixed = [
        format!("source.input={}", Value::from(source)),
        format!("instance={name}"),
        "gateway.enabled=false".to_owned(),
        "recording.folder=null".to_owned(),
        "flow=latest".to_owned(),
        // A short recording goes on until both have found something.
        "source.at_end=loop".to_owned(),
    ];
    let pipeline = configuration.load_with(&[], &fixed)?;
    let request = Request::Swap(SwapRequest {
        worker: Worker { stage, replica: 0 },
        set: Vec::new(),
        program: program.to_vec(),
        within_s: WITHIN_S,
        accept_worse: true,
    });
    let stopping = AtomicBool::new(false);
    let (compared, run, log) = std::thread::scope(|scope| {
        let flight = scope.spawn(|| {
            let mut log = Screen::muted();
            let run = run_pipeline(&pipeline, &RunOptions::default(), &mut log, &stopping);
            (run, log.kept())
        });
        let compared = compare(&Instance::named(&name), &request, || flight.is_finished());
        stopping.store(true, Ordering::Relaxed);
        let (run, log) =
            flight.join().unwrap_or_else(|_| (Err(anyhow!("it panicked")), String::new()));
        (compared, run, log)
    });
    run.map(drop).with_context(|| format!("{log}the pipeline that flies {source}"))?;
    match compared.with_context(|| format!("{log}{source}"))? {
        Compared::Swapped(report_of_swap) => {
            report.check(TAKES_OVER, PAGE, None);
            note(&report_of_swap["shadow"], report);
        }
        Compared::Refused(reason) => {
            report.check(TAKES_OVER, PAGE, Some(format!("{reason}\n{log}")));
        }
    }
    Ok(())
}

/// What came of the swap.
enum Compared {
    Swapped(Value),
    Refused(String),
}

/// Waits for frames, and lets the candidate take over.
fn compare(
    instance: &Instance,
    request: &Request,
    has_ended: impl Fn() -> bool,
) -> anyhow::Result<Compared> {
    let begun = Instant::now();
    let flies = || {
        instance.has_launcher()
            && ask(instance, &Request::Status, |_| {})
                .is_ok_and(|(_, status)| status["frames"].as_u64() > Some(0))
    };
    while !flies() {
        ensure!(!has_ended(), "it ended before a frame came");
        ensure!(begun.elapsed() < START, "no frame came in {} s", START.as_secs());
        std::thread::sleep(Duration::from_millis(50));
    }
    match ask(instance, request, |_| {}) {
        Ok((_, report)) => Ok(Compared::Swapped(report)),
        Err(_) if has_ended() => {
            bail!("it ended before both were compared. Cure: a longer flight")
        }
        Err(error) => Ok(Compared::Refused(format!("{error:#}"))),
    }
}

/// The comparison in the shadow, as figures.
fn note(compared: &Value, report: &mut Report) {
    let figure = |name: &str| compared[name].as_f64().unwrap_or(f64::NAN);
    let share = |new: &str, old: &str| 100.0 * figure(new) / figure(old);
    report.figure("beside Flockeye's own: frames compared", figure("frames"), "");
    report.figure("its answers", share("new_answers", "old_answers"), "% of Flockeye's own");
    report.figure("what it finds", share("new_found", "old_found"), "% of Flockeye's own");
    report.figure("how far apart, median", 1e3 * figure("difference"), "mm, or mrad");
    report.figure("its time for an answer, median", figure("new_ms"), "ms");
    report.figure("Flockeye's own", figure("old_ms"), "ms");
}
