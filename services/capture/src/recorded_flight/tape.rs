//! Reader of a recorded flight: pictures with their recorded stamps, and inertial samples.
//!
//! Messages are roughly in the order of sending. Data of a picture may follow it: samples of its
//! exposure, and the stamp of a frame that was decoded later. The tape reads ahead until this data
//! is found.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use bytemuck::pod_read_unaligned;
use flockeye_contract::{
    CONTRACT_VERSION, FrameHeader, Frames, ImuHeader, ImuSample, Imus, PacketHeader, Packets,
    Topic, VideoCodec,
};
use flockeye_recording::channel::{FRAME_IMAGES, FRAME_VIDEO, VIEW_IMAGES};
use flockeye_recording::images::{decode_compressed, decode_video};
use flockeye_recording::message::decode;
use flockeye_recording::{
    ContractMessage, Ending, RecordedMessage, RecordingError, RecordingReader, TopicLayout,
    definition, layouts,
};

use super::jpeg;
use crate::CaptureError;
use crate::picture::{Epoch, TapeSample};

/// Maximum time from a picture to its stamp and samples, by recording time, nanoseconds.
const BEHIND_NS: u64 = 1_000_000_000;
/// Limit for the size of pictures that wait for their data, bytes.
const MOST_WAITING_BYTES: usize = 256_000_000;
/// Maximum number of frame headers without a packet.
const MOST_HEADERS: usize = 1024;
/// Reach of the samples beyond an exposure of unknown length, nanoseconds.
const BEYOND_NS: i64 = 10_000_000;

/// A recording during reading.
pub(crate) struct FlightTape {
    path: PathBuf,
    reader: RecordingReader,
    frames: DefinedTopic,
    packets: DefinedTopic,
    imus: DefinedTopic,
    wants_samples: bool,
    latency_ns: i64,
    /// Headers of the frame and of the packet whose pictures come next.
    header: Option<FrameHeader>,
    packet: Option<PacketHeader>,
    /// Frame headers by epoch and stream time, for packets.
    headers: BTreeMap<(Epoch, i64), FrameHeader>,
    newest_frame: Option<(Epoch, i64)>,
    /// Key of the next packet in sequence; `None`: decoding needs a key frame.
    next_packet: Option<(Epoch, u64)>,
    /// Items that wait for their data, with the recording time: UTC, nanoseconds.
    waiting: VecDeque<(u64, TapeItem)>,
    waiting_bytes: usize,
    samples: Vec<TapeSample>,
    newest_sample: Option<TapeSample>,
    newest_utc_ns: u64,
    /// Exposure minus stream time of the first frame, nanoseconds.
    zero_ns: Option<i64>,
    /// A picture that [`Self::next`] returns again.
    pub(crate) put_back: Option<CodedPicture>,
    /// Codec of the pictures; [`VideoCodec::None`]: JPEG.
    codec: Option<VideoCodec>,
    has_views: bool,
    has_frames: bool,
    has_ended: bool,
    /// Reason of an early end, if so.
    pub(crate) fault: Option<String>,
}

#[derive(Debug, PartialEq)]
pub(crate) struct CodedPicture {
    pub(crate) epoch: Epoch,
    /// Codec; [`VideoCodec::None`]: JPEG.
    pub(crate) codec: VideoCodec,
    /// Time in its epoch, nanoseconds: exposure of a JPEG, or stream time of a packet.
    pub(crate) time_ns: i64,
    /// Header of the frame. `None`: the frame was not published, or the packet waits in the tape.
    pub(crate) header: Option<FrameHeader>,
    pub(crate) bytes: Vec<u8>,
}

/// A part of a recording that cannot be used: its name, and the reason. The rest is played.
pub(crate) type Damage = (String, String);

/// The next part of a recording.
type TapeItem = Result<CodedPicture, Damage>;

/// A topic of the contract, and the definition of its messages.
type DefinedTopic = Arc<(TopicLayout, String)>;

