//! What goes over the network: JSON that any language reads.
//!
//! | what | key | schema |
//! | --- | --- | --- |
//! | [`FrameReport`]: all targets of a frame | [`frame_key`] | `flockeye.frame/2` |
//! | [`PoseReport`]: one target, for readers of before | [`pose_key`] | `flockeye.pose/1` |
//! | [`PoseReport`] of a track that is not confirmed | [`tentative_key`] | `flockeye.pose/1` |
//!
//! [`Sighting`] is what both say of one target. `docs/PEERS.md` describes the same for authors of
//! subscribers, and `docs/schemas/` has the JSON Schemas.

mod frame_report;
mod keys;
mod number;
mod pose_report;
#[cfg(test)]
mod tests;

pub use frame_report::{
    ClockOffset, Degenerate, FRAME_SCHEMA, FrameReport, MAX_FRAME_REPORT_BYTES, Measurement,
    Odometry, Predicted, Sighting, TargetReport,
};
pub use keys::{
    MAX_NAME_CHARS, alive_key, all_alive_key, all_frames_key, all_frames_token_key, all_keys,
    frame_key, frames_token_key, is_name, pose_key, tentative_key,
};
pub use pose_report::{MAX_REPORT_BYTES, POSE_SCHEMA, PoseReport};

/// Most targets that one observer reports on.
pub const MAX_TARGETS: usize = 64;

/// Why a report from the network was refused.
#[derive(Debug, thiserror::Error)]
pub enum WireError {
    /// Longer than any report may be.
    #[error("a report of {found} bytes (at most {most})")]
    TooLong {
        /// Its length.
        found: usize,
        /// The most allowed.
        most: usize,
    },
    /// Not JSON, or not of this form.
    #[error("not a report: {0}")]
    Json(#[from] serde_json::Error),
    /// A schema that this version does not know.
    #[error("schema '{found}' instead of '{wanted}'")]
    Schema {
        /// What it says, at most 40 characters of it.
        found: String,
        /// What is read under this key.
        wanted: &'static str,
    },
    /// Invalid numbers.
    #[error("{what} is not finite, not a rotation or not a variance")]
    Number {
        /// Which.
        what: &'static str,
    },
    /// A name that cannot be one.
    #[error("'{found}' is no name: 1 to {MAX_NAME_CHARS} letters, digits, '-', '_' or '.'")]
    Name {
        /// What it says, at most 40 characters of it.
        found: String,
    },
    /// The same target twice in one frame.
    #[error("target '{target}' twice in one frame")]
    Twice {
        /// Which.
        target: String,
    },
    /// More targets than an observer may report on.
    #[error("{found} targets (at most {MAX_TARGETS})")]
    TooManyTargets {
        /// How many.
        found: usize,
    },
}

/// JSON Schemas of what goes over the network, by the name of the file in `docs/schemas/`.
pub fn json_schemas() -> [(&'static str, schemars::Schema); 2] {
    [
        ("frame-report-2.json", schemars::schema_for!(FrameReport)),
        ("pose-report-1.json", schemars::schema_for!(PoseReport)),
    ]
}

/// Text from outside, shortened and escaped for a log line.
pub fn shortened(text: &str) -> String {
    text.chars().take(40).flat_map(char::escape_debug).collect()
}
