//! Everything that keeps a source from being used.

use std::path::PathBuf;

/// Everything that keeps a source from being used. What a camera can recover from is not here: it
/// is [`crate::Event::Lost`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the texts name the fields")]
pub enum CaptureError {
    /// What stands for the source cannot be understood.
    #[error("source \"{text}\": {reason}")]
    Spec { text: String, reason: String },
    /// A parameter makes no sense.
    #[error("{name} is {value}: {cure}")]
    Parameter { name: &'static str, value: String, cure: &'static str },
    /// GStreamer itself does not start.
    #[error(
        "GStreamer does not start: {0}. Cure: reinstall libgstreamer1.0-0 and gstreamer1.0-plugins-base"
    )]
    GStreamer(String),
    /// The path leads to no file or folder.
    #[error("{} does not exist. Cure: check the path; relative ones start at {}", path.display(), from.display())]
    Missing { path: PathBuf, from: PathBuf },
    /// The file is there and cannot be read.
    #[error("{} cannot be read: {reason}", path.display())]
    Unreadable { path: PathBuf, reason: String },
    /// The file has no video that can be played.
    #[error("{} is not a video: {reason}", path.display())]
    NotAVideo { path: PathBuf, reason: String },
    /// A recording of a flight that cannot be read.
    #[error("{0}")]
    Recording(String),
    /// A recording of a flight that has nothing to play.
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
    /// Nothing installed decodes this file.
    #[error("{}: nothing here decodes {what}. Cure: apt-get install gstreamer1.0-libav gstreamer1.0-plugins-good gstreamer1.0-plugins-bad", path.display())]
    MissingDecoder { path: PathBuf, what: String },
    /// A source description that GStreamer cannot make a pipeline of.
    #[error(
        "source description \"{description}\": {reason}. Cure: try it with gst-launch-1.0 and \"! fakesink\" at its end"
    )]
    Description { description: String, reason: String },
    /// Frames are not of the size that was configured.
    #[error(
        "{what} has frames of {}x{}, {}x{} were expected. Cure: set camera.width to {} and camera.height to {}",
        found.0, found.1, expected.0, expected.1, found.0, found.1
    )]
    Size { what: String, expected: (u32, u32), found: (u32, u32) },
    /// A frame's memory cannot be read.
    #[error("{what}: frame {sequence} cannot be read: {reason}")]
    Frame { what: String, sequence: u64, reason: String },
}
