//! The decoder that GStreamer chose, and its settings.

use flockeye_config::Flow;
use gstreamer as gst;
use gstreamer::prelude::*;

use crate::input::Input;
use crate::parameters::SourceParameters;

/// Threading of a software decoder.
///
/// libav's decoders have two modes. Frame threads use all processors, but add a latency of one
/// frame per further thread. Slice threads add no latency, but are fast only for streams with
/// several slices. The default is frame threads unless the source is live, which not every camera's
/// driver announces.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Threading {
    /// Mode chosen by the decoder, with this many threads; 0: number chosen by the decoder.
    Chosen(u32),
    /// Slice threads.
    Slices,
    /// Frame threads, and their number.
    Frames(u32),
}

impl Threading {
    /// Threading for an input, with the configured number of threads.
    pub(crate) fn of(input: &Input, params: &SourceParameters) -> Self {
        match (params.flow, input.is_camera(), params.decoder_threads) {
            (Flow::Latest, true, 0) => Self::Slices,
            (Flow::Latest, true, threads) if threads > 1 => Self::Frames(threads),
            (_, _, threads) => Self::Chosen(threads),
        }
    }

    /// Faster threading, with one more frame of latency; `None` without a further processor.
    pub(crate) fn faster(self, processors: u32) -> Option<Self> {
        let frames = match self {
            Self::Frames(frames) => frames + 1,
            Self::Slices | Self::Chosen(_) => 2,
        };
        (frames <= processors).then_some(Self::Frames(frames))
    }
}

/// Configures a new element of the decoding bin.
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
        // Property of libav's decoders, and of libvpx's decoders.
        for name in ["max-threads", "threads"] {
            set_if_there(element, name, &threads.to_string());
        }
    }
    if let Some(kind) = kind {
        set_if_there(element, "thread-type", kind);
    }
    // The default, ifast, has errors of several code values and is hardly faster.
    set_if_there(element, "idct-method", "islow");
}

fn set_if_there(element: &gst::Element, name: &str, value: &str) {
    if element.find_property(name).is_some() {
        element.set_property_from_str(name, value);
    }
}

/// Names of the decoders in use, each with `(hardware)` or `(software)`.
pub(crate) fn chosen(pipeline: &gst::Pipeline) -> Vec<String> {
    let name = |element: gst::Element| {
        let kind = if class_of(&element).contains("Hardware") { "hardware" } else { "software" };
        element.factory().map(|factory| format!("{} ({kind})", factory.name()))
    };
    elements(pipeline).filter(is_decoder).filter_map(name).collect()
}

/// Whether a decoder in use decodes video, not single images such as JPEG or PNG.
pub(crate) fn takes_video(pipeline: &gst::Pipeline) -> bool {
    let takes_images = |element: gst::Element| {
        let caps = element.static_pad("sink").and_then(|pad| pad.current_caps());
        caps.and_then(|caps| Some(caps.structure(0)?.name().starts_with("image/"))) == Some(true)
    };
    !elements(pipeline).filter(is_decoder).all(takes_images)
}

/// All elements of a pipeline, also within bins.
pub(crate) fn elements(pipeline: &gst::Pipeline) -> impl Iterator<Item = gst::Element> + use<> {
    pipeline.iterate_recurse().into_iter().map_while(Result::ok)
}

/// Number of streams of the file's demuxer; 0 without a demuxer.
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
