//! The coded pictures of a source, for whoever wants them.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use common::{Scratch, open, parameters, video, watched};
use flockeye_capture::{Event, Packet, SourceParameters};
use flockeye_config::Flow;
use flockeye_contract::VideoCodec;

/// Plays a clip: its packets, the stream times of its frames, and how it is coded.
fn played(clip: &Path, is_wanted: bool) -> (Vec<Packet>, BTreeSet<i64>, Option<VideoCodec>) {
    let packets = Arc::<AtomicBool>::default();
    packets.store(is_wanted, Ordering::Relaxed);
    let mut source = open(clip, SourceParameters { packets, ..parameters(Flow::Lossless) });
    let (mut found, mut times) = (Vec::new(), BTreeSet::new());
    loop {
        let event = source.next(Duration::from_secs(5)).unwrap();
        let codec = source.codec();
        found.extend(source.take_packets());
        match event {
            Event::Frame(picture) => drop(times.insert(picture.facts().stream_ns)),
            Event::Idle => {}
            Event::End(_) => return (found, times, codec),
            other => panic!("{other:?}"),
        }
        assert!(codec.is_some());
        if times.len() == 20 {
            return (found, times, codec);
        }
    }
}

#[test]
fn each_frame_has_its_packet_and_nothing_is_kept_for_nobody() {
    watched(|| {
        let scratch = Scratch::new();
        for (name, encoder, codec) in [
            ("a.mp4", "openh264enc gop-size=8 ! h264parse ! mp4mux", VideoCodec::H264),
            (
                "b.mkv",
                "x265enc speed-preset=ultrafast ! h265parse ! matroskamux offset-to-zero=false",
                VideoCodec::H265,
            ),
        ] {
            let clip = scratch.clip(name, &format!("{} ! {encoder}", video(20, 320, "I420")));
            let (packets, times, known) = played(&clip, true);
            assert_eq!((known, times.len(), packets.len()), (Some(codec), 20, 20), "{name}");
            assert!(packets[0].is_key && packets.iter().any(|packet| !packet.is_key));
            assert!(packets.iter().all(|packet| packet.bytes.starts_with(&[0, 0, 0, 1])));
            let numbers: Vec<u64> = packets.iter().map(|packet| packet.sequence).collect();
            assert_eq!(numbers, (0..20).collect::<Vec<_>>());
            let of_packets: BTreeSet<i64> = packets.iter().map(|packet| packet.stream_ns).collect();
            assert_eq!(of_packets, times, "{name}: times are those of frames");
            let (packets, times, known) = played(&clip, false);
            assert_eq!((packets.len(), times.len(), known), (0, 20, Some(codec)), "{name}");
        }
    });
}

#[test]
fn a_source_without_such_a_codec_says_so() {
    watched(|| {
        let scratch = Scratch::new();
        for encoder in ["jpegenc ! matroskamux", "avenc_ffv1 ! matroskamux"] {
            let clip = scratch.clip("c.mkv", &format!("{} ! {encoder}", video(20, 320, "I420")));
            let (packets, _, codec) = played(&clip, true);
            assert_eq!((packets.len(), codec), (0, Some(VideoCodec::None)), "{encoder}");
        }
    });
}
