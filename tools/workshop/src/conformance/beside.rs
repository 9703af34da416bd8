//! Test of a candidate beside Flockeye's own stage, in a pipeline with a recording or a simulated
//! flight.

use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use flockeye_cli::Configuration;
use flockeye_config::Profile;
use flockeye_contract::StageName;
use flockeye_runtime::instance::Instance;
use serde_json::Value;

use super::report::ConformanceReport;
use crate::fleet::Fleet;
use flockeye_launcher::can_shadow;
use flockeye_launcher::control::client::ask;
use flockeye_launcher::control::{ControlRequest, SwapRequest, WorkerName};

const PAGE: &str = "While a stage is swapped";

/// Timeout for the first frame of the pipeline.
const START: Duration = Duration::from_secs(30);
/// Longest time for which the two are compared, seconds.
const WITHIN_S: f64 = 60.0;
const TAKES_OVER: &str = "takes over from Flockeye's own stage";

/// Refuses a stage that cannot run in two processes at once.
///
/// # Errors
/// The stage owns a device or a port.
pub(crate) fn check(stage: StageName) -> anyhow::Result<()> {
    ensure!(
        can_shadow(stage),
        "--beside: {} owns a device or a port, so it cannot run beside another. Cure: leave --beside out",
        stage.name()
    );
    Ok(())
}

/// Runs `source` with Flockeye's own stage. The candidate answers first in its shadow and then in
/// its place. Notes the comparison.
///
/// # Errors
/// The pipeline does not start, or ends before both were compared.
pub(crate) fn run(
    stage: StageName,
    configuration: &Configuration,
    source: &str,
    program: &[String],
    report: &mut ConformanceReport,
) -> anyhow::Result<()> {
    let name = format!("t{}b", std::process::id());
    let fixed = [
        format!("source.input={}", Value::from(source)),
        format!("instance={name}"),
        "gateway.enabled=false".to_owned(),
        "recording.folder=null".to_owned(),
        // A short recording repeats until both have found something.
        "source.at_end=loop".to_owned(),
    ];
    // Configuration errors are reported before any process starts.
    let configuration = configuration.clone().in_profile(Profile::Flight);
    configuration.load_with(&[], &fixed)?;
    let request = ControlRequest::Swap(SwapRequest {
        worker: WorkerName { stage, replica: 0 },
        set: Vec::new(),
        program: program.to_vec(),
        within_s: WITHIN_S,
        accept_worse: true,
    });
    let instance = Instance::named(&name);
    let mut fleet = Fleet::start(&[(name, configuration.to_arguments(&[], &fixed))])?;
    let compared = compare(&mut fleet, &instance, &request)
        .with_context(|| format!("the pipeline that flies {source}"))?;
    let log = fleet.last_lines();
    fleet.end();
    match compared {
        Ok(report_of_swap) => {
            report.check(TAKES_OVER, PAGE, None);
            note(&report_of_swap["shadow"], report);
        }
        Err(reason) => {
            report.check(TAKES_OVER, PAGE, Some(format!("{reason}\n{log}\n")));
        }
    }
    Ok(())
}

/// Waits for frames, and swaps the candidate in. Returns the report of the swap, or the reason of a
/// refusal.
fn compare(
    fleet: &mut Fleet,
    instance: &Instance,
    request: &ControlRequest,
) -> anyhow::Result<Result<Value, String>> {
    let begun = Instant::now();
    let flies = || {
        instance.has_launcher()
            && ask(instance, &ControlRequest::Status, |_| {})
                .is_ok_and(|(_, status)| status["frames"].as_u64() > Some(0))
    };
    while !flies() {
        fleet.check().context("it ended before a frame came")?;
        ensure!(
            begun.elapsed() < START,
            "no frame came in {} s:\n{}",
            START.as_secs(),
            fleet.last_lines()
        );
        std::thread::sleep(Duration::from_millis(50));
    }
    match ask(instance, request, |_| {}) {
        Ok((_, report)) => Ok(Ok(report)),
        Err(reason) => {
            fleet.check().context("it ended before both were compared. Cure: a longer flight")?;
            Ok(Err(format!("{reason:#}")))
        }
    }
}

/// Notes the comparison in the shadow as figures.
fn note(compared: &Value, report: &mut ConformanceReport) {
    let figure = |name: &str| compared[name].as_f64().unwrap_or(f64::NAN);
    let share = |new: &str, old: &str| 100.0 * figure(new) / figure(old);
    report.figure("beside Flockeye's own: frames compared", figure("frames"), "");
    report.figure("its answers", share("new_answers", "old_answers"), "% of Flockeye's own");
    report.figure("what it finds", share("new_found", "old_found"), "% of Flockeye's own");
    report.figure("how far apart, median", 1e3 * figure("difference"), "mm, or mrad");
    report.figure("its time for an answer, median", figure("new_ms"), "ms");
    report.figure("Flockeye's own", figure("old_ms"), "ms");
}
