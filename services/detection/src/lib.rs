//! Finds decoded markers in a view.
//!
//! Outlines of what is dark say where squares are ([`candidates`]); what is printed in them is read in linear
//! light and compared with the dictionary's markers as a lens would blur them ([`reading`]); and the
//! corners are those of the print fitted to the light ([`flockeye_imaging::edges`]), because
//! OpenCV's lie inside the true square by up to 0.85 px. [`Detector`] puts the three together.
//!
//! OpenCV's own decoding takes the nearest pixel of each cell's middle, so that a blurred marker is
//! lost below some 20 px, and it does not look at the white round the square at all, so that texture
//! with the right bits passes. Here none passes without its quiet zone. docs/DETECTION.md says what
//! is found, and how it compares.

// Public for the benchmark that compares it with OpenCV.
pub mod candidates;
mod darkness;
mod detector;
mod outlines;
mod plausible;
mod polygon;
mod reading;
pub mod stage;
mod three_corners;
pub mod windows;

use flockeye_dictionary::DictionaryError;

pub use detector::{Detector, DetectorParameters, Found, MAX_DOUBTFUL, Threshold};
pub use plausible::keep_plausible;

/// Why a detector could not be had, or not be given other thresholds.
#[derive(Debug, thiserror::Error)]
pub enum DetectError {
    /// The dictionary could not be had.
    #[error(transparent)]
    Dictionary(#[from] DictionaryError),
    /// A parameter outside its range.
    #[error("{name} is {value}; it must be {allowed}")]
    Parameter {
        /// The parameter.
        name: &'static str,
        /// What it was.
        value: f64,
        /// What it may be.
        allowed: &'static str,
    },
}

/// The detection stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::DetectionStage>()
}
