//! Rear part of the pipeline: from the decoder to the mailbox.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use flockeye_runtime::clock::monotonic_ns;
use flockeye_runtime::lock::lock;
use gstreamer as gst;
use gstreamer::prelude::*;
use gstreamer_app as gst_app;
use gstreamer_video as gst_video;

use crate::arrivals::Arrivals;
use crate::census::Census;
use crate::decoder::Threading;
use crate::explain::Failure;
use crate::holding::DecoderWatch;
use crate::input::{Input, element};
use crate::late_frames::LateFrames;
use crate::mailbox::Mailbox;
use crate::packet_tap::PacketTap;
use crate::picture::LUMA_FIRST;
use crate::{CaptureError, decoder};

/// A decoded frame with its times.
#[derive(Debug)]
pub(crate) struct DecodedFrame {
    pub(crate) sample: gst::Sample,
    pub(crate) sequence: u64,
    pub(crate) pts: Option<gst::ClockTime>,
    /// Stream time since the first frame.
    pub(crate) stream_time: Duration,
    /// End of the frame in the stream's own time.
    pub(crate) stream_end: Duration,
    /// Due time by the stream's time stamps, CLOCK_MONOTONIC, nanoseconds.
    pub(crate) due_ns: Option<i64>,
    /// Arrival of the camera's data, CLOCK_MONOTONIC, nanoseconds.
    pub(crate) arrival_ns: i64,
}

/// The mailbox between GStreamer's threads and the consumer.
pub(crate) type Frames = Mailbox<DecodedFrame, Failure>;

/// Builds the pipeline for an input without starting it. Up to `ahead` decoded frames wait before
/// the sink; with 0 the decoder waits.
pub(crate) fn build(
    input: &Input,
    size: (u32, u32),
    threading: Threading,
    ahead: u32,
    packets: &Arc<Mutex<PacketTap>>,
    frames: &Arc<Frames>,
) -> Result<(gst::Pipeline, gst_app::AppSink, Arc<DecoderWatch>), CaptureError> {
    let (pipeline, decodebin) = input.pipeline(size)?;
    // The system clock is CLOCK_MONOTONIC, so the pipeline uses the machine's time.
    pipeline.use_clock(Some(&gst::SystemClock::obtain()));
    decodebin.set_property("caps", gst::Caps::builder("video/x-raw").any_features().build());
    decodebin.set_property("expose-all-streams", false);
    let arrivals = Arrivals::of(&pipeline);
    let decoders = DecoderWatch::new(Arc::clone(&arrivals));
    let (sink, late) = sink(frames, &arrivals, packets);
    // Packets of a recorded flight are not published again.
    let is_tapped = !matches!(input, Input::Flight(..));
    // A description may contain a decoder, whose settings are not changed.
    for element in decoder::elements(&pipeline) {
        decoders.attach(&element);
        if is_tapped {
            PacketTap::attach(packets, &element, &arrivals, &late);
        }
    }
    let watching = Arc::clone(&decoders);
    let (tapping, arrived) = (Arc::clone(packets), Arc::clone(&arrivals));
    pipeline.connect_deep_element_added(move |_, _, element| {
        decoder::configure(element, threading);
        watching.attach(element);
        if is_tapped {
            PacketTap::attach(&tapping, element, &arrived, &late);
        }
    });

    pipeline.add(&sink).map_err(|error| CaptureError::GStreamer(error.to_string()))?;
    let end = match ahead {
        0 => sink.clone().upcast(),
        ahead => waiting_room(&pipeline, &sink, ahead)?,
    };
    let (inside, target, told) = (pipeline.downgrade(), end.downgrade(), Arc::clone(frames));
    decodebin.connect_pad_added(move |_, pad| {
        if let (Some(pipeline), Some(end)) = (inside.upgrade(), target.upgrade())
            && let Err(reason) = join(pad, &pipeline, &end)
        {
            told.fail(Failure::of_ours(&reason));
        }
    });
    watch(&pipeline, Arc::clone(frames));
    Ok((pipeline, sink, decoders))
}

/// Limit for the duration of waiting frames. At a low rate only one frame waits, because an error
/// can overtake waiting frames.
const AHEAD_AT_MOST: gst::ClockTime = gst::ClockTime::from_mseconds(200);

/// Queue of decoded frames before the sink, which takes each when it is due. It compensates varying
/// decoding times, such as longer ones for key frames.
fn waiting_room(
    pipeline: &gst::Pipeline,
    sink: &gst_app::AppSink,
    room: u32,
) -> Result<gst::Element, CaptureError> {
    let queue = element("queue")?;
    queue.set_property("max-size-buffers", room);
    queue.set_property("max-size-bytes", 0_u32);
    queue.set_property("max-size-time", AHEAD_AT_MOST.nseconds());
    pipeline
        .add(&queue)
        .and_then(|()| queue.link(sink))
        .map_err(|error| CaptureError::GStreamer(error.to_string()))?;
    Ok(queue)
}

