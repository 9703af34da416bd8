//! The command line.

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand, ValueEnum};
use flockeye_config::Pipeline;
use flockeye_geometry::partition::{STORED_SEED, Weights};

use crate::markers::Paper;

/// Eyes for a flock: neighbours' poses from a spherical camera.
#[derive(Debug, Parser)]
#[command(name = "flockeye", version)]
pub struct Flockeye {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run a pipeline until its source ends, or until Ctrl-C.
    Up(Up),
    /// Check a configuration, and say what it means on this machine.
    Check(Check),
    /// Show what a running pipeline's stages do, and how old its poses are.
    Top(Top),
    /// Record frames' ways through a running pipeline, for Perfetto (ui.perfetto.dev).
    Trace(Trace),
    /// Show what the swarm's drones report of each other over Zenoh.
    Peers(Peers),
    /// Compare recorded poses with the truth.
    Eval(Eval),
    /// Work out the paper's tables anew, and how consistent covariances are.
    Experiment(Experiment),
    /// Tabulate and draw partitions of the sphere.
    Partition(Partition),
    /// Draw a body's marker sheets at true scale, to print, cut out and glue.
    Markers(Markers),
    /// Find out how something was really built, from a recording of it.
    #[command(subcommand)]
    Calibrate(Calibrate),
    /// Remove what dead runs left in shared memory.
    Clean(Clean),
    /// Print the JSON Schema of pipeline.yaml.
    Schema,
    /// Become a stage's process (used by `up`).
    #[command(hide = true)]
    ExecStage(ExecStage),
}

/// Which configuration.
#[derive(Debug, Clone, Args)]
pub struct Configuration {
    /// The configuration; without it, pipeline.yaml if there is one here, else the defaults.
    #[arg(value_name = "PIPELINE")]
    pub pipeline: Option<PathBuf>,
    /// sim, a video file, a folder of images, v4l2:/dev/video0, theta, or a GStreamer description.
    #[arg(long, value_name = "SRC")]
    pub source: Option<String>,
    /// The bodies, a JSON file of marker ids and corner positions.
    #[arg(long, value_name = "FILE")]
    pub bodies: Option<PathBuf>,
    /// latest (flight) or lossless (evaluation).
    #[arg(long)]
    pub flow: Option<FlowArgument>,
    /// Override any key of the configuration.
    #[arg(long = "set", value_name = "KEY.PATH=VALUE")]
    pub set: Vec<String>,
}

/// How frames flow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FlowArgument {
    /// The newest frame wins.
    Latest,
    /// Every frame is worked on.
    Lossless,
}

/// Arguments of `up`.
#[derive(Debug, Args)]
pub struct Up {
    /// Which configuration.
    #[command(flatten)]
    pub configuration: Configuration,
    /// Stop after this long: 20s, 5m, 1h.
    #[arg(long = "for", value_name = "DURATION", value_parser = duration)]
    pub duration: Option<Duration>,
    /// Record each neighbour's pose in each frame.
    #[arg(long, value_name = "FILE.csv")]
    pub poses: Option<PathBuf>,
    /// Record the truth of a simulated flight.
    #[arg(long, value_name = "FILE.csv")]
    pub truth: Option<PathBuf>,
}

/// Arguments of `check`.
#[derive(Debug, Args)]
pub struct Check {
    /// Which configuration.
    #[command(flatten)]
    pub configuration: Configuration,
    /// Fly it for so long, and say how soon a newcomer is found on this machine.
    #[arg(long, value_name = "DURATION", value_parser = duration)]
    pub measure: Option<Duration>,
}

/// Which running pipeline.
#[derive(Debug, Clone, Args)]
pub struct Running {
    /// Its instance; without it, the one that runs.
    #[arg(long, value_name = "NAME")]
    pub instance: Option<String>,
}

/// Arguments of `top`.
#[derive(Debug, Args)]
pub struct Top {
    /// Which pipeline.
    #[command(flatten)]
    pub running: Running,
    /// Look for two seconds, print once, and end.
    #[arg(long)]
    pub once: bool,
    /// JSON: one object a line, each second, or one alone with --once.
    #[arg(long)]
    pub json: bool,
    /// Stop after this long: 20s, 5m, 1h.
    #[arg(long = "for", value_name = "DURATION", value_parser = duration)]
    pub duration: Option<Duration>,
}

/// Arguments of `trace`.
#[derive(Debug, Args)]
pub struct Trace {
    /// Which pipeline.
    #[command(flatten)]
    pub running: Running,
    /// The trace, in Chrome's JSON format.
    #[arg(long, value_name = "FILE.json")]
    pub out: PathBuf,
    /// How long to record: 10s, 1m.
    #[arg(long = "for", value_name = "DURATION", value_parser = duration, default_value = "5s")]
    pub duration: Duration,
}

