//! The pipeline's configuration for stages in C. C has no JSON parser of its own.

use std::collections::BTreeMap;
use std::ffi::{CStr, CString};
use std::path::Path;

use anyhow::Context;
use flockeye_runtime::instance::FOLDER_VARIABLE;
use serde_json::Value;

/// The configuration of the instance, from its `pipeline.json`, and its bodies.
pub(crate) struct StageConfiguration {
    pub(crate) json: CString,
    values: Value,
    /// The dictionary of all markers, by OpenCV's name or as a file.
    pub(crate) dictionary: CString,
    /// Names of the bodies by their target numbers.
    names: Vec<CString>,
    /// Target numbers by the ids of markers.
    targets: BTreeMap<u32, u32>,
}

impl StageConfiguration {
    /// Reads the configuration of the instance that the launcher's environment names.
    pub(crate) fn read(context: &flockeye_runtime::Context) -> anyhow::Result<Self> {
        let folder = std::env::var_os(FOLDER_VARIABLE).unwrap_or_default();
        let file = Path::new(&folder).join("pipeline.json");
        let cannot = || format!("cannot read {}", file.display());
        let json = std::fs::read(&file).with_context(cannot)?;
        let values = serde_json::from_slice(&json).with_context(cannot)?;
        let bodies = &context.resolved.bodies;
        let names = bodies.iter().map(|body| CString::new(body.name.as_str()));
        let targets = bodies
            .iter()
            .zip(0..)
            .flat_map(|(body, target)| body.markers.iter().map(move |marker| (marker.id, target)));
        Ok(Self {
            json: CString::new(json).context("pipeline.json")?,
            values,
            dictionary: CString::new(bodies.dictionary.as_str())
                .context("the dictionary's name")?,
            names: names.collect::<Result<_, _>>().context("a body's name")?,
            targets: targets.collect(),
        })
    }

    /// The target number of the body that has this marker.
    pub(crate) fn target_of(&self, marker: u32) -> Option<u32> {
        self.targets.get(&marker).copied()
    }

    /// The name of the body with this target number.
    pub(crate) fn name_of(&self, target: u32) -> Option<&CStr> {
        self.names.get(target as usize).map(CString::as_c_str)
    }

    fn value(&self, pointer: &str) -> anyhow::Result<&Value> {
        self.values.pointer(pointer).with_context(|| {
            format!("the configuration has no {pointer}. Cure: look for it in pipeline.json")
        })
    }

    /// The numbers at a JSON pointer. A single number gives a list with one entry.
    pub(crate) fn numbers(&self, pointer: &str) -> anyhow::Result<Vec<f64>> {
        let value = self.value(pointer)?;
        let entries = value.as_array().map_or(std::slice::from_ref(value), Vec::as_slice);
        let numbers: Option<_> = entries.iter().map(Value::as_f64).collect();
        numbers.with_context(|| format!("{pointer} is {value}, which is not made of numbers"))
    }

    /// The text at a JSON pointer.
    pub(crate) fn text(&self, pointer: &str) -> anyhow::Result<&str> {
        let value = self.value(pointer)?;
        value.as_str().with_context(|| format!("{pointer} is {value}, which is no text"))
    }

    /// The length of the list at a JSON pointer.
    pub(crate) fn count(&self, pointer: &str) -> anyhow::Result<usize> {
        let value = self.value(pointer)?;
        let list = value.as_array().with_context(|| format!("{pointer} is not a list"))?;
        Ok(list.len())
    }
}
