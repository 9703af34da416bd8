//! Source specification: the argument of `--source`.

use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use crate::CaptureError;

/// A source, parsed from the argument of `--source`.
///
/// | written | means |
/// | --- | --- |
/// | `flight.mp4` | a video file, whatever GStreamer decodes |
/// | `flight.mcap` | a recording of a flight, with its pictures |
/// | `stills/` | a folder of .jpg, .jpeg and .png images, in the order of their names |
/// | `v4l2:/dev/video0`, `/dev/video0` | a camera under Video4Linux |
/// | `theta` | a Ricoh Theta V or Z1 |
/// | `videotestsrc is-live=true ! ...`, `gst:videotestsrc` | a GStreamer source description |
///
/// In real time, a description counts as a camera: after its end it is opened again. In lossless
/// flow it counts as a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum SourceSpec {
    /// A video file, or a single image.
    File(PathBuf),
    /// A recording of a flight.
    Flight(PathBuf),
    /// A folder of images.
    Folder(PathBuf),
    /// A Video4Linux device.
    V4l2(PathBuf),
    /// A Ricoh Theta V or Z1 through `thetauvcsrc`.
    Theta,
    /// A GStreamer description of anything that ends in video, coded or raw.
    Description(String),
}

impl FromStr for SourceSpec {
    type Err = CaptureError;

    /// Parses the argument. Uses the file system to distinguish a folder from a file, and a file
    /// name with `!` from a description. A missing file is an error only when it is opened.
    fn from_str(text: &str) -> Result<Self, CaptureError> {
        let trimmed = text.trim();
        let refused =
            |reason: &str| CaptureError::Spec { text: text.to_owned(), reason: reason.to_owned() };
        if trimmed.is_empty() {
            return Err(refused(
                "nothing written. Cure: a file, a folder, v4l2:/dev/video0, theta or gst:DESCRIPTION",
            ));
        }
        if trimmed == "theta" {
            return Ok(Self::Theta);
        }
        if let Some(device) = trimmed.strip_prefix("v4l2:") {
            if device.is_empty() {
                return Err(refused(
                    "no device named. Cure: v4l2:/dev/video0; v4l2-ctl --list-devices shows them",
                ));
            }
            return Ok(Self::V4l2(device.into()));
        }
        if trimmed.starts_with("/dev/video") {
            return Ok(Self::V4l2(trimmed.into()));
        }
        if let Some(description) = trimmed.strip_prefix("gst:") {
            let description = description.trim();
            if description.is_empty() {
                return Err(refused("no description. Cure: gst:videotestsrc, for example"));
            }
            return Ok(Self::Description(description.to_owned()));
        }
        let path = Path::new(trimmed);
        if path.is_dir() {
            return Ok(Self::Folder(path.to_owned()));
        }
        let is_flight =
            path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("mcap"));
        if is_flight && (path.exists() || !trimmed.contains('!')) {
            return Ok(Self::Flight(path.to_owned()));
        }
        if path.exists() {
            return Ok(Self::File(path.to_owned()));
        }
        if trimmed.contains('!') {
            return Ok(Self::Description(trimmed.to_owned()));
        }
        if trimmed.contains("://") {
            return Err(refused(
                "a network stream is written as a description. Cure: gst:rtspsrc location=rtsp://... latency=0",
            ));
        }
        Ok(Self::File(path.to_owned()))
    }
}

impl fmt::Display for SourceSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File(path) | Self::Flight(path) | Self::Folder(path) => {
                write!(f, "{}", path.display())
            }
            Self::V4l2(device) => write!(f, "v4l2:{}", device.display()),
            Self::Theta => write!(f, "theta"),
            Self::Description(description) => write!(f, "gst:{description}"),
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn understands_what_users_write() {
        let here = env!("CARGO_MANIFEST_DIR");
        for (text, spec) in [
            ("theta", SourceSpec::Theta),
            ("v4l2:/dev/video2", SourceSpec::V4l2("/dev/video2".into())),
            ("/dev/video0", SourceSpec::V4l2("/dev/video0".into())),
            ("gst: videotestsrc", SourceSpec::Description("videotestsrc".into())),
            ("videotestsrc ! queue", SourceSpec::Description("videotestsrc ! queue".into())),
            ("not/there.mp4", SourceSpec::File("not/there.mp4".into())),
            ("a b/flight.MCAP", SourceSpec::Flight("a b/flight.MCAP".into())),
            (
                "filesrc location=a.mcap ! x.mcap",
                SourceSpec::Description("filesrc location=a.mcap ! x.mcap".into()),
            ),
            (here, SourceSpec::Folder(here.into())),
        ] {
            assert_eq!(text.parse::<SourceSpec>().unwrap(), spec, "{text}");
            assert_eq!(
                spec.to_string().parse::<SourceSpec>().unwrap(),
                spec,
                "{spec} does not come back"
            );
        }
    }

    #[test]
    fn refusals_name_the_cure() {
        for (text, cure) in [
            ("  ", "gst:DESCRIPTION"),
            ("v4l2:", "/dev/video0"),
            ("gst:", "gst:videotestsrc"),
            ("rtsp://cam/1", "rtspsrc"),
        ] {
            let message = text.parse::<SourceSpec>().unwrap_err().to_string();
            assert!(message.contains(cure), "{text}: {message}");
        }
    }
}
