//! Recorder of a pipeline that records every flight (`recording` in pipeline.yaml). It only
//! subscribes, so nothing waits for it once it has begun.

use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::SyncSender;
use std::time::{Duration, Instant, SystemTime};

use anyhow::Context;
use flockeye_cli::{dated, program};
use flockeye_config::{RecordedFrames, Recording, RecordingTrigger};
use flockeye_runtime::backoff::Backoff;
use flockeye_runtime::instance::Instance;
use flockeye_runtime::recorders;
use rustix::process::{Pid, Signal, kill_process};

use crate::process::{LineSink, LogLine};

/// Timeout for writing the remaining messages and the index.
const STOP_TIME: Duration = Duration::from_secs(10);
/// Size at which another file begins. `flockeye record --split` takes another size.
const SPLIT: &str = "1000MB";
/// First and longest wait before the next start.
const BACKOFF: [Duration; 2] = [Duration::from_millis(100), Duration::from_secs(10)];

pub(crate) struct Recorder {
    /// Program and arguments before the file's name.
    program: Vec<String>,
    folder: std::path::PathBuf,
    instance: Instance,
    lines: LineSink,
    child: Option<Child>,
    backoff: Backoff,
    retry_at: Option<Instant>,
    started: Instant,
    /// Whether it has ended because it cannot record.
    has_given_up: bool,
}

impl Recorder {
    /// The configured recorder, if there is one. It does not run yet.
    pub(crate) fn of(
        recording: &Recording,
        instance: &Instance,
        log: SyncSender<LogLine>,
    ) -> anyhow::Result<Option<Self>> {
        let Some(folder) = &recording.folder else { return Ok(None) };
        std::fs::create_dir_all(folder)
            .with_context(|| format!("recording.folder: cannot make {}", folder.display()))?;
        let path = program::find("flockeye-recorder").context("recording.folder is set")?;
        Ok(Some(Self {
            program: [vec![path.to_string_lossy().into_owned()], arguments(recording)].concat(),
            folder: folder.clone(),
            instance: instance.clone(),
            lines: LineSink::new("recorder".to_owned(), log),
            child: None,
            backoff: Backoff::new(BACKOFF[0], BACKOFF[1]),
            retry_at: None,
            started: Instant::now(),
            has_given_up: false,
        }))
    }

    /// Starts it with a new file.
    pub(crate) fn start(&mut self) -> anyhow::Result<()> {
        let file = new_file(&self.folder, self.instance.name());
        // This program, and not the file at its path: an update may have replaced that.
        let mut command = Command::new("/proc/self/exe");
        command
            .args(["exec-stage", "--parent", &std::process::id().to_string(), "--"])
            .args(&self.program)
            .args(["--instance", self.instance.name(), "--"])
            .arg(&file)
            .stdin(Stdio::null())
            // The launcher handles Ctrl-C in the terminal: the recorder ends last.
            .process_group(0)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        let mut child = command.spawn().context("cannot start the recorder")?;
        self.lines.forward_outputs(&mut child);
        (self.child, self.retry_at, self.started) = (Some(child), None, Instant::now());
        Ok(())
    }

    /// Whether it has joined, so that it misses nothing, or never will.
    pub(crate) fn has_joined(&self) -> bool {
        let Some(child) = &self.child else { return self.has_given_up };
        recorders::has_joined(&self.instance, child.id())
    }

    /// Starts it again if it has ended, after `clean` has freed its ports. Returns a line to be
    /// shown.
    pub(crate) fn attend(&mut self, clean: impl FnOnce()) -> Option<String> {
        if self.retry_at.is_some_and(|at| Instant::now() >= at) {
            clean();
            return match self.start() {
                Ok(()) => Some("the recorder is started again".to_owned()),
                Err(error) => {
                    self.retry_at = Some(Instant::now() + self.backoff.after_failure());
                    Some(format!("{error:#}"))
                }
            };
        }
        let status = self.child.as_mut()?.try_wait().ok()??;
        self.child = None;
        // This status means that another attempt is useless.
        if status.code() == Some(2) {
            self.has_given_up = true;
            let what = "the recorder cannot record, and is not started again; its reason is above";
            return Some(what.to_owned());
        }
        if self.started.elapsed() > BACKOFF[1] {
            self.backoff.reset();
        }
        let wait = self.backoff.after_failure();
        self.retry_at = Some(Instant::now() + wait);
        let wait_s = wait.as_secs_f64();
        Some(format!("the recorder has ended ({status}); it is started again in {wait_s:.1} s"))
    }

    /// Ends it after it has written all messages. Returns a line to be shown.
    pub(crate) fn stop(&mut self) -> Option<String> {
        self.retry_at = None;
        let mut child = self.child.take()?;
        // An ended process needs no signal.
        kill_process(Pid::from_child(&child), Signal::TERM).ok();
        let deadline = Instant::now() + STOP_TIME;
        while Instant::now() < deadline {
            if !matches!(child.try_wait(), Ok(None)) {
                // Its last lines may not have arrived yet.
                std::thread::sleep(Duration::from_millis(20));
                return None;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        // It has ended, or this user may not end it.
        child.kill().ok();
        child.wait().ok();
        let cure = "Cure: `flockeye record --recover`, and a faster disk";
        Some(format!("the recorder did not end and was killed; its file has no index. {cure}"))
    }
}

/// Arguments of `flockeye record` for a configuration.
fn arguments(recording: &Recording) -> Vec<String> {
    let mut arguments = vec!["--frames".to_owned()];
    arguments.push(match recording.frames {
        RecordedFrames::None => "none".to_owned(),
        RecordedFrames::Views => "views".to_owned(),
        RecordedFrames::Camera => "camera".to_owned(),
        RecordedFrames::Every => format!("every {}", recording.every),
    });
    match recording.trigger {
        None => arguments.extend(["--split".to_owned(), SPLIT.to_owned()]),
        Some(trigger) => {
            let trigger = match trigger {
                RecordingTrigger::Lost => "lost",
                RecordingTrigger::Request => "request",
            };
            arguments.extend(["--trigger".to_owned(), trigger.to_owned()]);
            let past_ms = (recording.past_s * 1e3) as u64;
            arguments.extend(["--past".to_owned(), format!("{past_ms}ms")]);
        }
    }
    arguments
}

/// A new file name: `INSTANCE-20260102T030405Z.mcap`.
fn new_file(folder: &Path, instance: &str) -> std::path::PathBuf {
    let names = dated::names(instance, SystemTime::now());
    let mut paths = names.map(|name| folder.join(format!("{name}.mcap")));
    // The numbers never end.
    paths.find(|path| !path.exists()).unwrap_or_else(|| folder.join("flight.mcap"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_configuration_becomes_arguments() {
        let recording =
            Recording { frames: RecordedFrames::Every, every: 7, ..Recording::default() };
        assert_eq!(arguments(&recording), ["--frames", "every 7", "--split", "1000MB"]);
        let recording = Recording {
            trigger: Some(RecordingTrigger::Lost),
            past_s: 2.5,
            ..Recording::default()
        };
        assert_eq!(
            arguments(&recording),
            ["--frames", "none", "--trigger", "lost", "--past", "2500ms"]
        );
    }
}
