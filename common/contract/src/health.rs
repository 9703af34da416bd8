//! `health`: each stage's state and counters, sent by the stage's own loop.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::{ContractError, StageState, Text};

/// Header of `health`. No payload. A hung stage sends nothing, so silence means a fault.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/Health")]
#[repr(C)]
pub struct Health {
    /// Sending time, CLOCK_MONOTONIC, nanoseconds.
    pub sent_ns: i64,
    /// Messages taken since the process started.
    pub taken: u64,
    /// Messages published.
    pub published: u64,
    /// Messages that a newer one replaced, or that were abandoned.
    pub dropped: u64,
    /// Messages that were refused or could not be processed.
    pub failed: u64,
    /// Messages in work: open frames, views in flight.
    pub queued: u64,
    /// Processor time used by the process, nanoseconds.
    pub processor_ns: u64,
    /// Resident memory of the process, bytes, shared memory included.
    pub resident_bytes: u64,
    /// Median of the stage's latency since the last report, nanoseconds; -1: nothing was done.
    pub latency_median_ns: i64,
    /// 99 % quantile of that latency.
    pub latency_p99_ns: i64,
    /// The stage's name in pipeline.yaml.
    pub stage: Text<32>,
    /// Device or component that it works with, in words (the graphics adapter, the stream).
    pub detail: Text<96>,
    /// Number of the worker in its stage, from 0.
    pub replica: u32,
    /// Rises each time the process is replaced.
    pub generation: u32,
    /// Number of the process.
    pub pid: u32,
    /// A [`StageState`].
    pub state: u32,
}

impl Health {
    /// Refuses an unknown state.
    pub fn check(&self) -> Result<(), ContractError> {
        StageState::try_from(self.state)?;
        Ok(())
    }
}
