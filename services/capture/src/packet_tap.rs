//! Coded pictures of a source, taken before the decoder while packets have a subscriber.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use flockeye_contract::VideoCodec;
use flockeye_runtime::clock::monotonic_ns;
use flockeye_runtime::lock::lock;
use gstreamer as gst;
use gstreamer::prelude::*;

use crate::arrivals::Arrivals;
use crate::byte_stream::ByteStream;
use crate::decoder;
use crate::late_frames::LateFrames;

/// Limit for the size of waiting packets, bytes: beyond it the oldest are dropped.
const MOST_BYTES: usize = 64_000_000;

/// A coded picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Packet {
    /// Presentation time since the stream's first frame, nanoseconds.
    pub stream_ns: i64,
    /// Arrival of its data, CLOCK_MONOTONIC, nanoseconds.
    pub arrived_ns: i64,
    /// Sequence number among the stream's packets, in decoding order.
    pub sequence: u64,
    /// Codec.
    pub codec: VideoCodec,
    /// Whether it is a key frame, with which decoding can begin.
    pub is_key: bool,
    /// Byte stream of Annex B, with the parameter sets before a key frame.
    pub bytes: Vec<u8>,
}

/// The packets of one pipeline, from GStreamer's thread to the consumer's.
#[derive(Debug, Default)]
pub(crate) struct PacketTap {
    /// Whether packets have a subscriber.
    are_wanted: Arc<AtomicBool>,
    /// The decoder's input format, with codec and converter. `None`: no packets can be made from
    /// this format.
    stream: Option<(gst::Caps, Option<(VideoCodec, ByteStream)>)>,
    /// Stream time of the first decoded frame, nanoseconds.
    origin_ns: Option<i64>,
    next_sequence: u64,
    /// Packets that were not taken yet, with the stream's own times.
    waiting: VecDeque<Packet>,
    waiting_bytes: usize,
}

impl PacketTap {
    pub(crate) fn new(are_wanted: Arc<AtomicBool>) -> Arc<Mutex<Self>> {
        Arc::new(Mutex::new(Self { are_wanted, ..Self::default() }))
    }

    /// Takes the buffers that enter an element, if it is a decoder. While it is behind, those that
    /// no other frame needs go no farther.
    pub(crate) fn attach(
        tap: &Arc<Mutex<Self>>,
        element: &gst::Element,
        arrivals: &Arc<Arrivals>,
        late: &Arc<LateFrames>,
    ) {
        let pads = (element.static_pad("sink"), element.static_pad("src"));
        let (true, (Some(pad), Some(output))) = (decoder::is_decoder(element), pads) else {
            return;
        };
        let decoded = Arc::clone(late);
        output.add_probe(gst::PadProbeType::BUFFER, move |pad, info| {
            info.buffer().into_iter().for_each(|buffer| decoded.note_decoded(pad, buffer));
            gst::PadProbeReturn::Ok
        });
        let (tap, arrivals, late) = (Arc::clone(tap), Arc::clone(arrivals), Arc::clone(late));
        pad.add_probe(gst::PadProbeType::BUFFER, move |pad, info| {
            if let (Some(buffer), Some(caps)) = (info.buffer(), pad.current_caps()) {
                let mut tap = lock(&tap);
                tap.enter(pad, caps, buffer, &arrivals);
                // Asked for each frame: it learns the stream's layers, too.
                let is_disposable = tap.is_disposable(buffer);
                if late.must_drop() && is_disposable {
                    late.note(buffer.pts());
                    // With `Drop`, GStreamer would release the buffer again.
                    return gst::PadProbeReturn::Handled;
                }
            }
            gst::PadProbeReturn::Ok
        });
    }

