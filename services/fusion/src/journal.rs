//! Journal of the core's inputs and outputs, so that a flight can be repeated from a recording.
//!
//! The core's output is a function of its inputs, their order and their times. The core itself
//! records each call, so none can be left out. A step without work changes nothing, and is not
//! recorded.

use std::collections::VecDeque;

use flockeye_contract::{
    FrameStamp, JournalEntry, JournalHeader, JournalKind, MAX_JOURNAL_ENTRIES,
};

use crate::core::events::Event;

/// Kind of an event in a journal.
pub fn entry_of<P>(event: &Event<P>, at_ns: i64) -> JournalEntry {
    let of = |kind: JournalKind, stamp: &FrameStamp, generation: u32| JournalEntry {
        at_ns,
        sequence: stamp.sequence,
        epoch: stamp.epoch,
        source_generation: stamp.source_generation,
        kind: kind.code(),
        generation,
        ..JournalEntry::default()
    };
    match event {
        Event::View(view, _) => JournalEntry {
            view_index: view.view_index,
            attempt: view.attempt,
            worker: view.worker,
            ..of(JournalKind::View, &view.stamp, view.generation)
        },
        Event::Searched(record) => JournalEntry {
            view_generation: record.header.view_generation,
            view_index: record.header.view_index,
            attempt: record.header.attempt,
            worker: record.header.worker,
            ..of(JournalKind::Searched, &record.header.stamp, record.header.generation)
        },
        Event::FrameEnd(end) => of(JournalKind::FrameEnd, &end.stamp, end.generation),
        Event::Rotation(turn) => of(JournalKind::Rotation, &turn.stamp, turn.generation),
        Event::Background(_) => {
            JournalEntry { at_ns, kind: JournalKind::Background.code(), ..JournalEntry::default() }
        }
    }
}

/// Entries that wait to be sent, while there is a reader.
#[derive(Debug, Default)]
pub struct Journal {
    generation: u32,
    is_resumed: bool,
    /// Whether there is a reader.
    is_read: bool,
    /// Whether the core has received anything from another stage. Earlier entries are kept for the
    /// first reader.
    has_heard: bool,
    /// All entries so far, kept or not.
    count: u64,
    /// The last of them.
    waiting: VecDeque<JournalEntry>,
    messages: u64,
}

impl Journal {
    /// Creates the journal of a process of this generation. `is_resumed`: it continues another
    /// process.
    pub fn new(generation: u32, is_resumed: bool) -> Self {
        Self { generation, is_resumed, ..Self::default() }
    }

    /// Sets whether there is a reader.
    pub fn listen(&mut self, is_read: bool) {
        self.is_read = is_read;
    }

    /// The next message for a reader: when it is full, or when the core is idle.
    pub fn take(&mut self, is_idle: bool) -> Option<(JournalHeader, Vec<JournalEntry>)> {
        let is_due = is_idle || self.waiting.len() >= MAX_JOURNAL_ENTRIES;
        if !self.is_read || !is_due || self.waiting.is_empty() {
            return None;
        }
        let header = JournalHeader {
            first: self.count - self.waiting.len() as u64,
            sequence: self.messages,
            generation: self.generation,
            is_resumed: u32::from(self.is_resumed),
        };
        self.messages += 1;
        let most = self.waiting.len().min(MAX_JOURNAL_ENTRIES);
        Some((header, self.waiting.drain(..most).collect()))
    }

    fn note(&mut self, entry: impl FnOnce() -> JournalEntry) {
        self.count += 1;
        let is_beginning = !self.has_heard && self.waiting.len() < MAX_JOURNAL_ENTRIES;
        if self.is_read || is_beginning {
            self.waiting.push_back(entry());
        } else {
            // The entries of a reader must be without gaps.
            self.has_heard = true;
            self.waiting.clear();
        }
    }

    pub(crate) fn note_event<P>(&mut self, event: &Event<P>, at_ns: i64) {
        self.has_heard = true;
        self.note(|| entry_of(event, at_ns));
    }

