//! `flockeye stage`: stages of one's own.

use std::path::{Path, PathBuf};

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
    /// Which stage: detection, rectification or fusion in Python, detection in Rust and C.
    pub kind: String,
    /// Where to.
    pub folder: PathBuf,
    /// In which language.
    #[arg(long, value_enum, default_value_t = Language::Python)]
    pub lang: Language,
    /// Where Flockeye's sources are, for a stage in Rust. Without it: where this program was built.
    #[arg(long, value_name = "FOLDER")]
    pub sources: Option<PathBuf>,
}

/// A language that a stage can be written in.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Language {
    /// Rust, with the crates of Flockeye's own stages.
    Rust,
    /// Python, with the package `clients/python`.
    Python,
    /// C, with the library `clients/c`.
    C,
}

/// An example that the tests fly.
struct Example {
    stage: StageName,
    lang: Language,
    /// The name of each file, and its text.
    files: &'static [(&'static str, &'static str)],
    /// What makes a program of it; `FOLDER` is where it lies.
    build: &'static str,
    /// The program.
    program: &'static str,
    /// Settings that it needs.
    set: &'static [&'static str],
}

const PYTHON_NEEDS: &str = "pip install clients/python numpy opencv-contrib-python-headless";

const EXAMPLES: [Example; 5] = [
    Example {
        stage: StageName::Detection,
        lang: Language::Python,
        files: &[("detector.py", include_str!("../../../examples/detector.py"))],
        build: PYTHON_NEEDS,
        program: "python3 FOLDER/detector.py",
        set: &[],
    },
    Example {
        stage: StageName::Rectification,
        lang: Language::Python,
        files: &[("rectifier.py", include_str!("../../../examples/rectifier.py"))],
        build: PYTHON_NEEDS,
        program: "python3 FOLDER/rectifier.py",
        set: &[],
    },
    Example {
        stage: StageName::Fusion,
        lang: Language::Python,
        files: &[("bearings.py", include_str!("../../../examples/bearings.py"))],
        build: PYTHON_NEEDS,
        program: "python3 FOLDER/bearings.py",
        set: &[],
    },
    Example {
        stage: StageName::Detection,
        lang: Language::C,
        files: &[
            ("apriltag_detector.c", include_str!("../../../examples/c/apriltag_detector.c")),
            ("CMakeLists.txt", include_str!("../../../examples/c/CMakeLists.txt")),
        ],
        build: "make install-c PREFIX=/usr/local; cmake -S FOLDER -B FOLDER/build && cmake --build FOLDER/build",
        program: "FOLDER/build/apriltag-detector",
        set: &["bodies.dictionary=DICT_APRILTAG_36h11"],
    },
    Example {
        stage: StageName::Detection,
        lang: Language::Rust,
        files: &[
            ("src/main.rs", include_str!("../../../examples/rust/src/main.rs")),
            ("Cargo.toml", include_str!("../../../examples/rust/Cargo.toml")),
        ],
        build: "cargo build --release --manifest-path FOLDER/Cargo.toml",
        program: "FOLDER/target/release/my-detector",
        set: &[],
    },
];

/// Does it.
///
/// # Errors
/// There is no such stage or no example of it, or a file is there already or cannot be written; a candidate
/// that does not keep the contract.
pub fn run(command: &StageCommand) -> anyhow::Result<()> {
    match command {
        StageCommand::New(arguments) => write_new(arguments),
        StageCommand::Test(arguments) => conformance::run(arguments),
    }
}

fn write_new(arguments: &NewArguments) -> anyhow::Result<()> {
    let NewArguments { kind, folder, lang, sources } = arguments;
    let ours = || EXAMPLES.iter().filter(|example| example.lang == *lang);
    let Some(example) = ours().find(|example| example.stage.name() == kind) else {
        let kinds: Vec<_> = ours().map(|example| example.stage.name()).collect();
        bail!(
            "there is no example of a stage '{kind}' in {lang:?}. Cure: one of {}",
            kinds.join(", ")
        );
    };
    let shown = folder.display().to_string();
    let paths: Vec<_> = example.files.iter().map(|(file, _)| folder.join(file)).collect();
    for path in &paths {
        ensure!(!path.exists(), "{} is there already. Cure: name another folder", path.display());
    }
    let text_of = |(path, (file, text)): (&PathBuf, &(&str, &str))| match *file {
        "Cargo.toml" => manifest(sources.as_deref()),
        _ => Ok(text
            .replace(&format!("examples/{file}"), &path.display().to_string())
            .replace("examples/c ", &format!("{shown} "))
            .replace("build/apriltag-detector", &format!("{shown}/build/apriltag-detector"))
            .replace("-B build ", &format!("-B {shown}/build "))
            .replace("--build build", &format!("--build {shown}/build"))),
    };
    // All before the first is written: a failure leaves nothing behind.
    let texts =
        paths.iter().zip(example.files).map(text_of).collect::<anyhow::Result<Vec<String>>>()?;
    for (path, text) in paths.iter().zip(texts) {
        let parent = path.parent().unwrap_or(folder);
        std::fs::create_dir_all(parent).with_context(|| format!("{}", parent.display()))?;
        std::fs::write(path, text).with_context(|| format!("{}", path.display()))?;
    }
    let (build, program) =
        (example.build.replace("FOLDER", &shown), example.program.replace("FOLDER", &shown));
    let set: String = example.set.iter().map(|setting| format!(" --set {setting}")).collect();
    Screen::new().line(&format!(
        "{} is written. It runs as it is; the first line where Flockeye's sources are:\n  {build}\n  flockeye stage \
         test {kind}{set} -- {program}\n  flockeye up{set} &\n  flockeye swap {kind} --accept-worse -- \
         {program}\nWhat it owes to the others: docs/CONTRACT.md",
        paths[0].display(),
    ));
    Ok(())
}

/// The manifest of a stage in Rust outside of Flockeye's own workspace.
fn manifest(sources: Option<&Path>) -> anyhow::Result<String> {
    let built = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let sources = sources.unwrap_or(&built);
    let sources = std::fs::canonicalize(sources).unwrap_or_else(|_| sources.to_owned());
    ensure!(
        sources.join("common/runtime/Cargo.toml").exists(),
        "Flockeye's sources are not at {}. Cure: --sources FOLDER",
        sources.display()
    );
    let sources = sources.display();
    Ok(format!(
        "[package]\nname = \"my-detector\"\nversion = \"0.1.0\"\nedition = \"2024\"\n\n[dependencies]\n\
         flockeye-contract = {{ path = \"{sources}/common/contract\" }}\n\
         flockeye-detection = {{ path = \"{sources}/services/detection\" }}\n\
         flockeye-runtime = {{ path = \"{sources}/common/runtime\" }}\nanyhow = \"1\"\n\n\
         # A workspace of its own, wherever it lies.\n[workspace]\n"
    ))
}
