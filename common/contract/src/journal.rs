//! `journal`: inputs of fusion's core, with their order and times.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::error::check_count;
use crate::{ContractError, FrameOrder, JournalKind};

/// Maximum number of entries in one message; longer journals are refused.
pub const MAX_JOURNAL_ENTRIES: usize = 64;

/// Header of `journal`. Payload: its [`JournalEntry`]s, in the order in which the core of fusion
/// worked through them.
///
/// Fusion writes it only while there is a subscriber. Entries before the first message of another
/// stage are kept for the first reader.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/JournalHeader")]
#[repr(C)]
pub struct JournalHeader {
    /// Number of earlier entries of this process, written or not.
    pub first: u64,
    /// Messages of this process, counted from 0.
    pub sequence: u64,
    /// Rises each time fusion's process is replaced.
    pub generation: u32,
    /// 1 if the process continued the work of another one.
    pub is_resumed: u32,
}

/// One event in fusion's core. Fields that do not belong to its kind are 0.
#[derive(
    Debug,
    Clone,
    Copy,
    Default,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Pod,
    Zeroable,
    ZeroCopySend,
    Described,
)]
#[type_name("flockeye/JournalEntry")]
#[repr(C)]
pub struct JournalEntry {
    /// Time used for the event, CLOCK_MONOTONIC, nanoseconds. For `said`: the time of writing the
    /// messages.
    pub at_ns: i64,
    /// `stamp.sequence` of the frame of a received message.
    pub sequence: u64,
    /// `stamp.epoch` of its frame.
    pub epoch: u32,
    /// `stamp.source_generation` of its frame.
    pub source_generation: u32,
    /// A [`JournalKind`].
    pub kind: u32,
    /// The message's own `generation`.
    pub generation: u32,
    /// `view_generation` of a detection record.
    pub view_generation: u32,
    /// `view_index` of a view or a record.
    pub view_index: u32,
    /// `attempt` of a view or a record.
    pub attempt: u32,
    /// `worker` of a view or a record.
    pub worker: u32,
    /// Number of `track` messages, of `said`.
    pub tracks: u32,
    /// Number of plans, of `said`.
    pub plans: u32,
}

impl JournalEntry {
    /// Frame of the received message.
    pub fn order(&self) -> FrameOrder {
        (self.source_generation, self.epoch, self.sequence)
    }
}

impl JournalHeader {
    /// Refuses too many entries, and entries of unknown kinds.
    ///
    /// # Errors
    /// The first violation found.
    pub fn check(&self, entries: &[JournalEntry]) -> Result<(), ContractError> {
        check_count("entries of a journal", entries.len(), MAX_JOURNAL_ENTRIES)?;
        if self.is_resumed > 1 {
            return Err(ContractError::NotFinite { what: "is_resumed" });
        }
        entries.iter().try_for_each(|entry| JournalKind::try_from(entry.kind).map(|_| ()))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used)]
    use super::*;
    use crate::{Journals, Topic};

    #[test]
    fn journals_that_are_none_are_refused() {
        let header = JournalHeader::default();
        let entry = JournalEntry { kind: JournalKind::Said.code(), ..JournalEntry::default() };
        assert_eq!(Journals::check(&header, &[entry; MAX_JOURNAL_ENTRIES]), Ok(()));
        let refused = |header: &JournalHeader, entries: &[JournalEntry]| {
            Journals::check(header, entries).expect_err("it is wrong").to_string()
        };
        let many = [entry; MAX_JOURNAL_ENTRIES + 1];
        assert!(refused(&header, &many).contains("65 entries of a journal (at most 64"));
        let strange = JournalEntry { kind: 77, ..entry };
        assert!(refused(&header, &[entry, strange]).contains("unknown journal kind code 77"));
        let doubtful = JournalHeader { is_resumed: 2, ..header };
        assert!(refused(&doubtful, &[]).contains("is_resumed"));
    }
}
