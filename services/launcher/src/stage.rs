//! `flockeye stage`: stages of one's own.

use std::path::PathBuf;

use anyhow::{Context, bail, ensure};
use clap::{Args, Subcommand, ValueEnum};
use flockeye_cli::Screen;
use flockeye_contract::StageName;

use crate::conformance::{self, TestArguments};

/// What to do.
#[derive(Debug, Subcommand)]
pub enum StageCommand {
    /// Write a stage that runs as it is.
    New(NewArguments),
    /// Test a stage alone against the contract.
    Test(TestArguments),
}

/// Arguments of `stage new`.
#[derive(Debug, Args)]
pub struct NewArguments {
    /// Which stage: detection, rectification or fusion.
    pub kind: String,
    /// Where to.
    pub folder: PathBuf,
    /// In which language.
    #[arg(long, value_enum, default_value_t = Language::Python)]
    pub lang: Language,
}

/// A language that a stage can be written in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Language {
    /// Python, with the package `clients/python`.
    Python,
}

/// The examples, which the tests fly: (stage, name of the file, its text).
const PYTHON: [(StageName, &str, &str); 3] = [
    (StageName::Detection, "detector.py", include_str!("../../../examples/detector.py")),
    (StageName::Rectification, "rectifier.py", include_str!("../../../examples/rectifier.py")),
    (StageName::Fusion, "bearings.py", include_str!("../../../examples/bearings.py")),
];

/// Does it.
///
/// # Errors
/// There is no such stage or no example of it, or the file is there already or cannot be written; a candidate
/// that does not keep the contract.
pub fn run(command: &StageCommand) -> anyhow::Result<()> {
    match command {
        StageCommand::New(arguments) => write_new(arguments),
        StageCommand::Test(arguments) => conformance::run(arguments),
    }
}

fn write_new(arguments: &NewArguments) -> anyhow::Result<()> {
    let NewArguments { kind, folder, lang: Language::Python } = arguments;
    let Some((_, file, text)) = PYTHON.iter().find(|(stage, ..)| stage.name() == kind) else {
        let kinds: Vec<_> = PYTHON.iter().map(|(stage, ..)| stage.name()).collect();
        bail!("there is no example of a stage '{kind}'. Cure: one of {}", kinds.join(", "));
    };
    std::fs::create_dir_all(folder).with_context(|| format!("{}", folder.display()))?;
    let path = folder.join(file);
    ensure!(!path.exists(), "{} is there already. Cure: name another folder", path.display());
    let text = text.replace(&format!("examples/{file}"), &path.display().to_string());
    std::fs::write(&path, text).with_context(|| format!("{}", path.display()))?;
    Screen::new().line(&format!(
        "{} is written. It runs as it is:\n  pip install clients/python numpy opencv-contrib-python-headless\n  \
         flockeye swap {kind} --accept-worse -- python3 {}\nWhat it owes to the others: docs/CONTRACT.md",
        path.display(),
        path.display()
    ));
    Ok(())
}