impl FlightTape {
    /// Opens a recording. `samples`: whether inertial samples are read; they reach `latency` beyond
    /// an exposure.
    pub(crate) fn open(
        path: &Path,
        samples: bool,
        latency: Duration,
    ) -> Result<Self, CaptureError> {
        let reader = RecordingReader::open(path).map_err(|error| match error {
            RecordingError::File { path, error }
                if error.kind() == std::io::ErrorKind::NotFound =>
            {
                let from = std::env::current_dir().unwrap_or_default();
                CaptureError::Missing { path, from }
            }
            error => CaptureError::Recording(error.to_string()),
        })?;
        let all = layouts();
        let of = |service: &str| {
            let layout = all.iter().find(|layout| layout.service == service).cloned();
            let layout =
                layout.ok_or_else(|| CaptureError::Recording(format!("{service} is no topic")))?;
            let definition = definition::of_topic(&layout);
            Ok::<_, CaptureError>(Arc::new((layout, definition)))
        };
        let mut tape = Self {
            path: path.to_owned(),
            reader,
            frames: of(Frames::NAME)?,
            packets: of(Packets::NAME)?,
            imus: of(Imus::NAME)?,
            wants_samples: samples,
            latency_ns: i64::try_from(latency.as_nanos()).unwrap_or(i64::MAX),
            header: None,
            packet: None,
            headers: BTreeMap::new(),
            newest_frame: None,
            next_packet: None,
            waiting: VecDeque::new(),
            waiting_bytes: 0,
            samples: Vec::new(),
            newest_sample: None,
            newest_utc_ns: 0,
            zero_ns: None,
            put_back: None,
            codec: None,
            has_views: false,
            has_frames: false,
            has_ended: false,
            fault: None,
        };
        // Read up to the first picture, so that errors are found here.
        let mut damaged = VecDeque::new();
        loop {
            match tape.next() {
                Some(Ok(coded)) => {
                    tape.put_back = Some(coded);
                    break;
                }
                Some(Err(damage)) => damaged.push_back(damage),
                None => return Err(tape.without_pictures(damaged.pop_front())),
            }
        }
        for damage in damaged.into_iter().rev() {
            tape.waiting.push_front((tape.newest_utc_ns, Err(damage)));
        }
        Ok(tape)
    }

    /// Error of a recording without pictures.
    fn without_pictures(&mut self, damaged: Option<Damage>) -> CaptureError {
        let reason = match (self.fault.take(), damaged) {
            (Some(fault), _) => return CaptureError::Recording(fault),
            (None, Some((what, why))) => format!("{what}: {why}"),
            (None, None) if self.has_views => {
                "it has the pixels of views alone (--frames views)".to_owned()
            }
            (None, None) if self.has_frames => "it has headers alone (--frames none)".to_owned(),
            (None, None) => "it has no message of a frame".to_owned(),
        };
        CaptureError::NoPictures { path: self.path.clone(), reason }
    }

    /// Codec of the pictures; [`VideoCodec::None`]: JPEG.
    pub(crate) fn codec(&self) -> VideoCodec {
        self.codec.unwrap_or(VideoCodec::None)
    }

    /// Takes the samples read since the last call. The samples of a returned picture are included.
    pub(crate) fn take_samples(&mut self) -> Vec<TapeSample> {
        std::mem::take(&mut self.samples)
    }

    /// Reach of samples beyond the middle of an exposure, nanoseconds: up to the arrival of the
    /// picture.
    pub(crate) fn reach_ns(&self, header: &FrameHeader) -> i64 {
        let half_ns = i64::try_from(header.exposure_time_ns / 2).unwrap_or(i64::MAX);
        self.latency_ns.saturating_add(if half_ns > 0 { half_ns } else { BEYOND_NS })
    }

    /// The next picture in decoding order; `None` at the end.
    pub(crate) fn next(&mut self) -> Option<TapeItem> {
        if let Some(coded) = self.put_back.take() {
            return Some(Ok(coded));
        }
        loop {
            if self.has_ended || self.waiting.front().is_some_and(|front| self.is_complete(front)) {
                let (_, item) = self.waiting.pop_front()?;
                return Some(item.map(|coded| self.complete(coded)));
            }
            self.read();
        }
    }

    /// Whether an item waits no longer: all its data is found, or the limit of the wait is reached.
    fn is_complete(&self, (utc_ns, item): &(u64, TapeItem)) -> bool {
        let is_old = self.newest_utc_ns >= utc_ns.saturating_add(BEHIND_NS);
        let has_samples = |header: &FrameHeader| {
            let until_ns = header.stamp.exposure_ns.saturating_add(self.reach_ns(header));
            let newest_ns = self.newest_sample.map(|(_, newest)| newest.at_ns);
            !self.wants_samples || is_old || newest_ns.is_some_and(|newest| newest >= until_ns)
        };
        if self.waiting_bytes > MOST_WAITING_BYTES {
            return true;
        }
        let Ok(coded) = item else { return true };
        let place = (coded.epoch, coded.time_ns);
        match coded.header.as_ref().or_else(|| self.headers.get(&place)) {
            Some(header) => has_samples(header),
            // Frames are published in presentation order.
            None => self.newest_frame.is_some_and(|newest| newest > place),
        }
    }

