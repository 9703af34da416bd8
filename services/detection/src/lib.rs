//! Finds decoded markers in a view.
//!
//! Outlines of dark regions give squares ([`candidates`]). The print in them is read as radiance
//! and compared with the dictionary's markers, blurred as by a lens ([`reading`]). The corners are
//! those of the print fitted to the radiance ([`flockeye_imaging::edges`]), because OpenCV's lie
//! inside the true square by up to 0.85 px. [`Detector`] puts these steps together, and [`core`]
//! makes a detection record of each view.
//!
//! OpenCV decodes a marker by the pixel nearest to each cell's middle, so blurred markers are lost
//! below some 20 px. It does not look at the white around the square either, so texture with the
//! right bits passes. Here no square passes without its quiet zone. docs/DETECTION.md has the
//! results and the comparison.

// Public for the benchmark that compares it with OpenCV.
pub mod candidates;
pub mod core;
mod darkness;
mod detector;
mod drawn;
mod engine;
mod opencv_detector;
mod outlines;
mod parameters;
mod polygon;
mod quad;
mod reader;
mod reading;
mod shape;
mod stage;
mod three_corners;
pub mod windows;

pub use detector::{Detector, MarkerInView};
pub use engine::Engine;
pub use opencv_detector::OpenCvDetector;
pub use parameters::{DetectError, DetectorParameters};
pub use quad::Quad;
pub use windows::{DarkerBy, Threshold};

/// The detection stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::DetectionStage>()
}
