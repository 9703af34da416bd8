//! C functions that read values from the configuration of a stage.

use std::ffi::{CStr, CString, c_char, c_int};

use anyhow::{Context, ensure};
use flockeye_contract::NONE;

use crate::configuration::StageConfiguration;
use crate::failure::{self, OK};
use crate::stage::{FlockeyeStage, known, text_of};

/// # Safety
/// `stage` is open.
unsafe fn configuration<'a>(stage: *const FlockeyeStage) -> &'a StageConfiguration {
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
        // SAFETY: the caller's promise; the number of values found is `count`.
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
        // SAFETY: the caller's promise; the size was checked above.
        unsafe { std::ptr::copy_nonoverlapping(found.as_ptr(), text, bytes.len()) };
        Ok(OK)
    };
    failure::code(copy())
}

/// The length of a list of the configuration; see `stage.h`.
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
    unsafe { configuration(stage) }.target_of(id).is_some()
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
    unsafe { configuration(stage) }.target_of(id).unwrap_or(NONE)
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
    let name = unsafe { configuration(stage) }.name_of(target);
    name.map_or(std::ptr::null(), CStr::as_ptr)
}
