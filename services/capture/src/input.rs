//! Front part of the pipeline: from a source to coded or raw video.

use std::path::PathBuf;

use flockeye_contract::VideoCodec;
use gstreamer as gst;
use gstreamer::prelude::*;

use crate::CaptureError;

/// Input of one pipeline.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Input {
    File(PathBuf),
    /// Coded pictures of a recorded flight, through an `appsrc`; [`VideoCodec::None`]: JPEGs.
    Flight(PathBuf, VideoCodec),
    V4l2(PathBuf),
    Theta,
    Description(String),
}

/// Name of the `appsrc` for the pictures of a flight.
pub(crate) const FEED: &str = "flockeye-feed";
/// Limit for the size of its queue, bytes.
const FEED_BYTES: u64 = 8_000_000;

/// Name of the decoder at the end of a description.
const DECODER: &str = "flockeye-decoder";

impl Input {
    /// Name of the input in messages.
    pub(crate) fn name(&self) -> String {
        match self {
            Self::File(path) | Self::Flight(path, _) => path.display().to_string(),
            Self::V4l2(device) => format!("camera {}", device.display()),
            Self::Theta => "Theta camera".to_owned(),
            Self::Description(description) => format!("source \"{description}\""),
        }
    }

    /// Whether the input is a camera by its kind. For a description this is known only when it
    /// runs. Exception: the Theta's driver, which does not announce a live source.
    pub(crate) fn is_camera(&self) -> bool {
        match self {
            Self::V4l2(_) | Self::Theta => true,
            Self::Description(text) => text.contains("thetauvcsrc"),
            Self::File(_) | Self::Flight(..) => false,
        }
    }

    /// A pipeline from the source to a decoder, and the decoder, which has no pads yet.
    pub(crate) fn pipeline(
        &self,
        size: (u32, u32),
    ) -> Result<(gst::Pipeline, gst::Element), CaptureError> {
        match self {
            Self::File(path) => {
                let location = path.to_str().ok_or_else(|| CaptureError::Unreadable {
                    path: path.clone(),
                    reason: "its name is not UTF-8. Cure: rename it".to_owned(),
                })?;
                let source = element("filesrc")?;
                source.set_property("location", location);
                chain(&[source])
            }
            Self::Flight(_, codec) => {
                let caps = match codec {
                    VideoCodec::None => gst::Caps::builder("image/jpeg").build(),
                    VideoCodec::H264 => byte_stream("video/x-h264"),
                    VideoCodec::H265 => byte_stream("video/x-h265"),
                };
                let feed = element("appsrc")?;
                feed.set_property("name", FEED);
                feed.set_property("caps", caps);
                feed.set_property("format", gst::Format::Time);
                // The feeding thread blocks until there is room.
                feed.set_property("block", true);
                feed.set_property("max-bytes", FEED_BYTES);
                chain(&[feed])
            }
            Self::V4l2(device) => {
                let source = element("v4l2src")?;
                source.set_property("device", &*device.to_string_lossy());
                let modes = element("capsfilter")?;
                modes.set_property("caps", camera_modes(size)?);
                chain(&[source, modes])
            }
            Self::Theta => {
                // Modes of the camera: 3840x1920 and 1920x960.
                let mode = if size.0 == 1920 { "2K" } else { "4K" };
                described(&format!("thetauvcsrc mode={mode} ! queue ! h264parse"))
            }
            Self::Description(description) => described(description),
        }
    }
}

/// Caps for H.264 or H.265 with one picture per buffer.
fn byte_stream(name: &str) -> gst::Caps {
    gst::Caps::builder(name).field("stream-format", "byte-stream").field("alignment", "au").build()
}

/// Caps for the modes of a camera, in the order of processing cost.
fn camera_modes((width, height): (u32, u32)) -> Result<gst::Caps, CaptureError> {
    let size = format!("width=(int){width},height=(int){height}");
    format!(
        "video/x-raw,format=(string){{NV12,I420,GRAY8}},{size};video/x-h264,{size};image/jpeg,{size};video/x-raw,{size}"
    )
    .parse()
    .map_err(|error: gst::glib::BoolError| CaptureError::GStreamer(error.to_string()))
}

fn chain(front: &[gst::Element]) -> Result<(gst::Pipeline, gst::Element), CaptureError> {
    let decoder = element("decodebin")?;
    let pipeline = gst::Pipeline::new();
    let mut all: Vec<&gst::Element> = front.iter().collect();
    all.push(&decoder);
    let joined = pipeline.add_many(&all).and_then(|()| gst::Element::link_many(&all));
    joined.map_err(|error| CaptureError::GStreamer(error.to_string()))?;
    Ok((pipeline, decoder))
}

fn described(description: &str) -> Result<(gst::Pipeline, gst::Element), CaptureError> {
    let refused =
        |reason: String| CaptureError::Description { description: description.to_owned(), reason };
    let text = format!("{description} ! decodebin name={DECODER}");
    let parsed =
        gst::parse::launch(&text).map_err(|error| match error.kind::<gst::ParseError>() {
            Some(gst::ParseError::NoSuchElement) => {
                let message = error.message().to_owned();
                let element = message.split('"').nth(1).unwrap_or(&message).to_owned();
                CaptureError::MissingElement { cure: cure_for(&element), element }
            }
            _ => refused(error.message().to_owned()),
        })?;
    let pipeline =
        parsed.downcast::<gst::Pipeline>().map_err(|_| refused("it is no pipeline".to_owned()))?;
    let decoder =
        pipeline.by_name(DECODER).ok_or_else(|| refused("its end cannot be decoded".to_owned()))?;
    Ok((pipeline, decoder))
}

/// Makes an element. The error names what to install.
pub(crate) fn element(name: &str) -> Result<gst::Element, CaptureError> {
    let missing =
        |_| CaptureError::MissingElement { element: name.to_owned(), cure: cure_for(name) };
    gst::ElementFactory::make(name).build().map_err(missing)
}

/// Cure for a missing element: what to install.
fn cure_for(element: &str) -> String {
    let package = match element {
        "thetauvcsrc" => {
            return "build and install the Theta driver: libuvc-theta (github.com/ricohapi/libuvc-theta), then \
                    gstthetauvc (github.com/nickel110/gstthetauvc), and put gstthetauvc.so where GST_PLUGIN_PATH points"
                .to_owned();
        }
        "v4l2src" | "rtspsrc" | "jpegdec" | "pngdec" | "qtdemux" | "matroskademux" | "udpsrc" => {
            "gstreamer1.0-plugins-good"
        }
        "h264parse" | "h265parse" | "srtsrc" | "openh264dec" => "gstreamer1.0-plugins-bad",
        "decodebin" | "videoconvert" | "videotestsrc" | "appsink" | "appsrc" => {
            "gstreamer1.0-plugins-base"
        }
        "filesrc" | "queue" | "capsfilter" => "libgstreamer1.0-0",
        name if name.starts_with("avdec_") => "gstreamer1.0-libav",
        _ => {
            return format!(
                "check its spelling, or install the plugin that has it (apt-cache search gstreamer1.0; gst-inspect-1.0 {element})"
            );
        }
    };
    format!("apt-get install {package}")
}
