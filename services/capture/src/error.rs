//! Errors of a source.

use std::path::PathBuf;

/// Final errors of a source. Recoverable losses of a camera are [`crate::Event::Lost`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the texts name the fields")]
pub enum CaptureError {
    /// The source specification is invalid.
    #[error("source \"{text}\": {reason}")]
    Spec { text: String, reason: String },
    /// A parameter is invalid.
    #[error("{name} is {value}: {cure}")]
    Parameter { name: &'static str, value: String, cure: &'static str },
    /// GStreamer does not start.
    #[error(
        "GStreamer does not start: {0}. Cure: reinstall libgstreamer1.0-0 and gstreamer1.0-plugins-base"
    )]
    GStreamer(String),
    /// The path does not exist.
    #[error("{} does not exist. Cure: check the path; relative ones start at {}", path.display(), from.display())]
    Missing { path: PathBuf, from: PathBuf },
    /// The file exists, but cannot be read.
    #[error("{} cannot be read: {reason}", path.display())]
    Unreadable { path: PathBuf, reason: String },
    /// The file has no playable video.
    #[error("{} is not a video: {reason}", path.display())]
    NotAVideo { path: PathBuf, reason: String },
    /// A recorded flight cannot be read.
    #[error("{0}")]
    Recording(String),
    /// A recorded flight has no pictures.
    #[error(
        "{} has no pictures of frames: {reason}. Cure: record with --frames 'every 1', or with --frames camera where \
         the source is coded video", path.display()
    )]
    NoPictures { path: PathBuf, reason: String },
    /// The folder has no image.
    #[error("{} holds no image. Cure: put .jpg, .jpeg or .png files in it", path.display())]
    EmptyFolder { path: PathBuf },
    /// A GStreamer element is not installed.
    #[error("GStreamer has no element {element}. Cure: {cure}")]
    MissingElement { element: String, cure: String },
    /// No installed decoder supports this file.
    #[error("{}: nothing here decodes {what}. Cure: apt-get install gstreamer1.0-libav gstreamer1.0-plugins-good gstreamer1.0-plugins-bad", path.display())]
    MissingDecoder { path: PathBuf, what: String },
    /// GStreamer cannot build a pipeline from a source description.
    #[error(
        "source description \"{description}\": {reason}. Cure: try it with gst-launch-1.0 and \"! fakesink\" at its end"
    )]
    Description { description: String, reason: String },
    /// Frames do not have the configured size.
    #[error(
        "{what} has frames of {}x{}, {}x{} were expected. Cure: set camera.width to {} and camera.height to {}",
        found.0, found.1, expected.0, expected.1, found.0, found.1
    )]
    Size { what: String, expected: (u32, u32), found: (u32, u32) },
    /// A frame's memory cannot be read.
    #[error("{what}: frame {sequence} cannot be read: {reason}")]
    Frame { what: String, sequence: u64, reason: String },
}
