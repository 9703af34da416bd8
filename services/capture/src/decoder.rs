//! Which decoder GStreamer chose, and how it is set.

use flockeye_config::Flow;
use gstreamer as gst;
use gstreamer::prelude::*;

use crate::input::Input;
use crate::parameters::SourceParameters;

/// How a software decoder uses several processors.
///
/// libav's decoders can decode several frames at a time. That makes use of all processors, and
/// holds back one frame for each further one. Or they decode the slices of a frame at a time, which
/// holds none back, and is as fast only if the stream has several slices. Left alone they do the
/// first unless the source announces that it is live, and not every camera's driver does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Threading {
    /// The decoder chooses, with this many threads; 0 leaves that to it too.
    Chosen(u32),
    /// Slices of one frame at a time.
    Slices,
    /// This many frames at a time.
    Frames(u32),
}

impl Threading {
    /// The way for an input, with the threads that are configured.
    pub(crate) fn of(input: &Input, params: &SourceParameters) -> Self {
        match (params.flow, input.is_camera(), params.decoder_threads) {
            (Flow::Latest, true, 0) => Self::Slices,
            (Flow::Latest, true, threads) if threads > 1 => Self::Frames(threads),
            (_, _, threads) => Self::Chosen(threads),
        }
    }

    /// The way that is faster than this and keeps one more frame inside; `None` if no processor is
    /// left for it.
    pub(crate) fn faster(self, processors: u32) -> Option<Self> {
        let frames = match self {
            Self::Frames(frames) => frames + 1,
            Self::Slices | Self::Chosen(_) => 2,
        };
        (frames <= processors).then_some(Self::Frames(frames))
    }
}

/// Sets an element of the decoding bin as soon as it is chosen.
pub(crate) fn configure(element: &gst::Element, threading: Threading) {
    if !is_decoder(element) {
        return;
    }
    let (kind, threads) = match threading {
        Threading::Chosen(threads) => (None, threads),
        Threading::Slices => (Some("slice"), 0),
        Threading::Frames(threads) => (Some("frame"), threads),
    };
    if threads > 0 {
        // libav's decoders have the first, libvpx's the second.
        for name in ["max-threads", "threads"] {
            set_if_there(element, name, &threads.to_string());
        }
    }
    if let Some(kind) = kind {
        set_if_there(element, "thread-type", kind);
    }
    // The default, ifast, is off by up to several code values and hardly faster.
    set_if_there(element, "idct-method", "islow");
}

fn set_if_there(element: &gst::Element, name: &str, value: &str) {
    if element.find_property(name).is_some() {
        element.set_property_from_str(name, value);
    }
}

/// The decoders in use: names, each with `(hardware)` or `(software)`.
pub(crate) fn chosen(pipeline: &gst::Pipeline) -> Vec<String> {
    let name = |element: gst::Element| {
        let kind = if class_of(&element).contains("Hardware") { "hardware" } else { "software" };
        element.factory().map(|factory| format!("{} ({kind})", factory.name()))
    };
    elements(pipeline).filter(is_decoder).filter_map(name).collect()
}

/// Whether one of the decoders in use takes video: anything but single pictures, as JPEG and PNG
/// are.
pub(crate) fn takes_video(pipeline: &gst::Pipeline) -> bool {
    let takes_images = |element: gst::Element| {
        let caps = element.static_pad("sink").and_then(|pad| pad.current_caps());
        caps.and_then(|caps| Some(caps.structure(0)?.name().starts_with("image/"))) == Some(true)
    };
    !elements(pipeline).filter(is_decoder).all(takes_images)
}

/// All elements of a pipeline, those within bins too.
pub(crate) fn elements(pipeline: &gst::Pipeline) -> impl Iterator<Item = gst::Element> + use<> {
    pipeline.iterate_recurse().into_iter().map_while(Result::ok)
}

/// How many streams the file's demuxer offers; 0 without one.
pub(crate) fn streams(pipeline: &gst::Pipeline) -> usize {
    let demuxers = elements(pipeline).filter(|element| class_of(element).contains("Demux"));
    demuxers.map(|demuxer| usize::from(demuxer.num_src_pads())).sum()
}

pub(crate) fn is_decoder(element: &gst::Element) -> bool {
    let class = class_of(element);
    class.contains("Decoder") && (class.contains("Video") || class.contains("Image"))
}

fn class_of(element: &gst::Element) -> String {
    let class = element.factory().and_then(|factory| factory.metadata("klass").map(str::to_owned));
    class.unwrap_or_default()
}
