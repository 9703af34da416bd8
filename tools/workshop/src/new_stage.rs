//! `flockeye stage new`: writes a stage that runs as it is.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use clap::{Args, ValueEnum};
use flockeye_cli::Screen;
use flockeye_contract::StageName;

/// Arguments of `stage new`.
#[derive(Debug, Args)]
pub(crate) struct NewArguments {
    /// Which stage: detection; in Python also rectification or fusion.
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
pub(crate) enum Language {
    /// Rust, with the crates of Flockeye's own stages.
    Rust,
    /// Python, with the package `clients/python`.
    Python,
    /// C, with the library `clients/c`.
    C,
}

impl Language {
    /// The command that builds an example in `folder`.
    fn build(self, folder: &str) -> String {
        match self {
            Self::Python => {
                "pip install clients/python numpy opencv-contrib-python-headless".to_owned()
            }
            Self::C => format!(
                "make install-c PREFIX=/usr/local; cmake -S {folder} -B {folder}/build && cmake --build {folder}/build"
            ),
            Self::Rust => format!("cargo build --release --manifest-path {folder}/Cargo.toml"),
        }
    }
}

/// An example stage, which is tested in flights.
struct Example {
    stage: StageName,
    lang: Language,
    /// Folder of the example in Flockeye's sources.
    folder: &'static str,
    /// Name and text of each file.
    files: &'static [(&'static str, &'static str)],
    /// The name of the program.
    program: &'static str,
    /// Settings that the example needs.
    set: &'static [&'static str],
}

impl Example {
    /// The command that starts the program in `folder`.
    fn command(&self, folder: &str) -> String {
        let program = self.program;
        match self.lang {
            Language::Python => format!("python3 {folder}/{program}"),
            Language::C => format!("{folder}/build/{program}"),
            Language::Rust => format!("{folder}/target/release/{program}"),
        }
    }

    /// The text of a file for `folder`, with paths adapted to that folder.
    fn text(
        &self,
        file: &str,
        text: &str,
        folder: &str,
        sources: Option<&Path>,
    ) -> anyhow::Result<String> {
        match file {
            "Cargo.toml" => manifest(text, sources),
            _ => Ok(text
                .replace(&format!("{}/", self.folder), &format!("{folder}/"))
                .replace(&format!("{} ", self.folder), &format!("{folder} "))),
        }
    }
}

/// Makes an example with the files from its folder.
macro_rules! example {
    ($stage:ident, $lang:ident, $folder:literal, $program:literal, [$($file:literal),+], $set:expr) => {
        Example {
            stage: StageName::$stage,
            lang: Language::$lang,
            folder: $folder,
            files: &[$(($file, include_str!(concat!("../../../", $folder, "/", $file)))),+],
            program: $program,
            set: $set,
        }
    };
}

const EXAMPLES: [Example; 5] = [
    example!(Detection, Python, "examples", "detector.py", ["detector.py"], &[]),
    example!(Rectification, Python, "examples", "rectifier.py", ["rectifier.py"], &[]),
    example!(Fusion, Python, "examples", "bearings.py", ["bearings.py"], &[]),
    example!(
        Detection,
        C,
        "examples/c/detector",
        "apriltag-detector",
        ["apriltag_detector.c", "CMakeLists.txt"],
        &["bodies.dictionary=DICT_APRILTAG_36h11"]
    ),
    example!(
        Detection,
        Rust,
        "examples/rust/detector",
        "my-detector",
        ["src/main.rs", "Cargo.toml"],
        &[]
    ),
];

/// Writes the example of a stage to the user's folder.
///
/// # Errors
/// The stage or its example does not exist, or a file exists already or cannot be written.
pub(crate) fn run(arguments: &NewArguments) -> anyhow::Result<()> {
    let NewArguments { kind, folder, lang, sources } = arguments;
    let ours = || EXAMPLES.iter().filter(|example| example.lang == *lang);
    let Some(example) = ours().find(|example| example.stage.name() == kind) else {
        let kinds: Vec<_> = ours().map(|example| example.stage.name()).collect();
        // Every kind with an example has one in Python.
        let has_other = EXAMPLES.iter().any(|example| example.stage.name() == kind);
        let other = if has_other { ", or --lang python" } else { "" };
        bail!(
            "there is no example of a stage '{kind}' in {lang:?}. Cure: one of {}{other}",
            kinds.join(", ")
        );
    };
    let shown = folder.display().to_string();
    let paths: Vec<_> = example.files.iter().map(|(file, _)| folder.join(file)).collect();
    for path in &paths {
        ensure!(!path.exists(), "{} is there already. Cure: name another folder", path.display());
    }
    let text_of =
        |(file, text): &(&str, &str)| example.text(file, text, &shown, sources.as_deref());
    // All texts are made before the first file is written, so a failure leaves no files.
    let texts = example.files.iter().map(text_of).collect::<anyhow::Result<Vec<String>>>()?;
    for (path, text) in paths.iter().zip(texts) {
        let parent = path.parent().unwrap_or(folder);
        std::fs::create_dir_all(parent).with_context(|| format!("{}", parent.display()))?;
        std::fs::write(path, text).with_context(|| format!("{}", path.display()))?;
    }
    let (build, program) = (lang.build(&shown), example.command(&shown));
    let set: String = example.set.iter().map(|setting| format!(" --set {setting}")).collect();
    Screen::new().line(&format!(
        "{} is written. It runs as it is; the first line where Flockeye's sources are:\n  {build}\n  flockeye stage \
         test {kind}{set} -- {program}\n  flockeye up{set} &\n  flockeye swap {kind} --accept-worse -- \
         {program}\nWhat it owes to the others: docs/CONTRACT.md",
        paths[0].display(),
    ));
    Ok(())
}

/// The manifest of a Rust stage outside of Flockeye's workspace. Dependencies from the workspace
/// are written out.
fn manifest(example: &str, sources: Option<&Path>) -> anyhow::Result<String> {
    let built = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let sources = sources.unwrap_or(&built);
    let sources = std::fs::canonicalize(sources).unwrap_or_else(|_| sources.to_owned());
    ensure!(
        sources.join("common/runtime/Cargo.toml").exists(),
        "Flockeye's sources are not at {}. Cure: --sources FOLDER",
        sources.display()
    );
    let workspace = sources.join("Cargo.toml");
    let workspace =
        std::fs::read_to_string(&workspace).with_context(|| workspace.display().to_string())?;
    let section = |text: &str, name: &str| -> anyhow::Result<String> {
        let (_, rest) = text.split_once(name).with_context(|| format!("no {name}"))?;
        Ok(rest.split("\n[").next().unwrap_or_default().to_owned())
    };
    let known = section(&workspace, "[workspace.dependencies]")?;
    let path = format!("path = \"{}/", sources.display());
    let mut dependencies = String::new();
    for name in section(example, "[dependencies]")?.lines() {
        let Some(name) = name.strip_suffix(".workspace = true") else { continue };
        let wanted = format!("{name} = ");
        let line = known.lines().find(|line| line.starts_with(&wanted));
        let line = line.with_context(|| format!("{} has no {name}", sources.display()))?;
        dependencies += &format!("{}\n", line.replace("path = \"", &path));
    }
    let package = example.lines().find(|line| line.starts_with("name = ")).unwrap_or_default();
    Ok(format!(
        "[package]\n{package}\nversion = \"0.1.0\"\nedition = \"2024\"\n\n[dependencies]\n{dependencies}\n\
         # A workspace of its own, wherever it lies.\n[workspace]\n"
    ))
}