/// Arguments of `peers`.
#[derive(Debug, Args)]
pub struct Peers {
    /// Which configuration: the swarm and the network are taken from it.
    #[command(flatten)]
    pub configuration: Configuration,
    /// One JSON object a line for each report.
    #[arg(long)]
    pub json: bool,
    /// Stop after this long: 20s, 5m, 1h.
    #[arg(long = "for", value_name = "DURATION", value_parser = duration)]
    pub duration: Option<Duration>,
}

/// Arguments of `eval`.
#[derive(Debug, Args)]
pub struct Eval {
    /// The recorded poses.
    #[arg(long, value_name = "FILE.csv")]
    pub poses: PathBuf,
    /// The truth.
    #[arg(long, value_name = "FILE.csv")]
    pub truth: PathBuf,
    /// One JSON object instead of a table.
    #[arg(long)]
    pub json: bool,
    /// Write a page with the paper's figures for this run, index.html, into this folder.
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
}

/// Arguments of `experiment`.
#[derive(Debug, Args)]
pub struct Experiment {
    /// Which.
    #[command(subcommand)]
    pub kind: ExperimentKind,
}

/// The experiments.
#[derive(Debug, Subcommand)]
pub enum ExperimentKind {
    /// The paper's Table I: 6, 12 and 24 views, cut its way and ours.
    Partitions(Comparison),
    /// The paper's Table II: how a frame is searched, its two ways and ours.
    Search(Comparison),
    /// Whether errors are as large as their covariances say, over many simulated flights.
    Consistency(ConsistencyRuns),
}

/// Arguments of the experiments that compare.
#[derive(Debug, Args)]
pub struct Comparison {
    /// Which configuration; its flow is lossless.
    #[command(flatten)]
    pub configuration: Configuration,
    /// The truth of a recording; a simulated flight has its own.
    #[arg(long, value_name = "FILE.csv")]
    pub truth: Option<PathBuf>,
    /// Frames of each flight, at most.
    #[arg(long, default_value_t = 300, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub frames: u64,
    /// One JSON object instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `experiment consistency`.
#[derive(Debug, Args)]
pub struct ConsistencyRuns {
    /// Which configuration; its flow is lossless, its source simulated.
    #[command(flatten)]
    pub configuration: Configuration,
    /// Flights, each from a seed of its own.
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u32).range(2..=10_000))]
    pub runs: u32,
    /// Frames of each flight.
    #[arg(long, default_value_t = 45, value_parser = clap::value_parser!(u64).range(2..=1_000_000))]
    pub frames: u64,
    /// One JSON object instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `partition`.
#[derive(Debug, Args)]
pub struct Partition {
    /// Numbers of views, from 4 to 128: 12, 6,12,24 or 4..32 (both ends belong to it).
    #[arg(long, default_value = "4..32", value_parser = crate::partition::counts)]
    pub counts: Counts,
    /// covering: the smallest circles. paper: spread points, then grow circles.
    #[arg(long, default_value = "covering")]
    pub method: MethodArgument,
    /// Weights of the number of views, their pixels and their distortion in the cost.
    #[arg(long, value_name = "A1,A2,A3", value_parser = crate::partition::weights)]
    pub weights: Option<Weights>,
    /// What is this wide lies wholly in one view, degrees; a marker of 5 cm at 40 cm is 7.15.
    #[arg(long, value_name = "DEGREES", default_value_t = 7.15)]
    pub margin: f64,
    /// Pixels in a row of the sphere image.
    #[arg(long, value_name = "PIXELS", default_value_t = 3840, value_parser = clap::value_parser!(u32).range(64..=16384))]
    pub width: u32,
    /// Another random start; coverings by up to 32 circles are stored for 1.
    #[arg(long, default_value_t = STORED_SEED)]
    pub seed: u64,
    /// Find what is stored anew.
    #[arg(long)]
    pub compute: bool,
    /// JSON with directions and rolls instead of a table.
    #[arg(long)]
    pub json: bool,
    /// Draw the paper's figure: number of views against pixels, both methods.
    #[arg(long, value_name = "FILE.svg")]
    pub svg: Option<PathBuf>,
    /// Draw the (first) partition's circles and views on the sphere and on the sphere image.
    #[arg(long, value_name = "FILE.svg")]
    pub picture: Option<PathBuf>,
}

/// Numbers of views.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Counts(pub Vec<usize>);

/// How the directions of a partition are found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum MethodArgument {
    /// The smallest circles.
    Covering,
    /// Spread points, then grow circles.
    Paper,
}