    /// Adds the header to a picture, with stream time on the recording's clock.
    fn complete(&mut self, coded: CodedPicture) -> CodedPicture {
        let place = (coded.epoch, coded.time_ns);
        self.waiting_bytes = self.waiting_bytes.saturating_sub(coded.bytes.len());
        // In a recorded lossless flight both clocks are equal.
        let header = coded.header.or_else(|| self.headers.remove(&place)).map(|mut header| {
            let stamp = &mut header.stamp;
            let apart_ns = stamp.exposure_ns.saturating_sub(stamp.stream_ns);
            let zero_ns = *self.zero_ns.get_or_insert(apart_ns);
            stamp.stream_ns = stamp.exposure_ns.saturating_sub(zero_ns);
            header
        });
        CodedPicture { header, ..coded }
    }

    fn read(&mut self) {
        match self.reader.next_message() {
            Ok(Some(message)) => {
                self.newest_utc_ns = self.newest_utc_ns.max(message.utc_ns);
                if let Err(why) = self.on(&message) {
                    let what = format!("{}, message {}", message.channel.topic, message.sequence);
                    self.waiting.push_back((self.newest_utc_ns, Err((what, why))));
                }
            }
            Ok(None) if self.reader.ending() == Some(Ending::Whole) => self.end_part(),
            Ok(None) => {
                let path = self.reader.path().display();
                self.end(Some(format!(
                    "{path} was cut off: its recorder was killed, or the disk was full"
                )));
            }
            Err(error) => self.end(Some(error.to_string())),
        }
    }

    fn end(&mut self, fault: Option<String>) {
        self.has_ended = true;
        self.fault = fault;
    }

    /// Continues with the next file of a split recording.
    fn end_part(&mut self) {
        match self.reader.next_part() {
            Ok(Some(reader)) => self.reader = reader,
            Ok(None) => self.end(None),
            Err(error) => self.end(Some(error.to_string())),
        }
    }

    fn wait_for(&mut self, coded: CodedPicture) {
        self.waiting_bytes += coded.bytes.len();
        self.waiting.push_back((self.newest_utc_ns, Ok(coded)));
    }

    /// Takes a message. The error is the reason of the failure.
    fn on(&mut self, message: &RecordedMessage) -> Result<(), String> {
        match message.channel.topic.as_str() {
            FRAME_IMAGES => self.on_image(message),
            FRAME_VIDEO => self.on_video(message),
            VIEW_IMAGES => {
                self.has_views = true;
                Ok(())
            }
            "/flockeye/frame" => {
                let Some(found) = self.understand(&Arc::clone(&self.frames), message)? else {
                    return Ok(());
                };
                self.header = None;
                let header: FrameHeader = pod_read_unaligned(&found.header);
                let payload = usize::try_from(found.payload_bytes).unwrap_or(usize::MAX);
                header.check(payload).map_err(|error| error.to_string())?;
                let stamp = &header.stamp;
                let place = ((stamp.source_generation, stamp.epoch), stamp.stream_ns);
                self.has_frames = true;
                self.newest_frame = self.newest_frame.max(Some(place));
                self.headers.insert(place, header);
                if self.headers.len() > MOST_HEADERS {
                    self.headers.pop_first();
                }
                self.header = Some(header);
                Ok(())
            }
            "/flockeye/packet" => {
                let Some(found) = self.understand(&Arc::clone(&self.packets), message)? else {
                    return Ok(());
                };
                self.packet = Some(pod_read_unaligned(&found.header));
                Ok(())
            }
            "/flockeye/imu" if self.wants_samples => self.on_samples(message),
            _ => Ok(()),
        }
    }

