//! pipeline.yaml and overrides to a checked [`Pipeline`].

use std::path::Path;

use schemars::JsonSchema;
use serde::de::DeserializeOwned;

use crate::document::Node;
use crate::problem::{ConfigError, Origin, Problem};
use crate::types::{InertialSource, Pipeline, Security};
use crate::{former_keys, meaning, schema};

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
        // A path in an override is relative to the user's working directory.
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
        if let Some(Security { ca, certificate, key, roster }) = &mut pipeline.gateway.security {
            let files =
                [("ca", ca), ("certificate", certificate), ("key", key), ("roster", roster)];
            for (key, file) in files {
                if !is_overridden(&format!("gateway.security.{key}"))
                    && !is_overridden("gateway.security")
                {
                    *file = folder.join(&*file);
                }
            }
        }
        if let Ok(InertialSource::Recorded(file)) = pipeline.inertial.parsed_source()
            && !is_overridden("inertial.source")
        {
            pipeline.inertial.source = folder.join(file).to_string_lossy().into_owned();
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
        let mut problems = Vec::new();
        for assignment in overrides {
            if let Err(problem) = document.set(assignment) {
                problems.push(problem);
            }
        }
        let mut notices = Vec::new();
        former_keys::translate(&mut document, &mut problems, &mut notices);
        former_keys::warn(notices);
        schema::check(&document, json_schema().as_value(), &mut problems);
        if problems.is_empty() {
            match serde_json::from_value::<Self>(document.to_json()) {
                Ok(pipeline) => {
                    meaning::check(&pipeline, &document, &mut problems);
                    if problems.is_empty() {
                        return Ok(pipeline);
                    }
                }
                // The schema is derived from the same types, so the check above missed something.
                // The message is serde's.
                Err(error) => {
                    problems.push(Problem::new(document.origin.clone(), "", error.to_string()))
                }
            }
        }
        Err(refused(problems))
    }
}

impl Pipeline {
    /// Reads the `pipeline.json` of a running instance or of a recording, possibly of an earlier
    /// release. It was checked when it was written, and files that it names may be missing by now.
    ///
    /// # Errors
    /// The file is no configuration of this release, or contains values that this release does not
    /// support.
    pub fn from_json(json: &[u8]) -> Result<Self, ConfigError> {
        let refused = |problem| ConfigError::Problems {
            name: "pipeline.json".to_owned(),
            problems: vec![problem],
        };
        let wrong = |error: serde_json::Error| {
            refused(Problem::new(Origin::File { line: 1, column: 1 }, "", error.to_string()))
        };
        let mut document = Node::from_json(serde_json::from_slice(json).map_err(wrong)?);
        // The derived section serves other readers, and is computed anew here.
        document.take(RESOLVED);
        if document.get("profile").is_some() {
            document.take(FLOW);
        }
        let mut problems = Vec::new();
        // No reader can change a written file, so the notices are dropped.
        former_keys::translate(&mut document, &mut problems, &mut Vec::new());
        match problems.into_iter().next() {
            Some(problem) => Err(refused(problem)),
            None => serde_json::from_value(document.to_json()).map_err(wrong),
        }
    }
}

/// Section of `pipeline.json` with derived values, for stages in other languages.
pub const RESOLVED: &str = "resolved";

/// Key of `pipeline.json` with the flow of frames, for stages in other languages.
pub const FLOW: &str = "flow";

/// Reads another YAML (or JSON) document than pipeline.yaml, with the same checks.
///
/// # Errors
/// [`ConfigError`]: the file cannot be read, or everything that is wrong with it, each with its
/// place.
pub fn read_document<T: DeserializeOwned + JsonSchema>(path: &Path) -> Result<T, ConfigError> {
    let yaml = std::fs::read_to_string(path)
        .map_err(|error| ConfigError::Read { path: path.to_owned(), error })?;
    let refused = |problems| ConfigError::Problems { name: path.display().to_string(), problems };
    let document = Node::parse(&yaml).map_err(|problem| refused(vec![problem]))?;
    let mut problems = Vec::new();
    schema::check(&document, schemars::schema_for!(T).as_value(), &mut problems);
    if !problems.is_empty() {
        return Err(refused(problems));
    }
    serde_json::from_value(document.to_json()).map_err(|error| {
        refused(vec![Problem::new(document.origin.clone(), "", error.to_string())])
    })
}

/// The JSON Schema of pipeline.yaml, for editors.
pub fn json_schema() -> schemars::Schema {
    schemars::schema_for!(Pipeline)
}

#[cfg(test)]
mod tests;