    pub(crate) fn note_work(
        &mut self,
        kind: JournalKind,
        at_ns: i64,
        (tracks, plans): (usize, usize),
    ) {
        self.note(|| JournalEntry {
            at_ns,
            kind: kind.code(),
            tracks: tracks as u32,
            plans: plans as u32,
            ..JournalEntry::default()
        });
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::fixtures::{empty_record, stamp};
    use flockeye_contract::FrameEnd;

    fn end(sequence: u64) -> Event<Vec<u8>> {
        Event::FrameEnd(FrameEnd { stamp: stamp(sequence), ..FrameEnd::default() })
    }

    #[test]
    fn what_comes_before_the_first_message_is_kept_for_the_first_reader() {
        let mut journal = Journal::new(3, true);
        journal.note_work(JournalKind::Step, 5, (0, 0));
        journal.note_work(JournalKind::Said, 6, (0, 1));
        assert_eq!(journal.take(true), None, "nobody reads");
        journal.listen(true);
        journal.note_event(&end(0), 7);
        assert_eq!(journal.take(false), None, "more may come at once");
        let (header, entries) = journal.take(true).unwrap();
        assert_eq!((header.first, header.sequence), (0, 0));
        assert_eq!((header.generation, header.is_resumed), (3, 1));
        let seen: Vec<_> = entries.iter().map(|entry| (entry.kind, entry.at_ns)).collect();
        let kinds = [JournalKind::Step, JournalKind::Said, JournalKind::FrameEnd];
        let kinds = kinds.map(JournalKind::code);
        assert_eq!(seen, [(kinds[0], 5), (kinds[1], 6), (kinds[2], 7)]);
        assert_eq!((entries[1].tracks, entries[1].plans), (0, 1));
        assert_eq!(journal.take(true), None);
    }

    #[test]
    fn what_nobody_reads_is_counted_and_not_kept() {
        let mut journal = Journal::new(0, false);
        journal.note_work(JournalKind::Step, 0, (0, 0));
        for sequence in 0..100 {
            journal.note_event(&end(sequence), 0);
            assert!(journal.waiting.is_empty());
        }
        journal.listen(true);
        journal.note_event(&end(100), 0);
        let (header, entries) = journal.take(true).unwrap();
        assert_eq!((header.first, header.sequence), (101, 0));
        assert_eq!(entries[0].order(), stamp(100).order());
        // A beginning without end is not kept either.
        let mut journal = Journal::new(0, false);
        for _ in 0..=MAX_JOURNAL_ENTRIES {
            journal.note_work(JournalKind::Step, 0, (0, 0));
        }
        assert!(journal.waiting.is_empty());
        // Nor what was not sent to a reader who has gone.
        journal.listen(true);
        journal.note_event(&end(0), 0);
        journal.listen(false);
        journal.note_event(&end(1), 0);
        journal.listen(true);
        assert_eq!(journal.take(true), None);
    }

    #[test]
    fn many_entries_are_more_than_one_message() {
        let mut journal = Journal::new(0, false);
        journal.listen(true);
        let many = MAX_JOURNAL_ENTRIES as u64 + 5;
        (0..many).for_each(|sequence| journal.note_event(&end(sequence), 0));
        let (first, entries) = journal.take(false).unwrap();
        assert_eq!((first.first, entries.len()), (0, MAX_JOURNAL_ENTRIES));
        assert_eq!(journal.take(false), None, "the rest may wait");
        let (second, entries) = journal.take(true).unwrap();
        assert_eq!((second.first, second.sequence), (MAX_JOURNAL_ENTRIES as u64, 1));
        assert_eq!((entries.len(), entries[4].sequence), (5, many - 1));
    }

    #[test]
    fn a_record_is_told_from_that_of_another_asker() {
        let entry = |view_generation, attempt| {
            let mut record = empty_record(4);
            (record.header.view_generation, record.header.attempt) = (view_generation, attempt);
            entry_of(&Event::<Vec<u8>>::Searched(record), 0)
        };
        assert_eq!(entry(0, 0), entry(0, 0));
        assert_ne!(entry(0, 0), entry(1, 0));
        assert_ne!(entry(0, 0), entry(0, 1));
    }
}
