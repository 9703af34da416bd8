//! A recording of a flight, read as a source: its pictures with the stamps that they had, and the
//! samples of its inertial sensor.
//!
//! Messages stand about in the order in which they were sent. What belongs to a picture may stand
//! behind it: samples that cover its exposure, and the stamp of a frame that had yet to be decoded.
//! The tape reads on until that is there.

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
    ContractMessage, Ending, Reader, RecordedMessage, RecordingError, TopicLayout, definition,
    layouts,
};

mod item;

pub(crate) use self::item::{CodedPicture, Coding, Epoch, TapeItem, TapeSample};

use super::jpeg;
use crate::CaptureError;

/// Limit for how far behind a picture its stamp and samples stand, by the time at which they were
/// recorded.
const BEHIND_NS: u64 = 1_000_000_000;
/// Limit for the bytes of pictures that wait for what belongs to them.
const MOST_WAITING_BYTES: usize = 256_000_000;
/// Frames whose packets may still come.
const MOST_HEADERS: usize = 1024;
/// Reach of the samples beyond an exposure whose length is not known.
const BEYOND_NS: i64 = 10_000_000;

/// A recording that is being read.
pub(crate) struct Tape {
    path: PathBuf,
    reader: Reader,
    frames: Arc<ContractChannel>,
    packets: Arc<ContractChannel>,
    imus: Arc<ContractChannel>,
    wants_samples: bool,
    latency_ns: i64,
    /// The frame whose picture comes next, and the packet whose bytes do.
    header: Option<FrameHeader>,
    packet: Option<PacketHeader>,
    /// Frames by their place in their stream, for packets.
    headers: BTreeMap<(Epoch, i64), FrameHeader>,
    newest_frame: Option<(Epoch, i64)>,
    /// The packet that continues those before; `None`: a key frame is waited for.
    next_packet: Option<(Epoch, u64)>,
    waiting: VecDeque<WaitingItem>,
    waiting_bytes: usize,
    samples: Vec<TapeSample>,
    newest_sample: Option<TapeSample>,
    newest_utc_ns: u64,
    /// The clock of exposures less that of the stream, of the first frame.
    zero_ns: Option<i64>,
    put_back: Option<CodedPicture>,
    coding: Option<Coding>,
    has_views: bool,
    has_frames: bool,
    has_ended: bool,
    /// Why it ended before its end.
    fault: Option<String>,
}

/// Messages of the contract, and their definition.
struct ContractChannel {
    layout: TopicLayout,
    definition: String,
}

/// Something that waits for what belongs to it.
struct WaitingItem {
    utc_ns: u64,
    what: PendingItem,
}

enum PendingItem {
    Damaged { what: String, why: String },
    Jpeg { header: FrameHeader, bytes: Vec<u8> },
    Packet { header: PacketHeader, coding: Coding, bytes: Vec<u8> },
}