    fn enter(
        &mut self,
        pad: &gst::Pad,
        caps: gst::Caps,
        buffer: &gst::BufferRef,
        arrivals: &Arrivals,
    ) {
        if self.stream.as_ref().is_none_or(|(known, _)| *known != caps) {
            let codec = codec_of(&caps);
            let is_other = self.stream.as_ref().is_some_and(|(_, known)| known.is_some());
            if codec.is_none() && is_other {
                // A second decoder, after the first: ignored.
                return;
            }
            let stream = codec.and_then(|codec| {
                let data = codec_data(&caps);
                ByteStream::new(codec, data.as_deref()).ok().map(|stream| (codec, stream))
            });
            self.stream = Some((caps, stream));
        }
        let Some((_, Some((codec, stream)))) = &mut self.stream else { return };
        let codec = *codec;
        let is_key = !buffer.flags().contains(gst::BufferFlags::DELTA_UNIT);
        let made = self.are_wanted.load(Ordering::Relaxed).then(|| {
            let map = buffer.map_readable().ok()?;
            stream.packet(map.as_slice(), is_key).ok()
        });
        let sequence = self.next_sequence;
        self.next_sequence += 1;
        let place = buffer.pts().and_then(|pts| Some((pts, stream_ns(pad, pts)?)));
        // An unusable packet is dropped, so its number is missing.
        let (Some(Some(bytes)), Some((pts, stream_ns))) = (made, place) else { return };
        let arrived_ns = arrivals.find(pts).unwrap_or_else(monotonic_ns);
        self.waiting_bytes += bytes.len();
        self.waiting.push_back(Packet { stream_ns, arrived_ns, sequence, codec, is_key, bytes });
        while self.waiting_bytes > MOST_BYTES {
            let Some(oldest) = self.waiting.pop_front() else { break };
            self.waiting_bytes -= oldest.bytes.len();
        }
    }

    /// Whether no other frame refers to one of the last stream.
    fn is_disposable(&mut self, buffer: &gst::BufferRef) -> bool {
        let Some((_, Some((_, stream)))) = &mut self.stream else { return false };
        buffer.map_readable().is_ok_and(|bytes| stream.is_disposable(bytes.as_slice()))
    }

    /// Notes that the first frame was decoded, and its stream time.
    pub(crate) fn begin(&mut self, origin: Duration) {
        let origin_ns = i64::try_from(origin.as_nanos()).unwrap_or(i64::MAX);
        self.origin_ns.get_or_insert(origin_ns);
    }

    /// Takes the packets since the last call. Returns none before the first frame is decoded,
    /// because their times start there.
    pub(crate) fn take(&mut self) -> Vec<Packet> {
        let Some(origin_ns) = self.origin_ns else { return Vec::new() };
        self.waiting_bytes = 0;
        let from_origin = |packet: Packet| Packet {
            stream_ns: packet.stream_ns.saturating_sub(origin_ns),
            ..packet
        };
        std::mem::take(&mut self.waiting).into_iter().map(from_origin).collect()
    }

    /// Codec of the pictures; `None` while it is unknown.
    pub(crate) fn codec(&self) -> Option<VideoCodec> {
        match &self.stream {
            Some((_, Some((codec, _)))) => Some(*codec),
            _ => self.origin_ns.map(|_| VideoCodec::None),
        }
    }
}

/// Codec of a format whose buffers have one picture each; `None` for other formats.
fn codec_of(caps: &gst::Caps) -> Option<VideoCodec> {
    let structure = caps.structure(0)?;
    let codec = match structure.name().as_str() {
        "video/x-h264" => VideoCodec::H264,
        "video/x-h265" => VideoCodec::H265,
        _ => return None,
    };
    (structure.get::<&str>("alignment") == Ok("au")).then_some(codec)
}

/// The stream's `codec_data`, which describes its units; `None` for a byte stream.
fn codec_data(caps: &gst::Caps) -> Option<Vec<u8>> {
    let structure = caps.structure(0)?;
    if structure.get::<&str>("stream-format") == Ok("byte-stream") {
        return None;
    }
    let buffer: gst::Buffer = structure.get("codec_data").ok()?;
    Some(buffer.map_readable().ok()?.as_slice().to_vec())
}

/// The segment of a pad's buffers, if it is one of times.
pub(crate) fn segment_of(pad: &gst::Pad) -> Option<gst::FormattedSegment<gst::ClockTime>> {
    let event = pad.sticky_event::<gst::event::Segment>(0)?;
    event.segment().downcast_ref::<gst::ClockTime>().cloned()
}

/// Stream time of a time stamp, nanoseconds.
fn stream_ns(pad: &gst::Pad, pts: gst::ClockTime) -> Option<i64> {
    let segment = segment_of(pad)?;
    let place = segment.to_stream_time_full(pts)?;
    let ns = i64::try_from(place.abs().nseconds()).ok()?;
    Some(if place.is_negative() { -ns } else { ns })
}
