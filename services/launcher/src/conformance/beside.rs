//! A candidate beside Flockeye's own stage, in a pipeline that flies a recording or a simulated flight.

use std::collections::VecDeque;
use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
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
/// Lines of the pipeline that are kept.
const MOST_LINES: usize = 15;

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
    if outcome.is_err() && pipeline.has_ended() {
        bail!(
            "{source} ended before both were compared. Cure: a longer recording. Its pipeline said:\n{}",
            pipeline.last_lines()
        );
    }
    pipeline.end();
    let wrong = outcome.as_ref().err().map(|error| format!("{error:#}\n{}", pipeline.last_lines()));
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
    /// What it and its stages have written last.
    lines: Arc<Mutex<VecDeque<String>>>,
}

impl Pipeline {
    fn start(name: &str, configuration: &Configuration, fixed: &[String]) -> anyhow::Result<Self> {
        let own = std::env::current_exe().context("cannot find the flockeye program")?;
        let mut child = Command::new(own)
            .arg("up")
            .args(configuration.to_arguments(&[], fixed))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .context("cannot start the pipeline")?;
        let lines = Arc::default();
        child.stdout.take().into_iter().for_each(|stream| collect(stream, &lines));
        child.stderr.take().into_iter().for_each(|stream| collect(stream, &lines));
        Ok(Self { instance: Instance::named(name), child, lines })
    }

    fn wait_for_frames(&mut self) -> anyhow::Result<()> {
        let begun = Instant::now();
        while begun.elapsed() < START {
            if self.has_ended() {
                bail!("the pipeline has ended before a frame came:\n{}", self.last_lines());
            }
            let is_flying = self.instance.has_launcher()
                && ask(&self.instance, &Request::Status, |_| {})
                    .is_ok_and(|(_, status)| status["frames"].as_u64() > Some(0));
            if is_flying {
                return Ok(());
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        bail!("no frame came in {} s:\n{}", START.as_secs(), self.last_lines())
    }

    fn has_ended(&mut self) -> bool {
        !matches!(self.child.try_wait(), Ok(None))
    }

    fn last_lines(&self) -> String {
        let lines = self.lines.lock().unwrap_or_else(PoisonError::into_inner);
        lines.iter().cloned().collect::<Vec<_>>().join("\n")
    }

    /// Asks it to end, and waits for that.
    fn end(&mut self) {
        if let Err(error) = ask(&self.instance, &Request::Stop { worker: None }, |_| {}) {
            tracing::debug!("the pipeline has ended by itself: {error:#}");
        }
    }
}

/// Keeps the last lines of a stream, from a thread that ends with it.
fn collect(stream: impl Read + Send + 'static, lines: &Arc<Mutex<VecDeque<String>>>) {
    let lines = lines.clone();
    std::thread::spawn(move || {
        for line in BufReader::new(stream).lines().map_while(Result::ok) {
            let mut lines = lines.lock().unwrap_or_else(PoisonError::into_inner);
            lines.push_back(line);
            if lines.len() > MOST_LINES {
                lines.pop_front();
            }
        }
    });
}

impl Drop for Pipeline {
    fn drop(&mut self) {
        let begun = Instant::now();
        while begun.elapsed() < Duration::from_secs(5) && !self.has_ended() {
            std::thread::sleep(Duration::from_millis(10));
        }
        // Of one that does not end, the stages end with it.
        if !self.has_ended() {
            drop(self.child.kill());
            drop(self.child.wait());
        }
    }
}
