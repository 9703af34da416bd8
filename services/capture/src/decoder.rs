//! Which decoder GStreamer chose, and how it is set.

use gstreamer as gst;
use gstreamer::prelude::*;

/// Sets an element of the decoding bin as soon as it is chosen.
pub(crate) fn configure(element: &gst::Element, threads: u32) {
    if !is_decoder(element) {
        return;
    }
    if threads > 0 {
        // libav's decoders have the first, libvpx's the second.
        for name in ["max-threads", "threads"] {
            set_if_there(element, name, &threads.to_string());
        }
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
    let mut names = Vec::new();
    let mut elements = pipeline.iterate_recurse();
    while let Ok(Some(element)) = elements.next() {
        if is_decoder(&element)
            && let Some(factory) = element.factory()
        {
            let kind =
                if class_of(&element).contains("Hardware") { "hardware" } else { "software" };
            names.push(format!("{} ({kind})", factory.name()));
        }
    }
    names
}

/// How many streams the file's demuxer offers; 0 without one.
pub(crate) fn streams(pipeline: &gst::Pipeline) -> usize {
    let mut count = 0;
    let mut elements = pipeline.iterate_recurse();
    while let Ok(Some(element)) = elements.next() {
        if class_of(&element).contains("Demux") {
            count += usize::from(element.num_src_pads());
        }
    }
    count
}

fn is_decoder(element: &gst::Element) -> bool {
    let class = class_of(element);
    class.contains("Decoder") && (class.contains("Video") || class.contains("Image"))
}

fn class_of(element: &gst::Element) -> String {
    let class = element.factory().and_then(|factory| factory.metadata("klass").map(str::to_owned));
    class.unwrap_or_default()
}