/// The sink that fills the mailbox. It accepts all formats with a luma plane in system memory.
fn sink(
    frames: &Arc<Frames>,
    arrivals: &Arc<Arrivals>,
    packets: &Arc<Mutex<PacketTap>>,
) -> (gst_app::AppSink, Arc<LateFrames>) {
    let caps = gst_video::VideoCapsBuilder::new().format_list(LUMA_FIRST.iter().copied()).build();
    let sink = gst_app::AppSink::builder()
        .caps(&caps)
        .enable_last_sample(false)
        .qos(false)
        .max_buffers(1)
        .build();
    let late = Arc::new(LateFrames::new(&sink));
    let mut census = Census::default();
    let (frames, ended) = (Arc::clone(frames), Arc::clone(frames));
    let (arrivals, packets, left_out) =
        (Arc::clone(arrivals), Arc::clone(packets), Arc::clone(&late));
    let callbacks = gst_app::AppSinkCallbacks::builder()
        .new_sample(move |sink| {
            let arrival_ns = monotonic_ns();
            let sample = sink.pull_sample().map_err(|_| gst::FlowError::Eos)?;
            census.skip(left_out.take_before(sample.buffer().and_then(gst::BufferRef::pts)));
            let decoded = stamped(sink, sample, &mut census, &arrivals, arrival_ns);
            if decoded.sequence == 0 {
                lock(&packets).begin(census.first);
            }
            match frames.put(decoded) {
                true => Ok(gst::FlowSuccess::Ok),
                false => Err(gst::FlowError::Flushing),
            }
        })
        .eos(move |_| ended.end())
        .build();
    sink.set_callbacks(callbacks);
    // Announce that rows may be padded: otherwise some decoders copy each frame into packed rows.
    if let Some(pad) = sink.static_pad("sink") {
        pad.add_probe(gst::PadProbeType::QUERY_DOWNSTREAM, |_, info| {
            match info.query_mut().map(gst::QueryRef::view_mut) {
                Some(gst::QueryViewMut::Allocation(allocation)) => {
                    allocation.add_allocation_meta::<gst_video::VideoMeta>(None);
                    gst::PadProbeReturn::Handled
                }
                _ => gst::PadProbeReturn::Ok,
            }
        });
    }
    (sink, late)
}

fn stamped(
    sink: &gst_app::AppSink,
    sample: gst::Sample,
    census: &mut Census,
    arrivals: &Arrivals,
    at_sink_ns: i64,
) -> DecodedFrame {
    let pts = sample.buffer().and_then(gst::BufferRef::pts);
    let segment = sample.segment().and_then(|segment| segment.downcast_ref::<gst::ClockTime>());
    let stream = segment.and_then(|segment| segment.to_stream_time(pts)).map(Duration::from);
    let running = segment.and_then(|segment| segment.to_running_time(pts));
    let rate = sample
        .caps()
        .and_then(|caps| gst_video::VideoInfo::from_caps(caps).ok())
        .map(|info| info.fps());
    let frame = rate
        .filter(|rate| rate.numer() > 0 && rate.denom() > 0)
        .map(|rate| Duration::from_secs_f64(f64::from(rate.denom()) / f64::from(rate.numer())));
    let (sequence, stream_time) = census.enter(stream, frame);
    let due_ns = running.and_then(|running| due_ns(sink, running));
    DecodedFrame {
        sample,
        sequence,
        pts,
        stream_time,
        stream_end: stream.unwrap_or(stream_time) + frame.unwrap_or_default(),
        due_ns: due_ns.map(|due_ns| slipped(sink, due_ns, at_sink_ns)),
        arrival_ns: pts.and_then(|pts| arrivals.find(pts)).unwrap_or(at_sink_ns),
    }
}

/// Due time of a frame by its running time, without slips, CLOCK_MONOTONIC, nanoseconds.
pub(crate) fn due_ns(sink: &gst_app::AppSink, running: gst::ClockTime) -> Option<i64> {
    i64::try_from((sink.base_time()? + running).nseconds()).ok()
}

/// Maximum lateness of a paced recording, nanoseconds; beyond it the recording slips.
const SLIP_NS: i64 = 200_000_000;

