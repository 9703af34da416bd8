//! `journal`: what fusion's core heard, in which order and when.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::error::check_count;
use crate::{ContractError, FrameOrder, JournalKind};

/// Journals with more entries than this in one message are refused.
pub const MAX_JOURNAL_ENTRIES: usize = 64;

/// Header of `journal`. Payload: its [`JournalEntry`]s, in the order in which the core of fusion worked through them.
///
/// Fusion writes it only while somebody reads it. What comes before the first message of another stage is kept for
/// the first reader.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/JournalHeader")]
#[repr(C)]
pub struct JournalHeader {
    /// How many entries this process had before these, written or not.
    pub first: u64,
    /// Messages of this process, counted from 0.
    pub sequence: u64,
    /// Rises each time fusion's process is replaced.
    pub generation: u32,
    /// 1 if the process went on where another one was.
    pub is_resumed: u32,
}

/// One thing that happened to fusion's core. Fields that do not belong to its kind are 0.
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
    /// The time that counted for it, CLOCK_MONOTONIC, nanoseconds; of `said`: when the messages were written.
    pub at_ns: i64,
    /// Of a message that was heard: `stamp.sequence` of its frame.
    pub sequence: u64,
    /// `stamp.epoch` of its frame.
    pub epoch: u32,
    /// `stamp.source_generation` of its frame.
    pub source_generation: u32,
    /// A [`JournalKind`].
    pub kind: u32,
    /// The message's own `generation`.
    pub generation: u32,
    /// Of a detection record: its `view_generation`.
    pub view_generation: u32,
    /// Of a view or a record: its `view_index`.
    pub view_index: u32,
    /// Of a view or a record: its `attempt`.
    pub attempt: u32,
    /// Of a view or a record: its `worker`.
    pub worker: u32,
    /// Of `said`: how many messages of `track`.
    pub tracks: u32,
    /// Of `said`: how many plans.
    pub plans: u32,
}

impl JournalEntry {
    /// The frame of the message that was heard.
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