impl Tape {
    /// Opens a recording. `samples`: those of the inertial sensor are wanted, which reach as far
    /// beyond an exposure as `latency`.
    pub(crate) fn open(
        path: &Path,
        samples: bool,
        latency: Duration,
    ) -> Result<Self, CaptureError> {
        let reader = Reader::open(path).map_err(|error| match error {
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
            Ok::<_, CaptureError>(Arc::new(ContractChannel { layout, definition }))
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
            coding: None,
            has_views: false,
            has_frames: false,
            has_ended: false,
            fault: None,
        };
        // What keeps it from being played is found now.
        let mut damaged = VecDeque::new();
        loop {
            match tape.next() {
                TapeItem::Coded(coded) => {
                    tape.put_back(coded);
                    break;
                }
                TapeItem::Damaged { what, why } => damaged.push_back((what, why)),
                TapeItem::End => return Err(tape.without_pictures(damaged.pop_front())),
            }
        }
        for (what, why) in damaged.into_iter().rev() {
            tape.wait_for(PendingItem::Damaged { what, why }, true);
        }
        Ok(tape)
    }

    /// Why there is nothing to play.
    fn without_pictures(&mut self, damaged: Option<(String, String)>) -> CaptureError {
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

    /// How the pictures are coded.
    pub(crate) fn coding(&self) -> Coding {
        self.coding.unwrap_or(Coding::Jpeg)
    }

    /// Why it ended before its end, once it has.
    pub(crate) fn fault(&self) -> Option<&str> {
        self.fault.as_deref()
    }

    /// Gives back a picture: it comes next again.
    pub(crate) fn put_back(&mut self, coded: CodedPicture) {
        self.put_back = Some(coded);
    }

    /// The samples that were read since the last time. Those of a picture are there when it is.
    pub(crate) fn take_samples(&mut self) -> Vec<TapeSample> {
        std::mem::take(&mut self.samples)
    }

    /// How far samples reach beyond the middle of an exposure: what has been measured when the
    /// picture is there.
    pub(crate) fn reach_ns(&self, header: &FrameHeader) -> i64 {
        let half_ns = i64::try_from(header.exposure_time_ns / 2).unwrap_or(i64::MAX);
        self.latency_ns.saturating_add(if half_ns > 0 { half_ns } else { BEYOND_NS })
    }

    /// The next picture, in the order in which pictures are decoded.
    pub(crate) fn next(&mut self) -> TapeItem {
        if let Some(coded) = self.put_back.take() {
            return TapeItem::Coded(coded);
        }
        loop {
            if self.has_ended || self.waiting.front().is_some_and(|front| self.is_complete(front)) {
                return self
                    .waiting
                    .pop_front()
                    .map_or(TapeItem::End, |front| self.come(front.what));
            }
            self.read();
        }
    }

    /// Whether all is there that belongs to it.
    fn is_complete(&self, waiting: &WaitingItem) -> bool {
        let is_old = self.newest_utc_ns >= waiting.utc_ns.saturating_add(BEHIND_NS);
        let has_samples = |header: &FrameHeader| {
            let until_ns = header.stamp.exposure_ns.saturating_add(self.reach_ns(header));
            let newest_ns = self.newest_sample.map(|newest| newest.sample.at_ns);
            !self.wants_samples || is_old || newest_ns.is_some_and(|newest| newest >= until_ns)
        };
        if self.waiting_bytes > MOST_WAITING_BYTES {
            return true;
        }
        match &waiting.what {
            PendingItem::Damaged { .. } => true,
            PendingItem::Jpeg { header, .. } => has_samples(header),
            PendingItem::Packet { header, .. } => {
                let place = place_of(header);
                match self.headers.get(&place) {
                    Some(header) => has_samples(header),
                    // Frames are published in the order in which they are shown.
                    None => self.newest_frame.is_some_and(|newest| newest > place),
                }
            }
        }
    }

    /// Something has waited for long enough.
    fn come(&mut self, what: PendingItem) -> TapeItem {
        let (epoch, coding, time_ns, header, bytes) = match what {
            PendingItem::Damaged { what, why } => return TapeItem::Damaged { what, why },
            PendingItem::Jpeg { header, bytes } => {
                let epoch = (header.stamp.source_generation, header.stamp.epoch);
                (epoch, Coding::Jpeg, header.stamp.exposure_ns, Some(header), bytes)
            }
            PendingItem::Packet { header, coding, bytes } => {
                let place @ (epoch, time_ns) = place_of(&header);
                (epoch, coding, time_ns, self.headers.remove(&place), bytes)
            }
        };
        self.waiting_bytes = self.waiting_bytes.saturating_sub(bytes.len());
        // In a recorded lossless flight both clocks are one.
        let header = header.map(|mut header| {
            let stamp = &mut header.stamp;
            let apart_ns = stamp.exposure_ns.saturating_sub(stamp.stream_ns);
            let zero_ns = *self.zero_ns.get_or_insert(apart_ns);
            stamp.stream_ns = stamp.exposure_ns.saturating_sub(zero_ns);
            header
        });
        TapeItem::Coded(CodedPicture { epoch, coding, time_ns, header, bytes })
    }

    /// Reads one message.
    fn read(&mut self) {
        match self.reader.next_message() {
            Ok(Some(message)) => {
                self.newest_utc_ns = self.newest_utc_ns.max(message.utc_ns);
                if let Err(why) = self.on(&message) {
                    let what = format!("{}, message {}", message.channel.topic, message.sequence);
                    self.wait_for(PendingItem::Damaged { what, why }, false);
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

    /// Goes on with the next file of a recording that was split.
    fn end_part(&mut self) {
        match self.reader.next_part() {
            Ok(Some(reader)) => self.reader = reader,
            Ok(None) => self.end(None),
            Err(error) => self.end(Some(error.to_string())),
        }
    }

    fn wait_for(&mut self, what: PendingItem, is_first: bool) {
        if let PendingItem::Jpeg { bytes, .. } | PendingItem::Packet { bytes, .. } = &what {
            self.waiting_bytes += bytes.len();
        }
        let waiting = WaitingItem { utc_ns: self.newest_utc_ns, what };
        match is_first {
            true => self.waiting.push_front(waiting),
            false => self.waiting.push_back(waiting),
        }
    }

    /// Takes a message. The error is the reason why it cannot be used.
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

    /// The message of a topic; `None`, and the recording ends, if it is of another version.
    fn understand(
        &mut self,
        known: &ContractChannel,
        message: &RecordedMessage,
    ) -> Result<Option<ContractMessage>, String> {
        if message.channel.definition != known.definition {
            let contract = self.reader.about().metadata.get("contract");
            let contract = contract.map_or("unknown", String::as_str);
            let path = self.path.display();
            self.end(Some(format!(
                "{path} is a recording by another version of Flockeye: its contract is {contract}, this one's \
                 {CONTRACT_VERSION}. Cure: play it with the version that recorded it"
            )));
            return Ok(None);
        }
        decode(&known.layout, &message.bytes).map(Some).map_err(|error| error.to_string())
    }

    fn on_image(&mut self, message: &RecordedMessage) -> Result<(), String> {
        if !matches!(self.coding, None | Some(Coding::Jpeg)) {
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
        self.coding = Some(Coding::Jpeg);
        self.wait_for(PendingItem::Jpeg { header, bytes: image.bytes.to_vec() }, false);
        Ok(())
    }

    fn on_video(&mut self, message: &RecordedMessage) -> Result<(), String> {
        let header = self.packet.take().ok_or("no header of a packet stands before it")?;
        let video = decode_video(FRAME_VIDEO, &message.bytes).map_err(|error| error.to_string());
        let checked =
            video.and_then(|video| match (header.check(video.bytes), video.format, header.codec) {
                (Err(error), _, _) => Err(error.to_string()),
                (Ok(()), "h264", codec) if codec == VideoCodec::H264.code() => {
                    Ok((Coding::H264, video.bytes))
                }
                (Ok(()), "h265", codec) if codec == VideoCodec::H265.code() => {
                    Ok((Coding::H265, video.bytes))
                }
                (Ok(()), format, _) => Err(format!("its format is {format}, its header's another")),
            });
        // What rests on a picture that is missing would be decoded to nonsense.
        let place = (place_of(&header).0, header.sequence);
        let continues = header.is_key == 1 || self.next_packet == Some(place);
        let (coding, bytes) = match checked {
            Ok(checked) => checked,
            Err(why) => {
                self.next_packet = None;
                return Err(why);
            }
        };
        if self.coding.is_some_and(|known| known != coding) {
            return Ok(());
        }
        if !continues {
            self.next_packet = None;
            return match self.coding {
                // A recording that was begun in flight.
                None => Ok(()),
                Some(_) => Err("packets before it are missing, so it cannot be decoded".to_owned()),
            };
        }
        self.coding = Some(coding);
        self.next_packet = Some((place.0, header.sequence.wrapping_add(1)));
        self.wait_for(PendingItem::Packet { header, coding, bytes: bytes.to_vec() }, false);
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
            let is_later = self
                .newest_sample
                .is_none_or(|newest| newest.epoch != epoch || newest.sample.at_ns < sample.at_ns);
            if is_later {
                let sample = TapeSample { epoch, sample };
                self.newest_sample = Some(sample);
                self.samples.push(sample);
            }
        }
        Ok(())
    }
}

/// Where the frame of a packet is among all frames.
fn place_of(packet: &PacketHeader) -> (Epoch, i64) {
    ((packet.source_generation, packet.epoch), packet.stream_ns)
}

#[cfg(test)]
mod tests;
