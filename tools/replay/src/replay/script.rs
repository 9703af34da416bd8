//! Puts the messages to fusion's core in the order of its journal.
//!
//! A recorder receives each topic separately, so an entry may come before its message. Entries wait
//! for their messages and messages for their entries, for a limited time of the recording.

use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

use anyhow::ensure;
use flockeye_contract::{JournalEntry, JournalHeader, JournalKind};

use crate::recorded::RecordedPixels;
use flockeye_fusion::Event;
use flockeye_fusion::entry_of;

/// Timeout of an entry for its message. It is the largest delay between topics in a busy recorder.
const PATIENCE: Duration = Duration::from_secs(5);

/// Timeout of a message for its entry. It is the longest time that fusion may be stopped.
const RETENTION: Duration = Duration::from_secs(60);

/// The reason why fusion cannot be replayed from a recording without a journal.
pub(crate) const NO_JOURNAL: &str = "the recording has no journal of fusion, so it is not known when fusion heard what. Cure: record with \
     this version of Flockeye, and its own fusion";

/// The next call of the core.
#[derive(Debug)]
#[allow(clippy::large_enum_variant, reason = "one at a time, on the stack")]
pub(super) enum NextCall {
    /// An entry, with its message if it has one.
    Entry(JournalEntry, Option<Event<RecordedPixels>>),
    /// The next entry or its message has not come yet.
    Wait,
    /// No more entries follow, for this reason.
    End(String),
}

/// Entries that wait for their messages, and messages that wait for their entries.
#[derive(Debug, Default)]
pub(super) struct Script {
    /// Entries with their times of recording, UTC nanoseconds.
    entries: VecDeque<(u64, JournalEntry)>,
    /// Messages by their entries with time 0, each with the time of recording.
    heard: BTreeMap<JournalEntry, VecDeque<(u64, Event<RecordedPixels>)>>,
    /// The number of the next entry; `None` before the first.
    next: Option<u64>,
    /// The reason why no more entries are taken.
    end: Option<String>,
    /// Time of recording of the first message.
    begun_ns: Option<u64>,
}

impl Script {
    /// Whether a journal has been found.
    pub(super) fn has_begun(&self) -> bool {
        self.next.is_some()
    }

    /// Takes a message that may have reached fusion.
    pub(super) fn hear(&mut self, event: Event<RecordedPixels>, utc_ns: u64) -> anyhow::Result<()> {
        let begun_ns = *self.begun_ns.get_or_insert(utc_ns);
        ensure!(self.has_begun() || !is_over(PATIENCE, begun_ns, utc_ns), NO_JOURNAL);
        self.heard.entry(entry_of(&event, 0)).or_default().push_back((utc_ns, event));
        Ok(())
    }

    /// Takes a message of the journal.
    ///
    /// # Errors
    /// The journal does not begin with the process.
    pub(super) fn note(
        &mut self,
        header: &JournalHeader,
        entries: &[JournalEntry],
        utc_ns: u64,
    ) -> anyhow::Result<()> {
        let is_first_process = header.generation == 0 && header.is_resumed == 0;
        let Some(next) = self.next else {
            ensure!(
                is_first_process,
                "the recording begins with a process of fusion that had replaced another one: what that one knew is not in \
                 it. Cure: record from the first frame on (recording.folder in pipeline.yaml)"
            );
            ensure!(
                header.first == 0,
                "the recording begins {} entries after fusion's journal: what fusion knew before is not in it. Cure: record \
                 from the first frame on (recording.folder in pipeline.yaml)",
                header.first
            );
            self.take(entries, 0, utc_ns);
            return Ok(());
        };
        if self.end.is_some() {
            return Ok(());
        }
        if !is_first_process {
            self.end = Some("fusion was replaced, and its successor is not replayed".to_owned());
        } else if header.first != next {
            let missing = header.first.saturating_sub(next);
            self.end =
                Some(format!("{missing} entries of fusion's journal are not in the recording"));
        } else {
            self.take(entries, next, utc_ns);
        }
        Ok(())
    }

    fn take(&mut self, entries: &[JournalEntry], first: u64, utc_ns: u64) {
        self.next = Some(first + entries.len() as u64);
        self.entries.extend(entries.iter().map(|entry| (utc_ns, *entry)));
        // Fusion dropped messages that are older and have no entry.
        let oldest_ns = self.entries.front().map_or(utc_ns, |(noted_ns, _)| *noted_ns);
        self.heard.retain(|_, waiting| {
            waiting.retain(|(heard_ns, _)| !is_over(RETENTION, *heard_ns, oldest_ns));
            !waiting.is_empty()
        });
    }

    /// The next entry at the time `utc_ns` of the recording; `None`: at the end of the recording.
    pub(super) fn next(&mut self, utc_ns: Option<u64>) -> NextCall {
        let Some((noted_ns, entry)) = self.entries.front().copied() else {
            return self.end.clone().map_or(NextCall::Wait, NextCall::End);
        };
        let event = match names_message(&entry) {
            false => None,
            true => match self.heard_of(&entry) {
                Some(event) => Some(event),
                None if utc_ns.is_some_and(|utc_ns| !is_over(PATIENCE, noted_ns, utc_ns)) => {
                    return NextCall::Wait;
                }
                None => {
                    let said =
                        format!("{}, which fusion heard, is not in the recording", said(&entry));
                    return NextCall::End(said);
                }
            },
        };
        self.entries.pop_front();
        NextCall::Entry(entry, event)
    }

    fn heard_of(&mut self, entry: &JournalEntry) -> Option<Event<RecordedPixels>> {
        let key = JournalEntry { at_ns: 0, ..*entry };
        let waiting = self.heard.get_mut(&key)?;
        let (_, event) = waiting.pop_front()?;
        if waiting.is_empty() {
            self.heard.remove(&key);
        }
        Some(event)
    }
}

/// Whether `time` has passed since `since_ns`.
fn is_over(time: Duration, since_ns: u64, utc_ns: u64) -> bool {
    u128::from(utc_ns.saturating_sub(since_ns)) > time.as_nanos()
}

/// Whether an entry names a message of another stage.
pub(crate) fn names_message(entry: &JournalEntry) -> bool {
    let own = [JournalKind::Background, JournalKind::Step, JournalKind::Said];
    !own.iter().any(|kind| kind.code() == entry.kind)
}

/// The message that an entry names, as text.
fn said(entry: &JournalEntry) -> String {
    let JournalEntry { sequence, view_index, worker, .. } = entry;
    match JournalKind::try_from(entry.kind) {
        Ok(JournalKind::View) => format!("view {view_index} of frame {sequence}"),
        Ok(JournalKind::Searched) => {
            format!("the record of view {view_index} of frame {sequence} by worker {worker}")
        }
        Ok(JournalKind::FrameEnd) => format!("the end of frame {sequence}"),
        Ok(JournalKind::Rotation) => format!("the rotation of frame {sequence}"),
        Ok(JournalKind::Background | JournalKind::Step | JournalKind::Said) | Err(_) => {
            "a message".to_owned()
        }
    }
}
