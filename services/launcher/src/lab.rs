//! The commands that `flockeye` passes on to other programs: to `flockeye-lab`, `record` to
//! `flockeye-recorder`, and `replay` to the stage.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;

use anyhow::Context;
use clap::{Args, ValueEnum};
use flockeye_cli::lab::{COMMANDS, PROGRAM};
use flockeye_cli::program;

/// Whether these arguments of `flockeye` name a command of the lab, or ask for its help.
pub fn is_asked_for(arguments: &[OsString]) -> bool {
    let name = match arguments {
        [help, name, ..] if help == "help" => name,
        [name, ..] => name,
        [] => return false,
    };
    COMMANDS.iter().any(|command| name == command.name)
}

/// Replaces this process by the lab. Signals and the exit status are then the lab's own.
///
/// # Errors
/// The lab is not installed, or cannot be started.
pub fn become_lab(arguments: &[OsString]) -> anyhow::Result<()> {
    let path = program::find(PROGRAM).with_context(|| {
        let command = arguments.first().map(|name| name.to_string_lossy()).unwrap_or_default();
        format!("`flockeye {command}` is a command of {PROGRAM}")
    })?;
    // The lab's help shows this name, because users typed it.
    let error = Command::new(&path).arg0("flockeye").args(arguments).exec();
    Err(error).with_context(|| format!("cannot start {}", path.display()))
}

/// The program of `flockeye record`.
const RECORDER: &str = "flockeye-recorder";

/// The arguments of `flockeye record`, if it is asked for.
pub fn recorder_is_asked_for(arguments: &[OsString]) -> Option<Vec<OsString>> {
    match arguments {
        [help, name, ..] if help == "help" && name == "record" => Some(vec!["--help".into()]),
        [name, rest @ ..] if name == "record" => Some(rest.to_vec()),
        _ => None,
    }
}

/// Replaces this process by the recorder.
///
/// # Errors
/// It is not installed, or cannot be started.
pub fn become_recorder(arguments: &[OsString]) -> anyhow::Result<()> {
    let path = program::find(RECORDER)
        .with_context(|| format!("`flockeye record` is the program {RECORDER}"))?;
    let error = Command::new(&path).args(arguments).exec();
    Err(error).with_context(|| format!("cannot start {}", path.display()))
}

/// Arguments of `replay`.
#[derive(Debug, Args)]
pub struct ReplayArguments {
    /// A recording of a lossless flight, with its views: flockeye record --frames views.
    #[arg(value_name = "FILE.mcap")]
    pub file: PathBuf,
    /// The stage.
    #[arg(long, value_enum, default_value_t = ReplayedStage::Fusion)]
    pub stage: ReplayedStage,
}

/// A stage that can be replayed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ReplayedStage {
    /// Fusion: from views, detections, rotations and frame ends to tracks and plans.
    Fusion,
}

/// Replaces this process by the stage, which compares what it gives with what it gave.
///
/// # Errors
/// It is not installed, or cannot be started.
pub fn become_stage(arguments: &ReplayArguments) -> anyhow::Result<()> {
    let name = match arguments.stage {
        ReplayedStage::Fusion => "flockeye-fusion",
    };
    let path = program::find(name).context("a recording is replayed by the stage's own program")?;
    let error = Command::new(&path).arg("replay").arg(&arguments.file).exec();
    Err(error).with_context(|| format!("cannot start {}", path.display()))
}

/// The lab's commands with their descriptions, for the help of `flockeye`.
pub fn listing() -> String {
    let widest = COMMANDS.iter().map(|command| command.name.len()).max().unwrap_or(0);
    let line = |name: &str, about: &str| format!("  {name:<widest$}  {about}");
    COMMANDS.map(|command| line(command.name, command.about)).join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(arguments: &[&str]) -> bool {
        is_asked_for(&arguments.iter().map(OsString::from).collect::<Vec<_>>())
    }

    #[test]
    fn commands_of_the_lab_are_recognized() {
        for arguments in [&["eval"][..], &["partition", "--json"], &["help", "markers"]] {
            assert!(asked(arguments), "{arguments:?}");
        }
        for arguments in [&[][..], &["up", "eval"], &["help"], &["help", "up"], &["--help"]] {
            assert!(!asked(arguments), "{arguments:?}");
        }
    }

    #[test]
    fn the_recorder_gets_its_arguments() {
        let arguments = |words: &[&str]| words.iter().map(OsString::from).collect::<Vec<_>>();
        let asked = |words: &[&str]| recorder_is_asked_for(&arguments(words));
        assert_eq!(asked(&["record", "a.mcap", "--help"]), Some(arguments(&["a.mcap", "--help"])));
        assert_eq!(asked(&["help", "record"]), Some(arguments(&["--help"])));
        assert_eq!(asked(&["up", "record"]), None);
    }

    #[test]
    fn every_command_is_listed_with_what_it_does() {
        let listing = listing();
        assert!(listing.contains("  eval        Compare recorded poses with the truth\n"));
        assert_eq!(listing.lines().count(), COMMANDS.len());
    }
}
