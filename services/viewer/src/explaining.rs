//! The explanation of a pose, or of a missing one: `flockeye explain` on request of a page.
//!
//! A separate process computes the answer from the recording that is shown, or from the one that is
//! being written. It replays the flight up to the frame, so only one answer is computed at a time.

use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Mutex, TryLockError};
use std::thread;
use std::time::{Duration, Instant};

use flockeye_cli::program;
use flockeye_contract::wire::is_name;
use flockeye_runtime::instance::Instance;
use flockeye_runtime::recorders;

const PROGRAM: &str = "flockeye-replay";
/// Timeout of an answer. A long flight is replayed faster than it was flown.
const PATIENCE: Duration = Duration::from_secs(300);
/// Time after which a recorder has written all that it has received.
const UNTIL_WRITTEN: Duration = Duration::from_millis(1500);
/// Period of the check whether the answer is ready.
const LOOK_PERIOD: Duration = Duration::from_millis(20);

/// A page's question: why does this frame have this pose of a neighbour, or none?
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct PoseQuestion {
    /// The name of the neighbour's body.
    target: String,
    /// The frame's key ([`crate::wire::key`]).
    frame: String,
}

impl PoseQuestion {
    /// Reads `target=NAME&frame=KEY`. `None`: the query is not such a question.
    pub(crate) fn of_query(query: &str) -> Option<Self> {
        let value = |name: &str| {
            let mut pairs = query.split('&').filter_map(|pair| pair.split_once('='));
            pairs.find(|(key, _)| *key == name).map(|(_, value)| value.to_owned())
        };
        let (target, frame) = (value("target")?, value("frame")?);
        let is_key = frame.len() <= 64
            && frame.split('.').count() == 3
            && frame.split('.').all(|part| part.parse::<u64>().is_ok());
        (is_name(&target) && is_key).then_some(Self { target, frame })
    }
}

#[derive(Debug, thiserror::Error)]
pub(crate) enum NoExplanation {
    #[error("another question is being answered. Cure: ask again when it is done")]
    Busy,
    #[error(
        "this flight is not recorded, and an answer is worked out from a recording. Cure: recording.folder in \
         pipeline.yaml, with recording.frames: views"
    )]
    NotRecorded,
    #[error("`flockeye explain` cannot be run: {0}")]
    Run(String),
    #[error("{0}")]
    Refused(String),
    #[error("no answer came within {} s. Cure: `flockeye explain` in a terminal takes as long as it needs", PATIENCE.as_secs())]
    TooSlow,
}

impl From<io::Error> for NoExplanation {
    fn from(error: io::Error) -> Self {
        Self::Run(error.to_string())
    }
}

/// The recording from which answers are computed.
#[derive(Debug)]
enum AnswerSource {
    /// The recording that is shown.
    File(PathBuf),
    /// The recording that is being written of this running pipeline.
    Pipeline(Instance),
}

#[derive(Debug)]
pub(crate) struct Explainer {
    source: AnswerSource,
    turn: Mutex<()>,
}

impl Explainer {
    pub(crate) fn of_recording(path: &Path) -> Self {
        Self { source: AnswerSource::File(path.to_owned()), turn: Mutex::new(()) }
    }

    pub(crate) fn of_pipeline(instance: Instance) -> Self {
        Self { source: AnswerSource::Pipeline(instance), turn: Mutex::new(()) }
    }

    /// Answers with a text for people, and a PNG of the neighbour in the frame. The PNG is empty
    /// where there is nothing to draw. It takes as long as the replay of the flight.
    pub(crate) fn answer(
        &self,
        question: &PoseQuestion,
    ) -> Result<(String, Vec<u8>), NoExplanation> {
        let _turn = match self.turn.try_lock() {
            Ok(turn) => turn,
            Err(TryLockError::WouldBlock) => return Err(NoExplanation::Busy),
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
        };
        let program =
            program::find(PROGRAM).map_err(|error| NoExplanation::Run(format!("{error:#}")))?;
        match &self.source {
            AnswerSource::File(path) => run(&program, path, question),
            AnswerSource::Pipeline(instance) => {
                let recording = recorders::recording(instance).ok_or(NoExplanation::NotRecorded)?;
                match run(&program, &recording, question) {
                    // The frame may be too new to be in the file yet.
                    Err(NoExplanation::Refused(_)) => {
                        thread::sleep(UNTIL_WRITTEN);
                        run(&program, &recording, question)
                    }
                    other => other,
                }
            }
        }
    }
}

