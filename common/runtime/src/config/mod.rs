//! pipeline.yaml: read, overridden from the command line, checked, typed.
//!
//! Everything that is wrong is reported at once, each problem with its place, what is wrong and
//! what is allowed. The document is checked in two passes: against the JSON Schema of the types in
//! [`pipeline`] (which editors use too, see [`json_schema`]), then for what no schema can say.

mod bodies;
mod camera;
mod document;
mod meaning;
mod partition;
pub mod pipeline;
mod schema;

use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Duration;

pub use bodies::{BodySet, Preset, PresetBody};
pub use camera::*;
pub use document::Origin;
pub use partition::{Auto, Count, Method, Partition};
pub use pipeline::*;

use document::Node;

/// One thing that is wrong with a configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Where it was written.
    pub origin: Origin,
    /// Dotted path of the value; empty for the document as a whole.
    pub path: String,
    /// What is wrong, and what is allowed.
    pub what: String,
}

impl Problem {
    fn new(origin: Origin, path: &str, what: String) -> Self {
        Self { origin, path: path.to_owned(), what }
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let separator = if self.path.is_empty() { "" } else { ": " };
        write!(f, "{}: {}{separator}{}", self.origin, self.path, self.what)
    }
}

/// Everything that is wrong with a configuration.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
struct Problems(Vec<Problem>);

impl Problems {
    fn add(&mut self, problem: Problem) {
        self.0.push(problem);
    }
}

/// Why a configuration was refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read {path}: {error}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        error: std::io::Error,
    },
    /// The document is wrong in these places.
    #[error("{name} has {}:\n{}", count(.problems), list(.problems))]
    Problems {
        /// The file, or what stands for it.
        name: String,
        /// All that is wrong, in the order of the document.
        problems: Vec<Problem>,
    },
}

fn count(problems: &[Problem]) -> String {
    match problems.len() {
        1 => "a problem".to_owned(),
        several => format!("{several} problems"),
    }
}

fn list(problems: &[Problem]) -> String {
    problems.iter().map(|problem| format!("  {problem}")).collect::<Vec<_>>().join("\n")
}

impl Pipeline {
    /// Reads a configuration file, with overrides (`key.path=value`) on top. Relative paths in the
    /// file are relative to it.
    ///
    /// # Errors
    /// [`ConfigError`]: the file cannot be read, or everything that is wrong with it.
    pub fn load(path: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        let yaml = std::fs::read_to_string(path)
            .map_err(|error| ConfigError::Read { path: path.to_owned(), error })?;
        let folder = path.parent().unwrap_or(Path::new(""));
        let mut pipeline = Self::parse(&yaml, overrides, &path.display().to_string())?;
        // An override's path is the user's, relative to where the command was given.
        let is_overridden =
            |key: &str| overrides.iter().any(|text| text.starts_with(&format!("{key}=")));
        let dictionary = folder.join(&pipeline.bodies.dictionary);
        if !is_overridden("bodies.dictionary") && dictionary.is_file() {
            pipeline.bodies.dictionary = dictionary.to_string_lossy().into_owned();
        }
        let mut files = vec![
            ("bodies.file".to_owned(), &mut pipeline.bodies.file),
            ("simulator.bodies".to_owned(), &mut pipeline.simulator.bodies),
            ("camera.mask".to_owned(), &mut pipeline.camera.mask),
        ];
        let list = pipeline.bodies.list.iter_mut().enumerate();
        files.extend(list.map(|(k, body)| (format!("bodies.list.{k}.file"), &mut body.file)));
        for (key, file) in files {
            if let Some(file) = file.as_mut().filter(|_| !is_overridden(&key)) {
                *file = folder.join(&*file);
            }
        }
        Ok(pipeline)
    }

    /// Reads a configuration from text; `name` stands for it in messages.
    ///
    /// # Errors
    /// Everything that is wrong with it.
    pub fn parse(yaml: &str, overrides: &[String], name: &str) -> Result<Self, ConfigError> {
        let refused = |problems| ConfigError::Problems { name: name.to_owned(), problems };
        let mut document = Node::parse(yaml).map_err(|problem| refused(vec![problem]))?;
        let mut problems = Problems::default();
        for assignment in overrides {
            if let Err(problem) = document.set(assignment) {
                problems.add(problem);
            }
        }
        schema::check(&document, json_schema().as_value(), &mut problems);
        if problems.0.is_empty() {
            match serde_json::from_value::<Self>(document.to_json()) {
                Ok(pipeline) => {
                    meaning::check(&pipeline, &document, &mut problems);
                    if problems.0.is_empty() {
                        return Ok(pipeline);
                    }
                }
                // The schema is made from the same types, so this is a gap in the check above; the
                // message still says what serde found.
                Err(error) => {
                    problems.add(Problem::new(document.origin.clone(), "", error.to_string()))
                }
            }
        }
        Err(refused(problems.0))
    }
}

impl Pipeline {
    /// How many processes search views.
    pub fn detection_workers(&self) -> u32 {
        self.stages.detection.replicas.unwrap_or(2)
    }

    /// Whether each neighbour is looked at where it is predicted, and the sphere is swept in the time
    /// that is left: `search.mode: gaze`. Without tracks there is nothing to predict, and it means
    /// `exhaustive`.
    pub fn gazes(&self) -> bool {
        self.search.mode == Mode::Gaze && self.fusion.filter != Filter::None
    }

    /// Whether the sweep searches a partition with one of its windows at a time. Not in a lossless run,
    /// which must not depend on which worker searches.
    pub fn sweeps_by_turns(&self) -> bool {
        self.gazes() && self.flow == Flow::Latest
    }

    /// How long a frame is waited for: `fusion.deadline_ms`.
    pub fn frame_deadline(&self) -> Duration {
        Duration::from_secs_f64(self.fusion.deadline_ms * 1e-3 * self.patience())
    }

    /// After how long a worker's silence its views are given to another: `rectification.overdue_ms`.
    pub fn view_overdue(&self) -> Duration {
        Duration::from_secs_f64(self.rectification.overdue_ms * 1e-3 * self.patience())
    }

    /// Where each frame stands for itself and none may be lost, nothing is late, and all views are
    /// magnified: ten times as long.
    fn patience(&self) -> f64 {
        match (self.flow, self.fusion.filter) {
            (Flow::Lossless, Filter::None) => 10.0,
            _ => 1.0,
        }
    }

    /// Name of the stage that `source.input` needs.
    pub fn source_stage(&self) -> &'static str {
        if self.source.input == "sim" { "simulator" } else { "capture" }
    }
}

/// The JSON Schema of pipeline.yaml, for editors.
pub fn json_schema() -> schemars::Schema {
    schemars::schema_for!(Pipeline)
}

#[cfg(test)]
mod tests;
