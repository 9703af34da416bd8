//! What the pipeline's configuration says, for C, which has no JSON of its own.

use std::collections::BTreeMap;
use std::ffi::{CString, c_char, c_int};
use std::path::Path;

use anyhow::{Context, ensure};
use flockeye_contract::NONE;
use flockeye_runtime::instance::FOLDER_VARIABLE;
use serde_json::Value;

use crate::failure::{self, OK};
use crate::stage::{FlockeyeStage, known, text_of};

/// The configuration as the instance's `pipeline.json` has it, and its bodies.
pub(crate) struct Configuration {
    json: CString,
    values: Value,
    dictionary: CString,
    /// Names of the bodies by their target numbers.
    names: Vec<CString>,
    /// Target numbers by the ids of markers.
    targets: BTreeMap<u32, u32>,
}

impl Configuration {
    /// Reads that of the instance that the launcher's environment names.
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

    fn value(&self, pointer: &str) -> anyhow::Result<&Value> {
        self.values.pointer(pointer).with_context(|| {
            format!("the configuration has no {pointer}. Cure: look for it in pipeline.json")
        })
    }

    /// One number, or all of a list.
    fn numbers(&self, pointer: &str) -> anyhow::Result<Vec<f64>> {
        let value = self.value(pointer)?;
        let entries = value.as_array().map_or(std::slice::from_ref(value), Vec::as_slice);
        let numbers: Option<_> = entries.iter().map(Value::as_f64).collect();
        numbers.with_context(|| format!("{pointer} is {value}, which is not made of numbers"))
    }

    fn text(&self, pointer: &str) -> anyhow::Result<&str> {
        let value = self.value(pointer)?;
        value.as_str().with_context(|| format!("{pointer} is {value}, which is no text"))
    }

    fn count(&self, pointer: &str) -> anyhow::Result<usize> {
        let value = self.value(pointer)?;
        let list = value.as_array().with_context(|| format!("{pointer} is not a list"))?;
        Ok(list.len())
    }
}

/// # Safety
/// `stage` is open.
unsafe fn configuration<'a>(stage: *const FlockeyeStage) -> &'a Configuration {
    // SAFETY: the caller's promise.
    &unsafe { known(stage) }.configuration
}

/// The configuration, as JSON; see `stage.h`.
///
/// # Safety
/// `stage` is open.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_pipeline(stage: *const FlockeyeStage) -> *const c_char {
    // SAFETY: the caller's promise.
    unsafe { configuration(stage) }.json.as_ptr()
}

/// Numbers of the configuration; see `stage.h`.
///
/// # Safety
/// `stage` is open, `pointer` is a string, and `numbers` has room for `count`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_numbers(
    stage: *const FlockeyeStage,
    pointer: *const c_char,
    numbers: *mut f64,
    count: usize,
) -> c_int {
    let copy = || {
        // SAFETY: the caller's promise.
        let (configuration, pointer) = unsafe { (configuration(stage), text_of(pointer)?) };
        let found = configuration.numbers(pointer)?;
        ensure!(found.len() == count, "{pointer} has {} numbers, not {count}", found.len());
        // SAFETY: the caller's promise; so many were found.
        unsafe { std::ptr::copy_nonoverlapping(found.as_ptr(), numbers, count) };
        Ok(OK)
    };
    failure::code(copy())
}

/// A text of the configuration; see `stage.h`.
///
/// # Safety
/// `stage` is open, `pointer` is a string, and `text` has room for `room` bytes.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_text(
    stage: *const FlockeyeStage,
    pointer: *const c_char,
    text: *mut c_char,
    room: usize,
) -> c_int {
    let copy = || {
        // SAFETY: the caller's promise.
        let (configuration, pointer) = unsafe { (configuration(stage), text_of(pointer)?) };
        let found = CString::new(configuration.text(pointer)?).context("a text with a zero")?;
        let bytes = found.as_bytes_with_nul();
        ensure!(bytes.len() <= room, "{pointer} takes {} bytes, not {room}", bytes.len());
        // SAFETY: the caller's promise; there is room for so many.
        unsafe { std::ptr::copy_nonoverlapping(found.as_ptr(), text, bytes.len()) };
        Ok(OK)
    };
    failure::code(copy())
}

/// How long a list of the configuration is; see `stage.h`.
///
/// # Safety
/// `stage` is open, `pointer` is a string, and `count` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_count(
    stage: *const FlockeyeStage,
    pointer: *const c_char,
    count: *mut usize,
) -> c_int {
    // SAFETY: the caller's promise.
    let pointer = unsafe { text_of(pointer) };
    // SAFETY: the caller's promise.
    let found = pointer.and_then(|pointer| unsafe { configuration(stage) }.count(pointer));
    failure::code(found.map(|found| {
        // SAFETY: the caller's promise.
        unsafe { count.write(found) };
        OK
    }))
}

/// The dictionary of all markers, by OpenCV's name or as a file.
///
/// # Safety
/// `stage` is open.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_dictionary(stage: *const FlockeyeStage) -> *const c_char {
    // SAFETY: the caller's promise.
    unsafe { configuration(stage) }.dictionary.as_ptr()
}

/// Whether a configured body has this marker.
///
/// # Safety
/// `stage` is open.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_owns_marker(stage: *const FlockeyeStage, id: u32) -> bool {
    // SAFETY: the caller's promise.
    unsafe { configuration(stage) }.targets.contains_key(&id)
}

/// The target number of the body that has this marker; `FLOCKEYE_NONE` if none has.
///
/// # Safety
/// `stage` is open.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_target_of_marker(
    stage: *const FlockeyeStage,
    id: u32,
) -> u32 {
    // SAFETY: the caller's promise.
    unsafe { configuration(stage) }.targets.get(&id).copied().unwrap_or(NONE)
}

/// The name of the body with this target number; null if there is none.
///
/// # Safety
/// `stage` is open.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_target_name(
    stage: *const FlockeyeStage,
    target: u32,
) -> *const c_char {
    // SAFETY: the caller's promise.
    let name = unsafe { configuration(stage) }.names.get(target as usize);
    name.map_or(std::ptr::null(), |name| name.as_ptr())
}
