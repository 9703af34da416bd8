//! The coded pictures of a source, taken before the decoder while somebody wants them.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use flockeye_contract::VideoCodec;
use flockeye_runtime::lock::lock;
use gstreamer as gst;
use gstreamer::prelude::*;

use crate::arrivals::Arrivals;
use crate::byte_stream::ByteStream;
use crate::decoder;
use flockeye_runtime::clock::monotonic_ns;

/// Limit for the bytes of packets that nobody has taken: beyond it the oldest are dropped.
const MOST_BYTES: usize = 64_000_000;

/// A coded picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Packet {
    /// When it is shown, from the stream's first frame, nanoseconds.
    pub stream_ns: i64,
    /// When its data came in, CLOCK_MONOTONIC, nanoseconds.
    pub arrived_ns: i64,
    /// Its number among the stream's packets, in the order in which they are decoded.
    pub sequence: u64,
    /// How it is coded.
    pub codec: VideoCodec,
    /// Whether decoding can begin with it.
    pub is_key: bool,
    /// Annex B's byte stream, with the parameter sets before a key frame.
    pub bytes: Vec<u8>,
}

/// Takes the packets of one pipeline.
#[derive(Debug)]
pub(crate) struct PacketTap {
    /// Whether somebody wants packets.
    are_wanted: Arc<AtomicBool>,
    state: Mutex<TapState>,
}

#[derive(Debug, Default)]
struct TapState {
    /// What the decoder takes, and how to make packets of it; `None` if that cannot be done.
    stream: Option<(gst::Caps, Option<(VideoCodec, ByteStream)>)>,
    /// Place of the first decoded frame in the stream, nanoseconds.
    origin_ns: Option<i64>,
    next_sequence: u64,
    /// Their times are the stream's own.
    waiting: VecDeque<Packet>,
    waiting_bytes: usize,
}

impl PacketTap {
    pub(crate) fn new(are_wanted: Arc<AtomicBool>) -> Arc<Self> {
        Arc::new(Self { are_wanted, state: Mutex::default() })
    }

    /// Takes what goes into an element, if that is a decoder.
    pub(crate) fn attach(self: &Arc<Self>, element: &gst::Element, arrivals: &Arc<Arrivals>) {
        let (true, Some(pad)) = (decoder::is_decoder(element), element.static_pad("sink")) else {
            return;
        };
        let (tap, arrivals) = (Arc::clone(self), Arc::clone(arrivals));
        pad.add_probe(gst::PadProbeType::BUFFER, move |pad, info| {
            if let (Some(buffer), Some(caps)) = (info.buffer(), pad.current_caps()) {
                tap.enter(pad, caps, buffer, &arrivals);
            }
            gst::PadProbeReturn::Ok
        });
    }

    fn enter(&self, pad: &gst::Pad, caps: gst::Caps, buffer: &gst::BufferRef, arrivals: &Arrivals) {
        let mut state = lock(&self.state);
        if state.stream.as_ref().is_none_or(|(known, _)| *known != caps) {
            let codec = codec_of(&caps);
            let is_other = state.stream.as_ref().is_some_and(|(_, known)| known.is_some());
            if codec.is_none() && is_other {
                // A second decoder, behind the first.
                return;
            }
            let stream = codec.and_then(|codec| {
                let data = codec_data(&caps);
                ByteStream::new(codec, data.as_deref()).ok().map(|stream| (codec, stream))
            });
            state.stream = Some((caps, stream));
        }
        let TapState { stream: Some((_, Some((codec, stream)))), .. } = &mut *state else { return };
        let codec = *codec;
        let is_key = !buffer.flags().contains(gst::BufferFlags::DELTA_UNIT);
        let made = self.are_wanted.load(Ordering::Relaxed).then(|| {
            let map = buffer.map_readable().ok()?;
            stream.packet(map.as_slice(), is_key).ok()
        });
        let sequence = state.next_sequence;
        state.next_sequence += 1;
        let place = buffer.pts().and_then(|pts| Some((pts, stream_ns(pad, pts)?)));
        // A packet that cannot be used is missing: its number is left out.
        let (Some(Some(bytes)), Some((pts, stream_ns))) = (made, place) else { return };
        let arrived_ns = arrivals.find(pts).unwrap_or_else(monotonic_ns);
        state.waiting_bytes += bytes.len();
        state.waiting.push_back(Packet { stream_ns, arrived_ns, sequence, codec, is_key, bytes });
        while state.waiting_bytes > MOST_BYTES {
            let Some(oldest) = state.waiting.pop_front() else { break };
            state.waiting_bytes -= oldest.bytes.len();
        }
    }

    /// The first frame is decoded: it is there in the stream.
    pub(crate) fn begin(&self, origin: Duration) {
        let origin_ns = i64::try_from(origin.as_nanos()).unwrap_or(i64::MAX);
        lock(&self.state).origin_ns.get_or_insert(origin_ns);
    }

    /// The packets that have come since the last time. There are none before the first frame is
    /// decoded, from which their times count.
    pub(crate) fn take(&self) -> Vec<Packet> {
        let mut state = lock(&self.state);
        let Some(origin_ns) = state.origin_ns else { return Vec::new() };
        state.waiting_bytes = 0;
        let from_origin = |packet: Packet| Packet {
            stream_ns: packet.stream_ns.saturating_sub(origin_ns),
            ..packet
        };
        std::mem::take(&mut state.waiting).into_iter().map(from_origin).collect()
    }

    /// How its pictures are coded; `None` while that is not known.
    pub(crate) fn codec(&self) -> Option<VideoCodec> {
        let state = lock(&self.state);
        match &state.stream {
            Some((_, Some((codec, _)))) => Some(*codec),
            _ => state.origin_ns.map(|_| VideoCodec::None),
        }
    }
}

/// Which codec it is, where each buffer is one picture.
fn codec_of(caps: &gst::Caps) -> Option<VideoCodec> {
    let structure = caps.structure(0)?;
    let codec = match structure.name().as_str() {
        "video/x-h264" => VideoCodec::H264,
        "video/x-h265" => VideoCodec::H265,
        _ => return None,
    };
    (structure.get::<&str>("alignment") == Ok("au")).then_some(codec)
}

/// How units are told apart, as the stream describes it; `None` for a byte stream.
fn codec_data(caps: &gst::Caps) -> Option<Vec<u8>> {
    let structure = caps.structure(0)?;
    if structure.get::<&str>("stream-format") == Ok("byte-stream") {
        return None;
    }
    let buffer: gst::Buffer = structure.get("codec_data").ok()?;
    Some(buffer.map_readable().ok()?.as_slice().to_vec())
}

/// A time stamp's place in the stream, as that of frames, nanoseconds.
fn stream_ns(pad: &gst::Pad, pts: gst::ClockTime) -> Option<i64> {
    let event = pad.sticky_event::<gst::event::Segment>(0)?;
    let segment = event.segment().downcast_ref::<gst::ClockTime>()?;
    let place = segment.to_stream_time_full(pts)?;
    let ns = i64::try_from(place.abs().nseconds()).ok()?;
    Some(if place.is_negative() { -ns } else { ns })
}
