//! A stage: joining the pipeline, the loop, health messages and the end.

use std::cell::Cell;
use std::ffi::{CStr, c_char, c_int, c_void};
use std::rc::Rc;

use anyhow::{Context, anyhow, bail, ensure};
use flockeye_contract::{DetectionHeader, StageName, StageState, ViewHeader};
use flockeye_runtime::health::{Identity, SharedCounters};
use flockeye_runtime::listening::Listening;
use flockeye_runtime::logs::{self, Throttle};
use flockeye_runtime::ports::Ports;
use flockeye_runtime::stage::StageRuntime;
use flockeye_runtime::{Step, clock};

use crate::configuration::StageConfiguration;
use crate::failure::{self, OK};

/// A function that handles the waiting messages. A return value other than 0 ends the stage with an
/// error.
pub type StepFunction = unsafe extern "C" fn(context: *mut c_void) -> c_int;

/// A stage that has joined its pipeline. One thread uses it.
pub struct FlockeyeStage {
    // Two fields, because they are borrowed separately: the loop borrows `process` mutably while a
    // step reads `known`.
    process: StageRuntime,
    known: Known,
}

/// The state that a step may read.
pub(crate) struct Known {
    pub(crate) configuration: StageConfiguration,
    identity: Identity,
    counters: SharedCounters,
    listening: Rc<Listening>,
    refusals: std::cell::RefCell<Throttle>,
    wake_within_ns: Cell<Option<i64>>,
    is_running: Cell<bool>,
}

impl FlockeyeStage {
    fn join(name: &str) -> anyhow::Result<Self> {
        logs::init();
        let process = StageRuntime::join(name)?;
        let context = &process.context;
        let known = Known {
            configuration: StageConfiguration::read(context)?,
            identity: context.identity.clone(),
            counters: context.counters.clone(),
            listening: process.ports.listening(),
            refusals: Default::default(),
            wake_within_ns: Cell::new(None),
            is_running: Cell::new(false),
        };
        Ok(Self { process, known })
    }

    /// # Safety
    /// `stage` is open, and only this thread uses it.
    pub(crate) unsafe fn ports<'a>(stage: *mut Self) -> anyhow::Result<&'a mut Ports> {
        // SAFETY: the caller's promise.
        let is_running = unsafe { known(stage) }.is_running.get();
        ensure!(!is_running, "ports are opened before `flockeye_stage_run`, not in a step");
        // SAFETY: the caller's promise; the loop does not run, so `process` is not borrowed.
        Ok(unsafe { &mut (*stage).process.ports })
    }
}

/// # Safety
/// `stage` is open.
pub(crate) unsafe fn known<'a>(stage: *const FlockeyeStage) -> &'a Known {
    // SAFETY: the caller's promise. This field alone is borrowed, and never mutably.
    unsafe { &(*stage).known }
}

/// # Safety
/// `text` is null or a string that ends with a zero.
pub(crate) unsafe fn text_of<'a>(text: *const c_char) -> anyhow::Result<&'a str> {
    ensure!(!text.is_null(), "a string is missing");
    // SAFETY: the caller's promise.
    unsafe { CStr::from_ptr(text) }.to_str().context("a string is not UTF-8")
}

/// Joins the pipeline; see `stage.h`.
///
/// # Safety
/// `name` is a string.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_open(name: *const c_char) -> *mut FlockeyeStage {
    // SAFETY: the caller's promise.
    failure::handle(unsafe { text_of(name) }.and_then(FlockeyeStage::join))
}

/// Leaves the pipeline; see `stage.h`.
///
/// # Safety
/// `stage` is null or open, and neither it nor a port of it is used any more.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_close(stage: *mut FlockeyeStage) {
    if !stage.is_null() {
        // SAFETY: the caller's promise; the pointer is from `flockeye_stage_open`.
        drop(unsafe { Box::from_raw(stage) });
    }
}

/// The number of this worker among the workers of the stage, from 0.
///
/// # Safety
/// `stage` is open.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_replica(stage: *const FlockeyeStage) -> u32 {
    // SAFETY: the caller's promise.
    unsafe { known(stage) }.identity.replica
}

/// The number of times that the worker's process was replaced.
///
/// # Safety
/// `stage` is open.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_generation(stage: *const FlockeyeStage) -> u32 {
    // SAFETY: the caller's promise.
    unsafe { known(stage) }.identity.generation
}

