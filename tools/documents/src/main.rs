//! Writes the man pages and the shell completions of `flockeye` to a folder: `man/` and
//! `completions/`.
//!
//! Users see the commands of several programs as one command line, so they are combined here.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use clap::{Command, CommandFactory};
use clap_complete::aot::{Shell, generate_to};
use flockeye_recorder::arguments::RecordArguments;
use flockeye_viewer::program::ViewArguments;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    ensure!(arguments.len() == 1, "usage: flockeye-documents FOLDER");
    write(&PathBuf::from(&arguments[0]))
}

/// Writes all files below `folder`.
fn write(folder: &Path) -> anyhow::Result<()> {
    let [man, completions] = ["man", "completions"].map(|name| folder.join(name));
    for folder in [&man, &completions] {
        fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    }
    clap_mangen::generate_to(whole_command(), &man).context("man pages")?;
    for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
        generate_to(shell, &mut whole_command(), "flockeye", &completions)
            .with_context(|| format!("completions of {shell}"))?;
    }
    Ok(())
}

/// The combined command line of all programs.
fn whole_command() -> Command {
    let mut whole = flockeye_launcher::commands::own_command();
    let passed_on = [("record", RecordArguments::command()), ("view", ViewArguments::command())];
    for (name, command) in passed_on {
        whole =
            whole.mut_subcommand(name, |_| command.name(name).bin_name(format!("flockeye {name}")));
    }
    for program in [flockeye_replay::commands::command(), flockeye_workshop::commands::command()] {
        // A command of `flockeye` itself is not changed.
        whole = whole.mut_subcommands(|own| {
            let found = program.find_subcommand(own.get_name());
            found.filter(|found| !found.is_hide_set()).cloned().unwrap_or(own)
        });
    }
    let lab = flockeye_lab::commands::command();
    let commands: Vec<_> = lab.get_subcommands().cloned().collect();
    whole.subcommands(commands)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_programs_commands_are_in_it() {
        let whole = whole_command();
        whole.clone().debug_assert();
        for path in [
            &["up"][..],
            &["record"],
            &["view"],
            &["replay"],
            &["explain"],
            &["calibrate", "body"],
            &["eval"],
            &["chaos"],
            &["stage", "test"],
            &["swarm", "sim"],
            &["contract"],
        ] {
            let found = path.iter().try_fold(&whole, |command, name| command.find_subcommand(name));
            let found = found.unwrap_or_else(|| panic!("{path:?} is missing"));
            assert!(found.get_about().is_some(), "{path:?} says nothing about itself");
            assert!(found.get_arguments().next().is_some(), "{path:?} has no arguments");
        }
    }
}