    /// Decodes the message of a topic. Returns `None` and ends the recording if its contract
    /// version differs.
    fn understand(
        &mut self,
        (layout, definition): &(TopicLayout, String),
        message: &RecordedMessage,
    ) -> Result<Option<ContractMessage>, String> {
        if message.channel.definition != *definition {
            let contract = self.reader.about().metadata.get("contract");
            let contract = contract.map_or("unknown", String::as_str);
            let path = self.path.display();
            self.end(Some(format!(
                "{path} is a recording by another version of Flockeye: its contract is {contract}, this one's \
                 {CONTRACT_VERSION}. Cure: play it with the version that recorded it"
            )));
            return Ok(None);
        }
        decode(layout, &message.bytes).map(Some).map_err(|error| error.to_string())
    }

    fn on_image(&mut self, message: &RecordedMessage) -> Result<(), String> {
        if !matches!(self.codec, None | Some(VideoCodec::None)) {
            return Ok(());
        }
        let header = self.header.take().ok_or("no header of a frame stands before it")?;
        let image = decode_compressed(FRAME_IMAGES, &message.bytes);
        let image = image.map_err(|error| error.to_string())?;
        if image.format != "jpeg" {
            return Err(format!("its format is {}, not jpeg", image.format));
        }
        let size = jpeg::size(image.bytes)?;
        if size != (header.width, header.height) {
            let FrameHeader { width, height, .. } = header;
            return Err(format!("it has {}x{} pixels, not {width}x{height}", size.0, size.1));
        }
        self.codec = Some(VideoCodec::None);
        self.wait_for(CodedPicture {
            epoch: (header.stamp.source_generation, header.stamp.epoch),
            codec: VideoCodec::None,
            time_ns: header.stamp.exposure_ns,
            header: Some(header),
            bytes: image.bytes.to_vec(),
        });
        Ok(())
    }

    fn on_video(&mut self, message: &RecordedMessage) -> Result<(), String> {
        let header = self.packet.take().ok_or("no header of a packet stands before it")?;
        let video = decode_video(FRAME_VIDEO, &message.bytes).map_err(|error| error.to_string());
        let checked =
            video.and_then(|video| match (header.check(video.bytes), video.format, header.codec) {
                (Err(error), _, _) => Err(error.to_string()),
                (Ok(()), "h264", codec) if codec == VideoCodec::H264.code() => {
                    Ok((VideoCodec::H264, video.bytes))
                }
                (Ok(()), "h265", codec) if codec == VideoCodec::H265.code() => {
                    Ok((VideoCodec::H265, video.bytes))
                }
                (Ok(()), format, _) => Err(format!("its format is {format}, its header's another")),
            });
        // After a missing picture, dependent pictures would be decoded wrongly.
        let epoch = (header.source_generation, header.epoch);
        let place = (epoch, header.sequence);
        let continues = header.is_key == 1 || self.next_packet == Some(place);
        let (codec, bytes) = match checked {
            Ok(checked) => checked,
            Err(why) => {
                self.next_packet = None;
                return Err(why);
            }
        };
        if self.codec.is_some_and(|known| known != codec) {
            return Ok(());
        }
        if !continues {
            self.next_packet = None;
            return match self.codec {
                // The recording was started in flight, between key frames.
                None => Ok(()),
                Some(_) => Err("packets before it are missing, so it cannot be decoded".to_owned()),
            };
        }
        self.codec = Some(codec);
        self.next_packet = Some((epoch, header.sequence.wrapping_add(1)));
        let (time_ns, bytes) = (header.stream_ns, bytes.to_vec());
        self.wait_for(CodedPicture { epoch, codec, time_ns, header: None, bytes });
        Ok(())
    }

    fn on_samples(&mut self, message: &RecordedMessage) -> Result<(), String> {
        let Some(found) = self.understand(&Arc::clone(&self.imus), message)? else { return Ok(()) };
        let header: ImuHeader = pod_read_unaligned(&found.header);
        let size = size_of::<ImuSample>();
        let samples: Vec<ImuSample> =
            found.items.chunks_exact(size).map(pod_read_unaligned).collect();
        Imus::check(&header, &samples).map_err(|error| error.to_string())?;
        let epoch = (header.generation, header.epoch);
        for sample in samples {
            let is_later = |(newest_epoch, newest): (Epoch, ImuSample)| {
                newest_epoch != epoch || newest.at_ns < sample.at_ns
            };
            if self.newest_sample.is_none_or(is_later) {
                self.newest_sample = Some((epoch, sample));
                self.samples.push((epoch, sample));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
