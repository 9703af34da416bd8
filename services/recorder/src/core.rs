//! Conversion of messages to recorded messages and channels. No port, no clock, no file.

use std::sync::Arc;

use flockeye_contract::{
    FrameHeader, PacketHeader, TOPICS, TopicId, Track, TrackHeader, VideoCodec, ViewHeader,
};
use flockeye_recording::images::{Image, encode_compressed, encode_image, encode_video};
use flockeye_recording::losses::{Loss, encode_loss};
use flockeye_recording::message::encode;
use flockeye_recording::{ChannelKind, RecordingError, TopicLayout, layouts, poses};
use flockeye_ros2::messages::Time;
use flockeye_ros2::ros_name;

use crate::jpeg;
use crate::message::TopicMessage;

/// A message of a recording: its channel and its bytes.
pub(crate) type Output = (Arc<ChannelKind>, Vec<u8>);

#[derive(Debug)]
pub(crate) struct Core {
    topics: Vec<(TopicLayout, Arc<ChannelKind>)>,
    view_images: Arc<ChannelKind>,
    frame_images: Arc<ChannelKind>,
    frame_video: Arc<ChannelKind>,
    losses: Arc<ChannelKind>,
    observer: String,
    utc_from_exposure_ns: i64,
}

impl Core {
    /// A core for the messages of the drone `observer`. `utc_from_exposure_ns` is UTC less the
    /// clock of exposure times.
    pub(crate) fn new(observer: &str, utc_from_exposure_ns: i64) -> Self {
        let with_channel = |layout: TopicLayout| {
            let channel = Arc::new(ChannelKind::of_topic(&layout));
            (layout, channel)
        };
        Self {
            topics: layouts().into_iter().map(with_channel).collect(),
            view_images: Arc::new(ChannelKind::of_view_images()),
            frame_images: Arc::new(ChannelKind::of_frame_images()),
            frame_video: Arc::new(ChannelKind::of_frame_video()),
            losses: Arc::new(ChannelKind::of_losses()),
            observer: observer.to_owned(),
            utc_from_exposure_ns,
        }
    }

    /// Recorded messages for a message: the message itself, then messages derived from it.
    pub(crate) fn on(&self, entry: &TopicMessage) -> anyhow::Result<Vec<Output>> {
        let Some((layout, channel)) = self.topics.get(entry.topic) else { return Ok(Vec::new()) };
        let bytes = encode(layout, &entry.message)?;
        let mut outputs = vec![(channel.clone(), bytes)];
        match (TOPICS[entry.topic].id, &entry.pixels) {
            (TopicId::Tracks, _) => outputs.extend(self.poses(entry)?),
            (TopicId::Views, Some(pixels)) => outputs.push(self.view(entry, pixels)),
            (TopicId::Packets, Some(packet)) => outputs.push(self.packet(entry, packet)),
            (TopicId::Frames, Some(pixels)) => outputs.push(self.frame(entry, pixels)?),
            _ => {}
        }
        Ok(outputs)
    }

    /// Message about the losses of a topic.
    pub(crate) fn loss(&self, topic: usize, loss: &Loss) -> Output {
        let name = TOPICS.get(topic).map_or("", |topic| topic.name);
        let bytes = encode_loss(name, loss);
        (self.losses.clone(), bytes)
    }

    fn poses(&self, entry: &TopicMessage) -> Result<Vec<Output>, RecordingError> {
        let header: TrackHeader = header_of(entry);
        let size = size_of::<Track>();
        let tracks: Vec<Track> =
            entry.message.items.chunks_exact(size).map(bytemuck::pod_read_unaligned).collect();
        let stamp_ns = self.utc_ns(header.stamp.exposure_ns);
        let messages = poses::of_tracks(&tracks, stamp_ns, &self.observer)?;
        let output = |(channel, bytes)| (Arc::new(channel), bytes);
        Ok(messages.into_iter().map(output).collect())
    }

    fn view(&self, entry: &TopicMessage, pixels: &[u8]) -> Output {
        let header: ViewHeader = header_of(entry);
        let image =
            Image { width: header.size_px, height: header.size_px, step: header.stride, pixels };
        let stamp = self.time(header.stamp.exposure_ns);
        let bytes = encode_image(stamp, &self.camera(), &image);
        (self.view_images.clone(), bytes)
    }

    fn frame(&self, entry: &TopicMessage, pixels: &[u8]) -> anyhow::Result<Output> {
        let FrameHeader { stamp, width, height, stride, .. } = header_of(entry);
        let jpeg = jpeg::encode(pixels, width, height, stride)?;
        let bytes = encode_compressed(self.time(stamp.exposure_ns), &self.camera(), "jpeg", &jpeg);
        Ok((self.frame_images.clone(), bytes))
    }

    fn packet(&self, entry: &TopicMessage, packet: &[u8]) -> Output {
        let PacketHeader { exposure_ns, codec, .. } = header_of(entry);
        let format = if codec == VideoCodec::H265.code() { "h265" } else { "h264" };
        let bytes = encode_video(self.time(exposure_ns), &self.camera(), format, packet);
        (self.frame_video.clone(), bytes)
    }

    fn camera(&self) -> String {
        format!("{}/camera", ros_name(&self.observer))
    }

