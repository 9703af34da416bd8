//! What goes over the network: JSON that any language reads.
//!
//! A [`FrameReport`] (`flockeye.frame/2`) has all targets of a frame, under [`frame_key`]. A [`Sighting`] is one of
//! them with the frame's own fields. `docs/PEERS.md` describes both for authors of subscribers, and `docs/schemas/`
//! has the JSON Schema.

mod frame_report;
mod keys;
mod number;
#[cfg(test)]
mod tests;

pub use frame_report::{
    ClockOffset, Degenerate, FRAME_SCHEMA, FrameReport, MAX_FRAME_REPORT_BYTES, MAX_TARGET_BYTES,
    Measurement, Odometry, Predicted, Rival, Sighting, TargetReport,
};
pub use keys::{
    MAX_NAME_CHARS, alive_key, all_alive_key, all_frames_key, all_keys, frame_key, is_name,
};

/// Maximum targets of one observer.
pub const MAX_TARGETS: usize = 64;

/// Why a report from the network was refused.
#[expect(missing_docs, reason = "the texts name the fields")]
#[derive(Debug, thiserror::Error)]
pub enum WireError {
    /// Longer than any report may be.
    #[error("a report of {found} bytes (at most {most})")]
    TooLong { found: usize, most: usize },
    /// Not JSON, or not of this form.
    #[error("not a report: {0}")]
    Json(#[from] serde_json::Error),
    /// A schema that this version does not know.
    #[error("schema '{found}' instead of '{wanted}'")]
    Schema { found: String, wanted: &'static str },
    /// Invalid numbers.
    #[error("{what} is not finite, not a rotation or not a variance")]
    Number { what: &'static str },
    /// A name that cannot be one.
    #[error("'{found}' is no name: 1 to {MAX_NAME_CHARS} letters, digits, '-', '_' or '.'")]
    Name { found: String },
    /// The same target twice in one frame.
    #[error("target '{target}' twice in one frame")]
    Twice { target: String },
    /// More targets than an observer may report on.
    #[error("{found} targets (at most {MAX_TARGETS})")]
    TooManyTargets { found: usize },
}

/// Text from outside, shortened and escaped for a log line.
pub fn shortened(text: &str) -> String {
    text.chars().take(40).flat_map(char::escape_debug).collect()
}
