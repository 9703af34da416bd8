//! The commands of `flockeye` that other programs do.

use std::ffi::{OsStr, OsString};
use std::os::unix::process::CommandExt;
use std::process::Command;

use anyhow::Context;
use flockeye_cli::program::{self, CommandInfo};
use flockeye_cli::{lab, replay, workshop};

/// A program that does some of `flockeye`'s commands.
#[derive(Debug, Clone, Copy)]
struct OtherProgram {
    name: &'static str,
    arguments: Arguments,
}

/// What a program gets of the arguments of `flockeye`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Arguments {
    /// All of them: it does several commands, and its help shows the name `flockeye`.
    All,
    /// Those after the command's name: the command is all that it does.
    AfterCommand,
}

const LAB: OtherProgram = OtherProgram { name: lab::PROGRAM, arguments: Arguments::All };
const REPLAY: OtherProgram = OtherProgram { name: replay::PROGRAM, arguments: Arguments::All };
const WORKSHOP: OtherProgram = OtherProgram { name: workshop::PROGRAM, arguments: Arguments::All };
const RECORDER: OtherProgram =
    OtherProgram { name: "flockeye-recorder", arguments: Arguments::AfterCommand };
const VIEWER: OtherProgram =
    OtherProgram { name: "flockeye-viewer", arguments: Arguments::AfterCommand };

/// The program that does this command, if it is not `flockeye` itself.
fn program_for(command: &OsStr) -> Option<OtherProgram> {
    let is_one_of = |commands: &[CommandInfo]| commands.iter().any(|known| command == known.name);
    match command.to_str()? {
        "record" => Some(RECORDER),
        "view" => Some(VIEWER),
        _ if is_one_of(&lab::COMMANDS) => Some(LAB),
        _ if is_one_of(&replay::COMMANDS) => Some(REPLAY),
        _ if is_one_of(&workshop::COMMANDS) => Some(WORKSHOP),
        _ => None,
    }
}

/// Another program of ours that is to do what `flockeye` was asked for.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct PassedOn {
    command: String,
    program: &'static str,
    /// The name that its help shows.
    shown_name: String,
    arguments: Vec<OsString>,
}

impl PassedOn {
    /// The program for these arguments of `flockeye`, if another one does that command or has its
    /// help.
    pub(crate) fn of(arguments: &[OsString]) -> Option<Self> {
        let (command, rest, is_help) = match arguments {
            [help, command, rest @ ..] if help == "help" => (command, rest, true),
            [command, rest @ ..] => (command, rest, false),
            [] => return None,
        };
        let program = program_for(command)?;
        let after_command = || match is_help {
            true => vec!["--help".into()],
            false => rest.to_vec(),
        };
        let name = command.to_string_lossy().into_owned();
        let (shown_name, arguments) = match program.arguments {
            Arguments::All => ("flockeye".to_owned(), arguments.to_vec()),
            Arguments::AfterCommand => (format!("flockeye {name}"), after_command()),
        };
        Some(Self { command: name, program: program.name, shown_name, arguments })
    }

    /// Replaces this process by the program.
    ///
    /// # Errors
    /// It is not installed, or cannot be started.
    pub(crate) fn become_program(&self) -> anyhow::Result<()> {
        let Self { command, program, shown_name, arguments } = self;
        become_program(program, shown_name, arguments)
            .with_context(|| format!("`flockeye {command}` is a command of {program}"))
    }
}

/// Replaces this process by another program of ours, whose help shows `shown_name`. Signals and the
/// exit status are then its own.
///
/// # Errors
/// It is not installed, or cannot be started.
fn become_program(name: &str, shown_name: &str, arguments: &[OsString]) -> anyhow::Result<()> {
    let path = program::find(name)?;
    let error = Command::new(&path).arg0(shown_name).args(arguments).exec();
    Err(error).with_context(|| format!("cannot start {}", path.display()))
}

/// The lab's commands with their descriptions, for the help of `flockeye`.
pub(crate) fn listing() -> String {
    let widest = lab::COMMANDS.iter().map(|command| command.name.len()).max().unwrap_or(0);
    let line = |name: &str, about: &str| format!("  {name:<widest$}  {about}");
    lab::COMMANDS.map(|command| line(command.name, command.about)).join("\n")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn passed_on(arguments: &[&str]) -> Option<(&'static str, String, Vec<OsString>)> {
        let arguments: Vec<_> = arguments.iter().map(OsString::from).collect();
        let passed_on = PassedOn::of(&arguments)?;
        Some((passed_on.program, passed_on.shown_name, passed_on.arguments))
    }

    fn program(
        name: &'static str,
        shown_name: &str,
        arguments: &[&str],
    ) -> Option<(&'static str, String, Vec<OsString>)> {
        let arguments = arguments.iter().map(OsString::from).collect();
        Some((name, shown_name.to_owned(), arguments))
    }

    #[test]
    fn programs_of_several_commands_get_the_whole_command_line() {
        for arguments in [&["eval"][..], &["partition", "--json"], &["help", "markers"]] {
            assert_eq!(passed_on(arguments), program("flockeye-lab", "flockeye", arguments));
        }
        for arguments in [&["stage", "test", "fusion"][..], &["chaos"], &["help", "stage", "new"]] {
            assert_eq!(passed_on(arguments), program("flockeye-workshop", "flockeye", arguments));
        }
        for arguments in [&["explain", "a.mcap"][..], &["help", "explain"], &["replay", "a.mcap"]] {
            assert_eq!(passed_on(arguments), program("flockeye-replay", "flockeye", arguments));
        }
    }

    #[test]
    fn programs_of_one_command_get_what_follows_it() {
        let recorder = |arguments| program("flockeye-recorder", "flockeye record", arguments);
        assert_eq!(passed_on(&["record", "a.mcap", "--help"]), recorder(&["a.mcap", "--help"]));
        assert_eq!(passed_on(&["help", "record"]), recorder(&["--help"]));
        assert_eq!(passed_on(&["view"]), program("flockeye-viewer", "flockeye view", &[]));
    }

    #[test]
    fn other_commands_are_our_own() {
        for own in [&[][..], &["up", "eval"], &["up", "record"], &["help"], &["help", "up"]] {
            assert_eq!(passed_on(own), None, "{own:?}");
        }
        assert_eq!(passed_on(&["--help"]), None);
    }

    #[test]
    fn every_command_is_listed_with_what_it_does() {
        let listing = listing();
        assert!(listing.contains("  eval        Compare recorded poses with the truth\n"));
        assert_eq!(listing.lines().count(), lab::COMMANDS.len());
    }
}
