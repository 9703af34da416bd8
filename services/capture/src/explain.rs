//! Translation of GStreamer's errors to texts with a cure.

use std::path::Path;

use gstreamer as gst;

use crate::CaptureError;
use crate::input::Input;

/// An error message of the pipeline's bus.
#[derive(Debug, Clone)]
pub(crate) struct Failure {
    pub(crate) error: gst::glib::Error,
    /// Name of the format for which a plugin is missing.
    pub(crate) undecodable: Option<String>,
}

impl Failure {
    /// A failure without an error of GStreamer.
    pub(crate) fn of_ours(text: &str) -> Self {
        let error = gst::glib::Error::new(gst::CoreError::Failed, text);
        Self { error, undecodable: None }
    }

    /// Whether the error is one of these stream errors.
    fn is(&self, kinds: &[gst::StreamError]) -> bool {
        self.error.kind::<gst::StreamError>().is_some_and(|kind| kinds.contains(&kind))
    }

    pub(crate) fn for_file(&self, path: &Path) -> CaptureError {
        let path = path.to_owned();
        if let Some(what) = &self.undecodable {
            return CaptureError::MissingDecoder { path, what: what.clone() };
        }
        if self.error.kind::<gst::ResourceError>().is_some() {
            return CaptureError::Unreadable { path, reason: self.text() };
        }
        let reason = if self.is(&[gst::StreamError::TypeNotFound, gst::StreamError::WrongType]) {
            format!("GStreamer finds no video format in it ({})", self.text())
        } else if self.is(&[gst::StreamError::CodecNotFound]) {
            "it holds no video stream".to_owned()
        } else {
            self.text()
        };
        CaptureError::NotAVideo { path, reason }
    }

    /// Text for the failure of a running source, or of a camera's start.
    pub(crate) fn for_running(&self, input: &Input) -> String {
        let name = input.name();
        if let Some(what) = &self.undecodable {
            return format!(
                "{name}: nothing here decodes {what}. Cure: apt-get install gstreamer1.0-libav"
            );
        }
        let said = self.text();
        match (input, self.cure(input)) {
            (Input::File(_) | Input::Flight(..), _) | (_, None) => format!("{name}: {said}"),
            (_, Some(cure)) => format!("{name}: {said}. Cure: {cure}"),
        }
    }

    fn cure(&self, input: &Input) -> Option<&'static str> {
        use gst::ResourceError::{
            Busy, NotAuthorized, NotFound, OpenRead, OpenReadWrite, Read, Settings,
        };
        Some(match (self.error.kind::<gst::ResourceError>(), input) {
            (Some(NotFound | OpenRead | OpenReadWrite), Input::Theta) => {
                "switch the Theta on and into live streaming (hold its mode button), and check the cable with lsusb"
            }
            (Some(NotFound | OpenRead | OpenReadWrite), _) => {
                "check that it is plugged in (v4l2-ctl --list-devices)"
            }
            (Some(NotAuthorized), _) => "add the user to the group video, or install the udev rule",
            (Some(Busy), _) => "another program uses it (fuser -v shows which)",
            (Some(Settings), _) => {
                "check camera.width and camera.height (v4l2-ctl --list-formats-ext)"
            }
            (Some(Read), _) => "check the cable and the power",
            _ if self.is(&[gst::StreamError::Format])
                || self.error.kind::<gst::CoreError>() == Some(gst::CoreError::Negotiation) =>
            {
                "check that it offers camera.width x camera.height (v4l2-ctl --list-formats-ext)"
            }
            _ => return None,
        })
    }

    /// GStreamer's own text, without the full stop.
    pub(crate) fn text(&self) -> String {
        self.error.message().trim().trim_end_matches('.').to_owned()
    }
}
