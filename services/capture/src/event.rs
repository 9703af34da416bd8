//! What comes out of a source.

use std::fmt;
use std::time::Duration;

use crate::SourcePicture;

/// What [`crate::FrameSource::next`] came back with.
#[derive(Debug)]
pub enum Event {
    /// A frame.
    Frame(SourcePicture),
    /// Nothing happened within the time given.
    Idle,
    /// A recording starts again; sequence and stream time count from 0. Raise the epoch.
    Looped {
        /// How the round that is over ended.
        after: EndReason,
    },
    /// In a recording of a flight, the source began anew. Raise the epoch.
    NewEpoch,
    /// An image of a folder, or a picture of a recording of a flight, could not be used; the others
    /// go on. Its sequence number stays free.
    Skipped {
        /// Which one.
        what: String,
        /// Why, and what to do about it.
        why: String,
    },
    /// A camera's frames come later than they could. Said once, while all goes on.
    Late {
        /// Why, what it costs, and what to do about it.
        what: String,
    },
    /// A camera went away, or did not come back. Later calls open it again; sequence and stream
    /// time then count from 0. Raise the epoch.
    Lost {
        /// What happened, and what to do about it.
        reason: String,
        /// When the next attempt is made.
        retry_in: Duration,
    },
    /// A recording is over. Every later call gives this again.
    End(EndReason),
}

/// How a recording ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum EndReason {
    /// The file was played to its end.
    Complete {
        /// Frames decoded.
        frames: u64,
        /// Images of a folder, or pictures of a flight, that could not be used.
        skipped: u64,
    },
    /// The file broke off: the rest is missing or broken.
    Truncated {
        /// Frames decoded up to there.
        decoded: u64,
        /// What is wrong with the rest.
        reason: String,
    },
}

impl fmt::Display for EndReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Complete { frames, skipped: 0 } => write!(f, "complete: {frames} frames"),
            Self::Complete { frames, skipped } => {
                write!(f, "complete: {frames} frames, {skipped} pictures skipped")
            }
            Self::Truncated { decoded, reason } => {
                write!(f, "broke off after {decoded} frames: {reason}")
            }
        }
    }
}
