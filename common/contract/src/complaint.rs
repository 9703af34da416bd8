//! `complaint`: report of one stage about a fault of another.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::{ComplaintKind, ContractError, Text};

/// Header of `complaint`. No payload. The launcher shows the process that it is about, and replaces
/// it after repeated complaints.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/Complaint")]
#[repr(C)]
pub struct Complaint {
    /// Sending time, CLOCK_MONOTONIC, nanoseconds.
    pub sent_ns: i64,
    /// Number of consecutive occurrences.
    pub count: u64,
    /// The stage that it is about; empty where only the process is known.
    pub stage: Text<32>,
    /// The fault in words, for the user.
    pub detail: Text<96>,
    /// Number of the worker in its stage, from 0.
    pub replica: u32,
    /// The process that it is about; 0 where only the stage is known.
    pub pid: u32,
    /// A [`ComplaintKind`].
    pub kind: u32,
    /// Always 0.
    pub reserved: u32,
}

impl Complaint {
    /// Refuses an unknown kind.
    pub fn check(&self) -> Result<(), ContractError> {
        ComplaintKind::try_from(self.kind)?;
        Ok(())
    }
}