    fn utc_ns(&self, exposure_ns: i64) -> i64 {
        exposure_ns.saturating_add(self.utc_from_exposure_ns)
    }

    fn time(&self, exposure_ns: i64) -> Time {
        Time::from_utc_ns(self.utc_ns(exposure_ns)).unwrap_or_default()
    }
}

/// Copy of the header. It has the size of its type, because [`encode`] has checked it.
fn header_of<H: bytemuck::AnyBitPattern>(entry: &TopicMessage) -> H {
    bytemuck::pod_read_unaligned(&entry.message.header)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use bytemuck::Zeroable;
    use flockeye_contract::{FrameStamp, Pose, TrackState};
    use flockeye_recording::ContractMessage;
    use flockeye_recording::images::{decode_image, decode_video};
    use flockeye_recording::message::decode;

    fn place(id: TopicId) -> usize {
        TOPICS.iter().position(|topic| topic.id == id).unwrap()
    }

    fn entry<H: bytemuck::Pod>(id: TopicId, header: &H, items: &[u8]) -> TopicMessage {
        let message = ContractMessage {
            header: bytemuck::bytes_of(header).to_vec(),
            items: items.to_vec(),
            payload_bytes: 0,
        };
        TopicMessage { topic: place(id), at_ns: 5, message, pixels: None }
    }

    #[test]
    fn tracks_are_recorded_as_they_are_and_as_poses() {
        let stamp = FrameStamp { exposure_ns: 1_000_000_123, ..FrameStamp::default() };
        let header = TrackHeader { stamp, ..TrackHeader::default() };
        let track = Track {
            name: "kite".into(),
            state: TrackState::Confirmed.code(),
            observer_from_target: Pose {
                position: [1.5, 0.0, 0.0],
                orientation: [0.0, 0.0, 0.0, 1.0],
            },
            ..Track::zeroed()
        };
        let entry = entry(TopicId::Tracks, &header, bytemuck::bytes_of(&track));
        let core = Core::new("wren-1", 1_700_000_000_000_000_000);
        let outputs = core.on(&entry).unwrap();
        let topics: Vec<_> = outputs.iter().map(|(channel, _)| channel.topic.as_str()).collect();
        assert_eq!(topics, ["/flockeye/track", "/wren_1/neighbours/kite/pose", "/tf"]);
        let layout = &core.topics[entry.topic].0;
        assert_eq!(decode(layout, &outputs[0].1).unwrap(), entry.message);
        assert_eq!(outputs[1].1[4..8], 1_700_000_001_i32.to_le_bytes());
        assert_eq!(outputs[1].1[8..12], 123_u32.to_le_bytes());
    }

    #[test]
    fn pixels_are_recorded_beside_their_header() {
        let header = ViewHeader { size_px: 3, stride: 4, ..ViewHeader::default() };
        let pixels: Vec<u8> = (0..12).collect();
        let view =
            TopicMessage { pixels: Some(pixels.clone()), ..entry(TopicId::Views, &header, &[]) };
        let core = Core::new("wren", 0);
        let outputs = core.on(&view).unwrap();
        assert_eq!(outputs.len(), 2);
        let image = decode_image("x", &outputs[1].1).unwrap();
        assert_eq!((image.width, image.height, image.step), (3, 3, 4));
        assert_eq!(image.pixels, pixels);
        let frame = FrameHeader { width: 8, height: 8, stride: 8, ..FrameHeader::default() };
        let frame =
            TopicMessage { pixels: Some(vec![7; 64]), ..entry(TopicId::Frames, &frame, &[]) };
        let outputs = core.on(&frame).unwrap();
        assert_eq!(outputs[1].0.message, "sensor_msgs/msg/CompressedImage");
        let lying = TopicMessage { pixels: Some(vec![7; 63]), ..frame };
        assert!(core.on(&lying).is_err());
    }

    #[test]
    fn packets_are_recorded_as_they_are() {
        for (codec, format) in [(VideoCodec::H264, "h264"), (VideoCodec::H265, "h265")] {
            let header = PacketHeader {
                codec: codec.code(),
                exposure_ns: 3_000_000_007,
                ..Default::default()
            };
            let bytes = vec![0, 0, 1, 0x65, 9];
            let packet = TopicMessage {
                pixels: Some(bytes.clone()),
                ..entry(TopicId::Packets, &header, &[])
            };
            let outputs = Core::new("wren", 0).on(&packet).unwrap();
            assert_eq!(outputs[0].0.topic, "/flockeye/packet");
            assert_eq!(outputs[1].0.message, "foxglove_msgs/msg/CompressedVideo");
            let video = decode_video("x", &outputs[1].1).unwrap();
            assert_eq!((video.format, video.bytes), (format, &bytes[..]));
            assert_eq!(video.stamp, Time { sec: 3, nanosec: 7 });
        }
    }

    #[test]
    fn what_is_missing_is_written_too() {
        let loss = Loss { recorded: 9, queue_full: 2, ..Loss::default() };
        let (channel, bytes) = Core::new("wren", 0).loss(place(TopicId::Plans), &loss);
        assert_eq!(channel.topic, "/flockeye/recording/loss");
        assert_eq!(&bytes[4..22], b"\x0e\0\0\0flockeye/plan\0");
        assert_eq!(bytes[bytes.len() - 8..], 2_u64.to_le_bytes());
    }
}
