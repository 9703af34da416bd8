//! Arguments that several commands have.

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, ValueEnum};
use flockeye_config::Pipeline;

/// The arguments that choose a configuration.
#[derive(Debug, Clone, Args)]
pub struct Configuration {
    /// The configuration. Without it: pipeline.yaml in this folder if there is one, else the
    /// defaults.
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
    pub flow: Option<FlowChoice>,
    /// Override any key of the configuration.
    #[arg(long = "set", value_name = "KEY.PATH=VALUE")]
    pub set: Vec<String>,
}

/// How frames flow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum FlowChoice {
    /// The newest frame wins.
    Latest,
    /// Every frame is processed.
    Lossless,
}

/// Reads a duration such as `20s`, `5m` or `1h`.
///
/// # Errors
/// What is wrong with it, and how durations are written.
pub fn duration(text: &str) -> Result<Duration, String> {
    humantime::parse_duration(text).map_err(|error| format!("{error}; write 20s, 5m or 1h"))
}

impl Configuration {
    /// Loads the configuration, with the command line's settings on top.
    ///
    /// # Errors
    /// Everything that is wrong with it.
    pub fn load(&self) -> anyhow::Result<Pipeline> {
        self.load_with(&[], &[])
    }

    /// Loads the configuration with more `KEY.PATH=VALUE` settings: the user's override `defaults`,
    /// and `fixed` override the user's.
    ///
    /// # Errors
    /// Everything that is wrong with it.
    pub fn load_with(&self, defaults: &[String], fixed: &[String]) -> anyhow::Result<Pipeline> {
        let overrides = [defaults, &self.overrides(), fixed].concat();
        let here = PathBuf::from("pipeline.yaml");
        let pipeline = match &self.pipeline {
            Some(path) => Pipeline::load(path, &overrides)?,
            None if here.exists() => Pipeline::load(&here, &overrides)?,
            None => Pipeline::parse("", &overrides, "the command line")?,
        };
        Ok(pipeline)
    }

    /// Arguments with which another process loads what [`Configuration::load_with`] loads here.
    pub fn to_arguments(&self, defaults: &[String], fixed: &[String]) -> Vec<OsString> {
        let overrides = [defaults, &self.overrides(), fixed].concat();
        let set = overrides.into_iter().flat_map(|setting| ["--set".into(), setting.into()]);
        let path = self.pipeline.iter().flat_map(|path| ["--".into(), path.into()]);
        set.chain(path).collect()
    }

    /// `--source`, `--bodies` and `--flow` as settings, then those of `--set`.
    fn overrides(&self) -> Vec<String> {
        // JSON strings are YAML: special characters in the text keep no meaning.
        let quoted = |text: &str| serde_json::Value::from(text).to_string();
        let source = self.source.as_ref().map(|source| format!("source.input={}", quoted(source)));
        let bodies = self
            .bodies
            .as_ref()
            .map(|file| format!("bodies.file={}", quoted(&file.to_string_lossy())));
        let flow = self.flow.map(|flow| match flow {
            FlowChoice::Latest => "flow=latest".to_owned(),
            FlowChoice::Lossless => "flow=lossless".to_owned(),
        });
        [source, bodies, flow].into_iter().flatten().chain(self.set.iter().cloned()).collect()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use clap::Parser;

    #[derive(Debug, Parser)]
    struct Program {
        #[command(flatten)]
        configuration: Configuration,
    }

    fn parsed(arguments: &[&str]) -> Configuration {
        Program::parse_from([&["program"], arguments].concat()).configuration
    }

    #[test]
    fn shortcuts_are_overrides() {
        let arguments =
            ["--source", "a: b ! c", "--flow", "lossless", "--set", "search.mode=greedy"];
        let pipeline = parsed(&arguments).load_with(&[], &[]).unwrap();
        assert_eq!(pipeline.source.input, "a: b ! c");
        assert_eq!(pipeline.flow, flockeye_config::Flow::Lossless);
    }

    #[test]
    fn another_process_loads_the_same() {
        let own = parsed(&["--source", "sim", "--set", "simulator.seed=7"]);
        let defaults = ["simulator.seed=3".to_owned(), "simulator.frames=9".to_owned()];
        let fixed = ["instance=other".to_owned()];
        let arguments = own.to_arguments(&defaults, &fixed);
        let arguments: Vec<&str> = arguments.iter().map(|text| text.to_str().unwrap()).collect();
        let pipeline = parsed(&arguments).load().unwrap();
        assert_eq!(pipeline, own.load_with(&defaults, &fixed).unwrap());
        assert_eq!((pipeline.simulator.seed, pipeline.instance.0.as_str()), (7, "other"));
        let named = parsed(&["elsewhere.yaml"]).to_arguments(&[], &[]);
        assert_eq!(named, ["--", "elsewhere.yaml"]);
    }
}
