//! The commands of `flockeye` that other programs do.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::process::Command;

use anyhow::Context;
use flockeye_cli::program::{self, CommandInfo};
use flockeye_cli::{lab, replay, workshop};

const RECORDER: &str = "flockeye-recorder";
const VIEWER: &str = "flockeye-viewer";

/// The command that begins these arguments of `flockeye`, or whose help is requested, and the
/// arguments after it.
fn command_in(arguments: &[OsString]) -> Option<(&OsString, &[OsString])> {
    match arguments {
        [help, command, rest @ ..] if help == "help" => Some((command, rest)),
        [command, rest @ ..] => Some((command, rest)),
        [] => None,
    }
}

/// The program that runs these arguments, if it is not `flockeye` itself.
pub(crate) fn program_for(arguments: &[OsString]) -> Option<&'static str> {
    let (command, _) = command_in(arguments)?;
    let is_one_of = |commands: &[CommandInfo]| commands.iter().any(|known| command == known.name);
    match command.to_str()? {
        "record" => Some(RECORDER),
        "view" => Some(VIEWER),
        _ if is_one_of(&lab::COMMANDS) => Some(lab::PROGRAM),
        _ if is_one_of(&replay::COMMANDS) => Some(replay::PROGRAM),
        _ if is_one_of(&workshop::COMMANDS) => Some(workshop::PROGRAM),
        _ => None,
    }
}

/// The name that the help of `program` shows, and its arguments out of those of `flockeye`.
///
/// A program of several commands gets all of them. One of a single command gets what follows it.
fn name_and_arguments(program: &str, arguments: &[OsString]) -> (String, Vec<OsString>) {
    match command_in(arguments) {
        Some((command, rest)) if [RECORDER, VIEWER].contains(&program) => {
            let asks_for_help = arguments.first().is_some_and(|first| first == "help");
            let rest = if asks_for_help { vec!["--help".into()] } else { rest.to_vec() };
            (format!("flockeye {}", command.to_string_lossy()), rest)
        }
        _ => ("flockeye".to_owned(), arguments.to_vec()),
    }
}

/// Replaces this process by another program of Flockeye, for these arguments of `flockeye`. Signals
/// and the exit status are then its own.
pub(crate) fn become_program(program: &str, arguments: &[OsString]) -> anyhow::Result<()> {
    let (shown_name, passed_on) = name_and_arguments(program, arguments);
    let command = command_in(arguments).map(|(command, _)| command.to_string_lossy());
    let context = || {
        let command = command.as_deref().unwrap_or_default();
        format!("`flockeye {command}` is a command of {program}")
    };
    let path = program::find(program).with_context(context)?;
    let error = Command::new(&path).arg0(shown_name).args(passed_on).exec();
    Err(error).with_context(|| format!("cannot start {}", path.display())).with_context(context)
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
        let program = program_for(&arguments)?;
        let (shown_name, passed_on) = name_and_arguments(program, &arguments);
        Some((program, shown_name, passed_on))
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
