//! The commands that `flockeye` passes on to other programs: to `flockeye-lab`, `record` to
//! `flockeye-recorder`, `view` to `flockeye-viewer`, and `replay` and `explain` to the stage.

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

/// Replaces this process by the lab.
///
/// # Errors
/// As [`become_program`].
pub fn become_lab(arguments: &[OsString]) -> anyhow::Result<()> {
    become_program(PROGRAM, "flockeye", arguments).with_context(|| {
        let command = arguments.first().map(|name| name.to_string_lossy()).unwrap_or_default();
        format!("`flockeye {command}` is a command of {PROGRAM}")
    })
}

/// Replaces this process by another program of ours, whose help shows the name that users typed. Signals and the exit
/// status are then its own.
///
/// # Errors
/// It is not installed, or cannot be started.
pub fn become_program(name: &str, typed: &str, arguments: &[OsString]) -> anyhow::Result<()> {
    let path = program::find(name)?;
    let error = Command::new(&path).arg0(typed).args(arguments).exec();
    Err(error).with_context(|| format!("cannot start {}", path.display()))
}

/// A command that another program does: it gets all arguments, those for its help too.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PassedOn {
    command: &'static str,
    /// Whether the program gets the command's name first, because it does others as well.
    is_named: bool,
    /// The program.
    pub program: &'static str,
    /// The name that users type.
    pub typed: &'static str,
}

const PASSED_ON: [PassedOn; 3] = [
    PassedOn {
        command: "record",
        is_named: false,
        program: "flockeye-recorder",
        typed: "flockeye record",
    },
    PassedOn {
        command: "view",
        is_named: false,
        program: "flockeye-viewer",
        typed: "flockeye view",
    },
    PassedOn {
        command: "explain",
        is_named: true,
        program: "flockeye-fusion",
        typed: "flockeye-fusion",
    },
];

/// The program that these arguments of `flockeye` are for, and what it gets, if there is one.
pub fn passed_on(arguments: &[OsString]) -> Option<(PassedOn, Vec<OsString>)> {
    let of = |name: &OsString| PASSED_ON.into_iter().find(|passed| name == passed.command);
    let (passed, rest) = match arguments {
        [help, name, ..] if help == "help" => (of(name)?, vec!["--help".into()]),
        [name, rest @ ..] => (of(name)?, rest.to_vec()),
        [] => return None,
    };
    let name = passed.is_named.then(|| passed.command.into());
    Some((passed, name.into_iter().chain(rest).collect()))
}

/// Arguments of `replay`.
#[derive(Debug, Args)]
pub struct ReplayArguments {
    /// A recording with its views, from the first frame on: recording.folder, with recording.frames: views.
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
    become_program(name, name, &["replay".into(), arguments.file.clone().into()])
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
    fn programs_get_their_arguments() {
        let arguments = |words: &[&str]| words.iter().map(OsString::from).collect::<Vec<_>>();
        let asked = |words: &[&str]| {
            passed_on(&arguments(words)).map(|(passed, rest)| (passed.program, rest))
        };
        let recorder = |words: &[&str]| Some(("flockeye-recorder", arguments(words)));
        assert_eq!(asked(&["record", "a.mcap", "--help"]), recorder(&["a.mcap", "--help"]));
        assert_eq!(asked(&["help", "record"]), recorder(&["--help"]));
        assert_eq!(asked(&["view"]), Some(("flockeye-viewer", Vec::new())));
        let fusion = |words: &[&str]| Some(("flockeye-fusion", arguments(words)));
        assert_eq!(asked(&["explain", "a.mcap"]), fusion(&["explain", "a.mcap"]));
        assert_eq!(asked(&["help", "explain"]), fusion(&["explain", "--help"]));
        assert_eq!((asked(&["up", "record"]), asked(&["help"]), asked(&[])), (None, None, None));
    }

    #[test]
    fn every_command_is_listed_with_what_it_does() {
        let listing = listing();
        assert!(listing.contains("  eval        Compare recorded poses with the truth\n"));
        assert_eq!(listing.lines().count(), COMMANDS.len());
    }
}
