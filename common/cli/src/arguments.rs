//! Arguments that several commands have.

use std::ffi::OsString;
use std::path::PathBuf;
use std::time::Duration;

use clap::Args;
use flockeye_config::{Flow, Pipeline, Profile, says_how_it_runs};

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
    /// How it runs: flight (in real time), repeat (every frame, in the time that flight has),
    /// unlimited (every frame, however long it takes) or stills (every frame for itself).
    #[arg(long, value_name = "NAME", value_parser = Profile::ALL.map(Profile::name))]
    pub profile: Option<String>,
    /// Replaced by --profile: latest is flight, lossless is repeat (or stills with fusion.filter:
    /// none).
    #[arg(long, hide = true, conflicts_with = "profile", value_parser = ["latest", "lossless"])]
    pub flow: Option<String>,
    /// Override any key of the configuration.
    #[arg(long = "set", value_name = "KEY.PATH=VALUE")]
    pub set: Vec<String>,
}

/// Reads a duration such as `20s`, `5m` or `1h`.
///
/// # Errors
/// The fault, and the notation of durations.
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

    /// Loads the configuration with more `KEY.PATH=VALUE` settings. The user's settings override
    /// `defaults`, and `fixed` overrides the user's.
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

    /// Whether the command line selects how the pipeline runs. `--flow lossless` alone leaves open
    /// whether frames are independent.
    pub fn says_profile(&self) -> bool {
        let of_settings = self.set.iter().any(|setting| says_how_it_runs(setting));
        self.profile.is_some() || of_settings || self.flow.as_deref() == Some("latest")
    }

    /// This configuration in a profile that processes every frame. That is its own profile with
    /// `defaults` below it, or `repeat` in place of `flight`.
    ///
    /// # Errors
    /// Everything that is wrong with it.
    pub fn with_every_frame(self, defaults: &[String]) -> anyhow::Result<Self> {
        let said = self.load_with(defaults, &[])?;
        Ok(match said.flow() {
            Flow::Latest => self.in_profile(Profile::Repeat),
            Flow::Lossless => self,
        })
    }

    /// This configuration in `profile`, whatever the command line selects.
    pub fn in_profile(mut self, profile: Profile) -> Self {
        self.set.retain(|setting| !says_how_it_runs(setting));
        Self { profile: Some(profile.name().to_owned()), flow: None, ..self }
    }

    /// Arguments with which another process loads the same configuration as
    /// [`Configuration::load_with`] here.
    pub fn to_arguments(&self, defaults: &[String], fixed: &[String]) -> Vec<OsString> {
        let overrides = [defaults, &self.overrides(), fixed].concat();
        let set = overrides.into_iter().flat_map(|setting| ["--set".into(), setting.into()]);
        let path = self.pipeline.iter().flat_map(|path| ["--".into(), path.into()]);
        set.chain(path).collect()
    }

    /// `--source`, `--bodies`, `--profile` and `--flow` as settings, then those of `--set`.
    fn overrides(&self) -> Vec<String> {
        // A JSON string is YAML, so special characters in the text have no meaning.
        let quoted = |text: &str| serde_json::Value::from(text).to_string();
        let source = self.source.as_ref().map(|source| format!("source.input={}", quoted(source)));
        let bodies = self
            .bodies
            .as_ref()
            .map(|file| format!("bodies.file={}", quoted(&file.to_string_lossy())));
        let profile = self.profile.as_ref().map(|profile| format!("profile={profile}"));
        let flow = self.flow.as_ref().map(|flow| format!("flow={flow}"));
        let shortcuts = [source, bodies, profile, flow].into_iter().flatten();
        shortcuts.chain(self.set.iter().cloned()).collect()
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
            ["--source", "a: b ! c", "--profile", "repeat", "--set", "search.mode=greedy"];
        let pipeline = parsed(&arguments).load_with(&[], &[]).unwrap();
        assert_eq!(pipeline.source.input, "a: b ! c");
        assert_eq!(pipeline.profile, Profile::Repeat);
        assert!(Program::try_parse_from(["program", "--profile", "fast"]).is_err());
    }

    #[test]
    fn the_former_way_to_say_how_it_runs_is_understood() {
        let profile = |arguments: &[&str]| parsed(arguments).load().map(|read| read.profile);
        assert_eq!(profile(&["--flow", "lossless"]).unwrap(), Profile::Repeat);
        let stills = ["--flow", "lossless", "--set", "fusion.filter=none"];
        assert_eq!(profile(&stills).unwrap(), Profile::Stills);
        let both = ["program", "--flow", "lossless", "--profile", "repeat"];
        assert!(Program::try_parse_from(both).is_err());
        let both = ["--flow", "lossless", "--set", "profile=repeat"];
        let refused = profile(&both).unwrap_err().to_string();
        assert!(refused.contains("--set flow=lossless: flow"), "{refused}");
    }

    #[test]
    fn another_profile_replaces_all_that_the_command_line_says_of_it() {
        let stills =
            ["--flow", "lossless", "--set", "fusion.filter=none", "--set", "simulator.seed=7"];
        let own = parsed(&stills);
        assert!(own.says_profile() && !parsed(&["--flow", "lossless"]).says_profile());
        let other = own.in_profile(Profile::Unlimited).load().unwrap();
        assert_eq!((other.profile, other.simulator.seed), (Profile::Unlimited, 7));
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
