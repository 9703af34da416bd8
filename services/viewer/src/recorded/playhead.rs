//! The frame of a recording that is shown, for seeks, steps and time that passes. It has no socket
//! and no clock.

use std::collections::VecDeque;
use std::sync::Arc;

use super::Recorded;
use super::tape::SceneTape;
use crate::scene::EndedFrame;

/// Time before a frame that is read with it, for trails and states, nanoseconds. A page keeps a
/// longer time.
const LEAD_NS: u64 = 9_000_000_000;
/// Maximum frames that are kept.
const MOST_FRAMES: usize = 600;
/// Factor by which the lead grows where no frame ended in it.
const WIDER: u64 = 8;

/// The frames that a move has added to those that are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum NewFrames {
    /// All frames that are kept.
    All,
    /// The last frames, this many.
    Last(usize),
}

/// A position in a recording, with the frames before it.
pub(crate) struct Playhead {
    recorded: Arc<Recorded>,
    /// The recording from this position on.
    pub(super) tape: SceneTape,
    /// The frames that are kept, up to the last one that was read.
    pub(super) recent: VecDeque<EndedFrame>,
    /// Index in `recent` of the frame that is shown.
    current: usize,
    /// The time that is shown, UTC nanoseconds.
    pub(super) at_ns: u64,
}

impl Playhead {
    /// Starts at the beginning of the recording.
    pub(crate) fn new(recorded: Arc<Recorded>) -> Self {
        let at_ns = recorded.first_ns;
        let tape = SceneTape::at(recorded.clone(), at_ns);
        let mut playhead = Self { recorded, tape, recent: VecDeque::new(), current: 0, at_ns };
        playhead.seek(at_ns);
        playhead
    }

    pub(crate) fn current(&self) -> Option<&EndedFrame> {
        self.recent.get(self.current)
    }

    /// Whether the end of the recording is reached.
    pub(crate) fn is_at_end(&self) -> bool {
        self.at_ns >= self.recorded.last_ns
    }

    /// Shows the last frame that ended until this time, or the first of all.
    pub(crate) fn seek(&mut self, to_ns: u64) -> NewFrames {
        let to_ns = to_ns.clamp(self.recorded.first_ns, self.recorded.last_ns);
        let mut lead_ns = LEAD_NS;
        loop {
            let from_ns = to_ns.saturating_sub(lead_ns).max(self.recorded.first_ns);
            self.tape = SceneTape::at(self.recorded.clone(), from_ns);
            self.recent.clear();
            while let Some(seen) = self.tape.next_until(to_ns) {
                // A chunk begins before the lead, so it has older frames.
                if seen.utc_ns >= from_ns {
                    self.push(seen);
                }
            }
            if !self.recent.is_empty() || from_ns == self.recorded.first_ns {
                break;
            }
            lead_ns = lead_ns.saturating_mul(WIDER);
        }
        if self.recent.is_empty()
            && let Some(first) = self.tape.next_until(u64::MAX)
        {
            self.push(first);
        }
        self.current = self.recent.len().saturating_sub(1);
        self.at_ns = to_ns;
        NewFrames::All
    }

    /// Shows the frame `frames` further on, or back if negative, as far as there are frames.
    pub(crate) fn step(&mut self, frames: i32) -> NewFrames {
        let mut new = NewFrames::Last(0);
        let mut left = frames.unsigned_abs() as usize;
        while left > 0 {
            if frames > 0 {
                if self.current + 1 < self.recent.len() {
                    self.current += 1;
                } else {
                    let Some(seen) = self.tape.next_until(u64::MAX) else { break };
                    self.push(seen);
                    self.current = self.recent.len() - 1;
                    new = match new {
                        NewFrames::Last(count) => NewFrames::Last(count + 1),
                        NewFrames::All => NewFrames::All,
                    };
                }
                left -= 1;
            } else if self.current > 0 {
                let back = left.min(self.current);
                self.current -= back;
                left -= back;
            } else {
                let Some(first) = self.recent.front().map(|seen| seen.utc_ns) else { break };
                new = self.seek(first.saturating_sub(1));
                // There is no earlier frame.
                if self.current().is_none_or(|seen| seen.utc_ns >= first) {
                    break;
                }
                left -= 1;
            }
        }
        if let Some(seen) = self.current() {
            self.at_ns = seen.utc_ns;
        }
        new
    }

    /// Advances to this time.
    pub(crate) fn advance(&mut self, to_ns: u64) -> NewFrames {
        let to_ns = to_ns.min(self.recorded.last_ns);
        // After a step back the later frames that were read must appear in their time again.
        if self.current + 1 < self.recent.len() {
            return self.seek(to_ns);
        }
        let mut added = 0;
        while let Some(seen) = self.tape.next_until(to_ns) {
            self.push(seen);
            added += 1;
        }
        self.current = self.recent.len().saturating_sub(1);
        self.at_ns = to_ns.max(self.at_ns);
        NewFrames::Last(added)
    }

    fn push(&mut self, seen: EndedFrame) {
        let oldest_ns = seen.utc_ns.saturating_sub(LEAD_NS);
        self.recent.push_back(seen);
        while self.recent.len() > MOST_FRAMES
            || (self.recent.len() > 1
                && self.recent.front().is_some_and(|oldest| oldest.utc_ns < oldest_ns))
        {
            self.recent.pop_front();
        }
    }
}