/// Due time of a frame of a paced recording, with all slips so far.
///
/// If decoding is slower than real time, the lateness would grow without limit. The recording slips
/// instead: it plays slower, and frames have their normal age. GStreamer's QoS, which drops frames
/// in the decoder, would drop nearly all frames that refer to others.
fn slipped(sink: &gst_app::AppSink, due_ns: i64, now_ns: i64) -> i64 {
    if !sink.is_sync() {
        return due_ns;
    }
    let slip_ns = sink.ts_offset();
    let late_ns = now_ns - (due_ns + slip_ns);
    if late_ns <= SLIP_NS {
        return due_ns + slip_ns;
    }
    sink.set_ts_offset(slip_ns + late_ns);
    now_ns
}

/// Links a decoded stream to the pipeline's end, with a conversion to gray if it has no luma plane.
/// Further video streams of a file are ignored.
fn join(pad: &gst::Pad, pipeline: &gst::Pipeline, end: &gst::Element) -> Result<(), String> {
    let Some(start) = end.static_pad("sink").filter(|pad| !pad.is_linked()) else {
        return Ok(());
    };
    let caps = pad.current_caps().unwrap_or_else(|| pad.query_caps(None));
    let has_luma = caps.iter().any(|structure| {
        structure
            .get::<&str>("format")
            .is_ok_and(|format| LUMA_FIRST.iter().any(|luma| luma.to_str() == format))
    });
    if has_luma && pad.link(&start).is_ok() {
        return Ok(());
    }
    let convert = element("videoconvert").map_err(|error| error.to_string())?;
    let gray = element("capsfilter").map_err(|error| error.to_string())?;
    let format = gst_video::VideoCapsBuilder::new().format(gst_video::VideoFormat::Gray8).build();
    gray.set_property("caps", format);
    let joined = || -> Result<(), gst::glib::BoolError> {
        pipeline.add_many([&convert, &gray])?;
        gst::Element::link_many([&convert, &gray, end])?;
        convert.sync_state_with_parent()?;
        gray.sync_state_with_parent()
    };
    joined().map_err(|error| error.to_string())?;
    let intake = convert.static_pad("sink").ok_or("videoconvert has no input")?;
    pad.link(&intake)
        .map_err(|error| format!("video of the kind {caps} cannot be used: {error}"))?;
    Ok(())
}

/// Forwards messages of the pipeline's bus to the mailbox, in the sending thread.
fn watch(pipeline: &gst::Pipeline, frames: Arc<Frames>) {
    let Some(bus) = pipeline.bus() else { return };
    let undecodable = Mutex::new(None);
    bus.set_sync_handler(move |_, message| {
        match message.view() {
            gst::MessageView::AsyncDone(_) => frames.set_ready(),
            gst::MessageView::Error(error) => {
                frames
                    .fail(Failure { error: error.error(), undecodable: lock(&undecodable).take() });
            }
            gst::MessageView::Element(element) => {
                if let Some(structure) =
                    element.structure().filter(|structure| structure.name() == "missing-plugin")
                {
                    let name = structure.get::<String>("name").ok();
                    *lock(&undecodable) = name;
                }
            }
            _ => {}
        }
        gst::BusSyncReply::Drop
    });
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use flockeye_config::Flow;
    use std::time::Instant;

    /// Largest number of decoded frames that wait before a sink with due times. The measurement
    /// ends at `expected`. `None` without a queue.
    fn waiting(frames_per_second: u32, ahead: u32, expected: u32) -> Option<u32> {
        gst::init().unwrap();
        let frames = Arc::new(Frames::new(1, Flow::Latest));
        let source = format!(
            "videotestsrc ! video/x-raw,format=GRAY8,width=64,height=32,framerate={frames_per_second}/1"
        );
        let input = Input::Description(source);
        let threading = Threading::Chosen(0);
        let packets = PacketTap::new(Arc::default());
        let (pipeline, sink, _) =
            build(&input, (64, 32), threading, ahead, &packets, &frames).unwrap();
        sink.set_sync(true);
        let is_waiting_room = |element: &gst::Element| {
            element.factory().is_some_and(|factory| factory.name() == "queue")
        };
        pipeline.set_state(gst::State::Playing).unwrap();
        assert!(frames.wait_ready(Duration::from_secs(30)).unwrap());
        let room = pipeline.children().into_iter().find(is_waiting_room);
        let level = |room: &gst::Element| room.property::<u32>("current-level-buffers");
        let until = Instant::now() + Duration::from_secs(30);
        let mut most = room.as_ref().map(level);
        while most.is_some_and(|most| most < expected) && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(1));
            most = most.max(room.as_ref().map(level));
        }
        pipeline.set_state(gst::State::Null).unwrap();
        most
    }

    #[test]
    fn frames_are_decoded_ahead_of_their_time_where_that_is_asked_for() {
        assert_eq!(waiting(30, 4, 4), Some(4));
        assert_eq!(waiting(1, 4, 1), Some(1), "those that are far apart one at a time");
        assert_eq!(waiting(30, 0, 0), None);
    }
}