fn run(
    program: &Path,
    recording: &Path,
    question: &PoseQuestion,
) -> Result<(String, Vec<u8>), NoExplanation> {
    let image = tempfile::Builder::new().prefix("flockeye-").suffix(".png").tempfile()?;
    let mut command = Command::new(program);
    command.arg("explain").arg(recording);
    // A name may begin with '-', like an option.
    command.arg(format!("--target={}", question.target));
    command.args(["--frame", &question.frame, "--image"]).arg(image.path());
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn()?;
    // Each pipe is read by its own thread, because a full pipe would block the program.
    let (told, complaint) = (reader(child.stdout.take()), reader(child.stderr.take()));
    let has_ended = wait(&mut child)?;
    let (text, complaint) = (read(told), read(complaint));
    match has_ended {
        false => Err(NoExplanation::TooSlow),
        true if text.is_empty() => Err(NoExplanation::Refused(last_line(&complaint).to_owned())),
        // The file stays empty where there is nothing to draw.
        true => Ok((text, std::fs::read(image.path())?)),
    }
}

/// Waits until the program ends, or kills it after the timeout. Returns whether it ended by itself.
fn wait(child: &mut Child) -> io::Result<bool> {
    let start = Instant::now();
    loop {
        if child.try_wait()?.is_some() {
            return Ok(true);
        }
        if start.elapsed() > PATIENCE {
            child.kill()?;
            child.wait()?;
            return Ok(false);
        }
        thread::sleep(LOOK_PERIOD);
    }
}

fn reader(pipe: Option<impl Read + Send + 'static>) -> Option<thread::JoinHandle<String>> {
    let mut pipe = pipe?;
    Some(thread::spawn(move || {
        let mut text = Vec::new();
        // Text before a failure counts.
        let _ = pipe.read_to_end(&mut text);
        String::from_utf8_lossy(&text).into_owned()
    }))
}

fn read(reader: Option<thread::JoinHandle<String>>) -> String {
    reader.and_then(|reader| reader.join().ok()).unwrap_or_default()
}

/// The last line of the program's error output: its log may come before the error.
fn last_line(complaint: &str) -> &str {
    complaint.trim().lines().last().unwrap_or("the program gave no answer and no reason")
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_question_names_a_body_and_a_frame() {
        let question =
            PoseQuestion::of_query("token=open-sesame&target=alpha-2&frame=1.0.38").unwrap();
        assert_eq!((question.target.as_str(), question.frame.as_str()), ("alpha-2", "1.0.38"));
        for query in [
            "",
            "target=alpha",
            "frame=1.0.38",
            "target=alpha&frame=38",
            "target=alpha&frame=1.0.x",
            "target=alpha&frame=1.0.38.1",
            "target=alpha&frame=-1.0.38",
            "target=../etc&frame=1.0.38",
            "target=a%20b&frame=1.0.38",
            "target=&frame=1.0.38",
        ] {
            assert_eq!(PoseQuestion::of_query(query), None, "{query}");
        }
    }

    #[test]
    fn what_the_program_says_comes_back() {
        let question = PoseQuestion::of_query("target=alpha&frame=1.0.38").unwrap();
        let script = |text: &str| {
            let mut file = tempfile::Builder::new().suffix(".sh").tempfile().unwrap();
            io::Write::write_all(&mut file, text.as_bytes()).unwrap();
            let path = file.into_temp_path();
            let mode = std::os::unix::fs::PermissionsExt::from_mode(0o700);
            std::fs::set_permissions(&path, mode).unwrap();
            path
        };
        let ask = |program: &Path| run(program, Path::new("/nowhere/a.mcap"), &question);
        let draws = script("#!/bin/sh\necho \"$@\"\necho drawn > \"$7\"\n");
        let (text, png) = ask(&draws).unwrap();
        let wanted = "explain /nowhere/a.mcap --target=alpha --frame 1.0.38 --image ";
        assert!(text.starts_with(wanted), "{text}");
        assert_eq!(png, b"drawn\n");
        let refuses = script("#!/bin/sh\necho log >&2\necho 'it has no such frame' >&2\nexit 1\n");
        let refused = ask(&refuses).unwrap_err();
        assert_eq!(refused.to_string(), "it has no such frame");
        let (text, png) = ask(&script("#!/bin/sh\necho told\nexit 1\n")).unwrap();
        assert_eq!((text.as_str(), png.len()), ("told\n", 0));
        assert!(matches!(ask(Path::new("/nowhere/program")), Err(NoExplanation::Run(_))));
    }

    #[test]
    fn one_question_is_answered_at_a_time() {
        let explainer = Explainer::of_recording(Path::new("/nowhere/a.mcap"));
        let question = PoseQuestion::of_query("target=alpha&frame=1.0.38").unwrap();
        let _turn = explainer.turn.lock().unwrap();
        assert!(matches!(explainer.answer(&question), Err(NoExplanation::Busy)));
    }
}
