//! Events of a source.

use std::fmt;
use std::time::Duration;

use crate::SourcePicture;

/// Result of [`crate::FrameSource::next`].
#[derive(Debug)]
pub enum Event {
    /// A frame.
    Frame(SourcePicture),
    /// No event before the timeout.
    Idle,
    /// A recording starts again; sequence and stream time restart at 0. Raise the epoch.
    Looped {
        /// End of the last round.
        after: EndReason,
    },
    /// The source of a recorded flight was restarted. Raise the epoch.
    NewEpoch,
    /// An image of a folder, or a picture of a recorded flight, could not be used and is skipped.
    /// Its sequence number is not used again.
    Skipped {
        /// Name of the image or picture.
        what: String,
        /// Reason and cure.
        why: String,
    },
    /// A camera's frames have an avoidable latency. Sent once; the source continues.
    Late {
        /// Reason, latency and cure.
        what: String,
    },
    /// A camera was lost, or could not be opened again. Later calls open it again; sequence and
    /// stream time then restart at 0. Raise the epoch.
    Lost {
        /// Reason and cure.
        reason: String,
        /// Time until the next attempt.
        retry_in: Duration,
    },
    /// End of a recording. Every later call returns it again.
    End(EndReason),
}

/// End of a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum EndReason {
    /// The file was played to its end.
    Complete {
        /// Number of decoded frames.
        frames: u64,
        /// Number of unusable images of a folder, or pictures of a flight.
        skipped: u64,
    },
    /// The file was truncated: the rest is missing or damaged.
    Truncated {
        /// Number of frames decoded before.
        decoded: u64,
        /// Error in the rest.
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
