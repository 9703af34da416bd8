//! A candidate beside Flockeye's own stage, in a pipeline that flies a recording or a simulated flight.

use std::io::Read;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use flockeye_cli::Configuration;
use flockeye_contract::StageName;
use flockeye_runtime::instance::Instance;
use serde_json::Value;

use super::report::Report;
use crate::control::client::ask;
use crate::control::{Request, SwapRequest, Worker};
use crate::swap::shadow::can_shadow;

const PAGE: &str = "While a stage is swapped";

/// So long the pipeline may take until its first frame.
const START: Duration = Duration::from_secs(30);
/// So long the two are compared at most, seconds.
const WITHIN_S: f64 = 60.0;

/// Flies `source` with Flockeye's own stage, lets the candidate answer in its shadow and then in its place,
/// and notes how they compare.
///
/// # Errors
/// The stage cannot run twice at once, or the pipeline does not start.
pub fn run(
    stage: StageName,
    configuration: &Configuration,
    source: &str,
    program: &[String],
    report: &mut Report,
) -> anyhow::Result<()> {
    ensure!(
        can_shadow(stage),
        "--beside: {} owns a device or a port, so it cannot run beside another. Cure: leave --beside out",
        stage.name()
    );
    let name = format!("t{}b", std::process::id());
    let fixed = [
        format!("source.input={}", Value::from(source)),
        format!("instance={name}"),
        "gateway.enabled=false".to_owned(),
        "flow=latest".to_owned(),
    ];
    let mut pipeline = Pipeline::start(&name, configuration, &fixed)?;
    pipeline.wait_for_frames()?;
    let request = Request::Swap(SwapRequest {
        worker: Worker { stage, replica: 0 },
        set: Vec::new(),
        program: program.to_vec(),
        within_s: WITHIN_S,
        accept_worse: true,
    });
    let outcome = ask(&pipeline.instance, &request, |_| {});
    pipeline.end();
    let wrong = outcome.as_ref().err().map(|error| format!("{error:#}"));
    report.check("takes over from Flockeye's own stage", PAGE, wrong);
    if let Ok((_, compared)) = outcome {
        note(&compared["shadow"], report);
    }
    Ok(())
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

/// A pipeline that flies, with nothing left behind.
struct Pipeline {
    instance: Instance,
    child: Child,
}

impl Pipeline {
    fn start(name: &str, configuration: &Configuration, fixed: &[String]) -> anyhow::Result<Self> {
        let own = std::env::current_exe().context("cannot find the flockeye program")?;
        let child = Command::new(own)
            .arg("up")
            .args(configuration.to_arguments(&[], fixed))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .context("cannot start the pipeline")?;
        Ok(Self { instance: Instance::named(name), child })
    }

    fn wait_for_frames(&mut self) -> anyhow::Result<()> {
        let begun = Instant::now();
        while begun.elapsed() < START {
            if self.child.try_wait().context("the pipeline")?.is_some() {
                let mut reason = String::new();
                let stderr = self.child.stderr.take();
                stderr.map(|mut stderr| stderr.read_to_string(&mut reason)).transpose()?;
                bail!("the pipeline has ended before a frame came: {}", reason.trim());
            }
            let is_flying = self.instance.has_launcher()
                && ask(&self.instance, &Request::Status, |_| {})
                    .is_ok_and(|(_, status)| status["frames"].as_u64() > Some(0));
            if is_flying {
                return Ok(());
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        bail!("no frame came in {} s", START.as_secs())
    }

    /// Asks it to end, and waits for that.
    fn end(&mut self) {
        if let Err(error) = ask(&self.instance, &Request::Stop { worker: None }, |_| {}) {
            tracing::debug!("the pipeline has ended by itself: {error:#}");
        }
    }
}

impl Drop for Pipeline {
    fn drop(&mut self) {
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_secs(5) && matches!(self.child.try_wait(), Ok(None))
        {
            std::thread::sleep(Duration::from_millis(10));
        }
        // Of one that does not end, the stages end with it.
        if matches!(self.child.try_wait(), Ok(None)) {
            drop(self.child.kill());
            drop(self.child.wait());
        }
    }
}