/// Runs the stage's loop until SIGTERM; see `stage.h`.
///
/// # Safety
/// `stage` is open, `detail` is a string, and `step` may be called with `context`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_run(
    stage: *mut FlockeyeStage,
    detail: *const c_char,
    step: Option<StepFunction>,
    context: *mut c_void,
) -> c_int {
    // SAFETY: the caller's promise.
    failure::code(unsafe { run(stage, detail, step, context) }.map(|()| OK))
}

/// # Safety
/// As [`flockeye_stage_run`].
unsafe fn run(
    stage: *mut FlockeyeStage,
    detail: *const c_char,
    step: Option<StepFunction>,
    context: *mut c_void,
) -> anyhow::Result<()> {
    let step = step.ok_or_else(|| anyhow!("a step function is missing"))?;
    // SAFETY: the caller's promise.
    let (known, detail) = unsafe { (known(stage), text_of(detail)?) };
    ensure!(!known.is_running.replace(true), "the stage runs already");
    known.counters.set_detail(detail);
    // SAFETY: the caller's promise. Until the loop ends, steps read only `known`.
    let process = unsafe { &mut (*stage).process };
    let outcome = process.report(StageState::Ready).and_then(|()| {
        process.serve(|| {
            known.wake_within_ns.set(None);
            failure::forget();
            // SAFETY: the caller's promise.
            match (unsafe { step(context) }, failure::last()) {
                (OK, _) => {}
                (status, reason) if reason.is_empty() => bail!("a step has ended with {status}"),
                (status, reason) => bail!("a step has ended with {status}: {reason}"),
            }
            let wake = known.wake_within_ns.get();
            Ok(wake.map_or(Step::Wait, |ns| Step::WaitUntil(clock::monotonic_ns() + ns)))
        })?;
        process.report(StageState::Draining)
    });
    known.is_running.set(false);
    outcome
}

/// Requests the next step within `ns` nanoseconds.
///
/// # Safety
/// `stage` is open.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_wake_within(stage: *const FlockeyeStage, ns: i64) {
    // SAFETY: the caller's promise.
    unsafe { known(stage) }.wake_within_ns.set(Some(ns.clamp(0, 1_000_000_000)));
}

/// Counts an invalid message or input, and logs it; see `stage.h`.
///
/// # Safety
/// `stage` is open, and `what` is a string.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_refuse(stage: *const FlockeyeStage, what: *const c_char) {
    // SAFETY: the caller's promise.
    let (known, what) = unsafe { (known(stage), text_of(what).unwrap_or("no reason given")) };
    known.counters.add_failed(1);
    if let Some(more) = known.refusals.borrow_mut().admit() {
        tracing::warn!(more_since = more, "refused: {what}");
    }
}

/// Reports a detection worker that has not answered in time; see `stage.h`.
///
/// # Safety
/// `stage` is open, and `detail` is a string.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_stage_complain(
    stage: *const FlockeyeStage,
    worker: u32,
    count: u64,
    detail: *const c_char,
) {
    // SAFETY: the caller's promise.
    let (known, detail) = unsafe { (known(stage), text_of(detail).unwrap_or_default()) };
    known.listening.complain_of_silence(StageName::Detection, worker, count, detail);
}

/// The header of the detection record for a view; see `stage.h`.
///
/// # Safety
/// `stage` is open, `view` is a view's header, and `answer` can be written.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn flockeye_answer(
    stage: *const FlockeyeStage,
    view: *const ViewHeader,
    received_ns: i64,
    answer: *mut DetectionHeader,
) {
    // SAFETY: the caller's promise.
    let (identity, view) = unsafe { (&known(stage).identity, view.read_unaligned()) };
    let header = DetectionHeader {
        received_ns,
        sent_ns: clock::monotonic_ns(),
        generation: identity.generation,
        worker: identity.replica,
        ..DetectionHeader::answering(&view)
    };
    // SAFETY: the caller's promise.
    unsafe { answer.write_unaligned(header) };
}

/// CLOCK_MONOTONIC, nanoseconds: the clock of all messages.
#[unsafe(no_mangle)]
pub extern "C" fn flockeye_now_ns() -> i64 {
    clock::monotonic_ns()
}
