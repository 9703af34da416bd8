//! `flockeye view`: the live view, which is a program of its own. It needs OpenCV and the drawing code, which
//! nothing else here does.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::process::Command;

use anyhow::Context;
use clap::Args;
use flockeye_cli::program;

/// The program.
const PROGRAM: &str = "flockeye-viewer";

/// Arguments of `view`. `flockeye view --help` lists them.
#[derive(Debug, Args)]
#[command(disable_help_flag = true)]
pub struct ViewArguments {
    /// They are the program's.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENTS")]
    pub arguments: Vec<OsString>,
}

/// Replaces this process by the program. Signals and the exit status are then its own.
///
/// # Errors
/// It is not installed, or cannot be started.
pub fn run(arguments: &ViewArguments) -> anyhow::Result<()> {
    let path = program::find(PROGRAM).context("the live view is a program of its own")?;
    let error = Command::new(&path).args(&arguments.arguments).exec();
    Err(error).with_context(|| format!("cannot start {}", path.display()))
}