/// Arguments of `markers`.
#[derive(Debug, Args)]
pub struct Markers {
    /// Which configuration: the bodies and their dictionary are taken from it.
    #[command(flatten)]
    pub configuration: Configuration,
    /// Whose facets.
    #[arg(long, value_name = "NAME")]
    pub body: String,
    /// The sheets: one PDF, or an SVG for each sheet.
    #[arg(long, value_name = "FILE.pdf|.svg")]
    pub out: PathBuf,
    /// Size of the sheets.
    #[arg(long, default_value = "a4")]
    pub paper: Paper,
}

/// What is found out.
#[derive(Debug, Subcommand)]
pub enum Calibrate {
    /// Where a body's markers really are: they were glued by hand.
    Body(CalibrateBody),
}

/// Arguments of `calibrate body`.
#[derive(Debug, Args)]
pub struct CalibrateBody {
    /// Which configuration: the camera, the bodies as designed, and what is recorded of them.
    #[command(flatten)]
    pub configuration: Configuration,
    /// The bodies as they are found: a JSON file for --bodies.
    #[arg(long, value_name = "FILE.json")]
    pub out: PathBuf,
}

/// Arguments of `clean`.
#[derive(Debug, Args)]
pub struct Clean {
    /// Only this instance.
    #[arg(long, value_name = "NAME")]
    pub instance: Option<String>,
}

/// Arguments of `exec-stage`.
#[derive(Debug, Args)]
pub struct ExecStage {
    /// The process that must live as long as this one.
    #[arg(long)]
    pub parent: u32,
    /// Processors that it may run on.
    #[arg(long, value_delimiter = ',')]
    pub cpus: Vec<u32>,
    /// How far it gives way to others.
    #[arg(long, default_value_t = 0, allow_negative_numbers = true)]
    pub nice: i32,
    /// Its scheduling class, where it is not the normal one.
    #[arg(long, value_enum)]
    pub scheduling: Option<SchedulingArgument>,
    /// Its priority within fifo and round-robin.
    #[arg(long, default_value_t = 1)]
    pub priority: u8,
    /// The stage's program and its arguments.
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, required = true)]
    pub command: Vec<OsString>,
}

/// A scheduling class.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum SchedulingArgument {
    /// For what computes much.
    Batch,
    /// When nobody else wants to run.
    Idle,
    /// Before all others, until it waits.
    Fifo,
    /// The same, in turn.
    RoundRobin,
}

fn duration(text: &str) -> Result<Duration, String> {
    humantime::parse_duration(text).map_err(|error| format!("{error}; write 20s, 5m or 1h"))
}

impl Configuration {
    /// The configuration with everything that the command line says on top.
    ///
    /// # Errors
    /// Everything that is wrong with it.
    pub fn load(&self) -> anyhow::Result<Pipeline> {
        self.load_between(&[], &[])
    }

    /// The same with `KEY.PATH=VALUE` settings that the command line goes before, and such that go
    /// before the command line.
    ///
    /// # Errors
    /// Everything that is wrong with it.
    pub fn load_between(&self, usual: &[String], fixed: &[String]) -> anyhow::Result<Pipeline> {
        let overrides = [usual, &self.overrides(), fixed].concat();
        let here = PathBuf::from("pipeline.yaml");
        let pipeline = match &self.pipeline {
            Some(path) => Pipeline::load(path, &overrides)?,
            None if here.exists() => Pipeline::load(&here, &overrides)?,
            None => Pipeline::parse("", &overrides, "the command line")?,
        };
        Ok(pipeline)
    }

    /// `--source` and its like as overrides, before those of `--set`.
    fn overrides(&self) -> Vec<String> {
        // JSON strings are YAML: whatever is in the text stays text.
        let quoted = |text: &str| serde_json::Value::from(text).to_string();
        let source = self.source.as_ref().map(|source| format!("source.input={}", quoted(source)));
        let bodies = self
            .bodies
            .as_ref()
            .map(|file| format!("bodies.file={}", quoted(&file.to_string_lossy())));
        let flow = self.flow.map(|flow| match flow {
            FlowArgument::Latest => "flow=latest".to_owned(),
            FlowArgument::Lossless => "flow=lossless".to_owned(),
        });
        [source, bodies, flow].into_iter().flatten().chain(self.set.iter().cloned()).collect()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn the_command_line_is_well_formed() {
        use clap::CommandFactory;
        Flockeye::command().debug_assert();
    }

    #[test]
    fn shortcuts_are_overrides() {
        let arguments = [
            "flockeye",
            "up",
            "--source",
            "a: b ! c",
            "--flow",
            "lossless",
            "--set",
            "search.mode=greedy",
        ];
        let Command::Up(up) = Flockeye::parse_from(arguments).command else { panic!("up") };
        let pipeline = Pipeline::parse("", &up.configuration.overrides(), "x").unwrap();
        assert_eq!(pipeline.source.input, "a: b ! c");
        assert_eq!(pipeline.flow, flockeye_config::Flow::Lossless);
    }
}
