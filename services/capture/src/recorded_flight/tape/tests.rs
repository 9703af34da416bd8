#![allow(clippy::unwrap_used)]

use super::*;
use flockeye_contract::FrameStamp;
use flockeye_recording::file::RecordingFile;
use flockeye_recording::images::{encode_compressed, encode_video};
use flockeye_recording::message::encode;
use flockeye_recording::{About, ChannelKind, RecordingWriter};
use flockeye_ros2::messages::Time;

const MS: i64 = 1_000_000;

/// A recording that is being made.
struct Deck {
    folder: tempfile::TempDir,
    writer: RecordingWriter,
}

impl Deck {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let file = RecordingFile::create(&folder.path().join("flight.mcap")).unwrap();
        let writer = RecordingWriter::begin(file, &About::default()).unwrap();
        Self { folder, writer }
    }

    fn message<T: Topic>(&mut self, at_ms: i64, header: &T::Header, items: &[T::Item], bytes: u64) {
        let layout = layouts().into_iter().find(|layout| layout.service == T::NAME).unwrap();
        let message = ContractMessage {
            header: bytemuck::bytes_of(header).to_vec(),
            items: if bytes > 0 { Vec::new() } else { bytemuck::cast_slice(items).to_vec() },
            payload_bytes: bytes,
        };
        let cdr = encode(&layout, &message).unwrap();
        self.writer.write(&ChannelKind::of_topic(&layout), at_ms * MS, &cdr).unwrap();
    }

    fn header(&mut self, at_ms: i64, sequence: u64, stream_ns: i64, exposure_ns: i64) {
        let stamp = FrameStamp { sequence, stream_ns, exposure_ns, ..FrameStamp::default() };
        let (width, height, stride) = (4, 2, 4);
        let exposure_time_ns = 6_000_000;
        let header = FrameHeader {
            stamp,
            exposure_time_ns,
            width,
            height,
            stride,
            ..FrameHeader::default()
        };
        self.message::<Frames>(at_ms, &header, &[], 8);
    }

    fn image(&mut self, at_ms: i64, bytes: &[u8]) {
        let cdr = encode_compressed(Time::default(), "c", "jpeg", bytes);
        self.writer.write(&ChannelKind::of_frame_images(), at_ms * MS, &cdr).unwrap();
    }

    fn samples(&mut self, at_ms: i64, epoch: u32, times_ms: &[i64]) {
        let sample = |&ms: &i64| ImuSample { at_ns: ms * MS, ..ImuSample::default() };
        let samples: Vec<ImuSample> = times_ms.iter().map(sample).collect();
        let header = ImuHeader { epoch, ..ImuHeader::default() };
        self.message::<Imus>(at_ms, &header, &samples, 0);
    }

    fn packet(&mut self, at_ms: i64, sequence: u64, stream_ns: i64, is_key: bool) {
        let codec = VideoCodec::H264.code();
        let is_key = u32::from(is_key);
        let header = PacketHeader { stream_ns, sequence, codec, is_key, ..PacketHeader::default() };
        let bytes = [0, 0, 1, sequence as u8];
        self.message::<Packets>(at_ms, &header, &[], 4);
        let cdr = encode_video(Time::default(), "c", "h264", &bytes);
        self.writer.write(&ChannelKind::of_frame_video(), at_ms * MS, &cdr).unwrap();
    }

    fn play(self, samples: bool) -> (tempfile::TempDir, Result<FlightTape, CaptureError>) {
        let path = self.folder.path().join("flight.mcap");
        self.writer.finish().unwrap();
        (self.folder, FlightTape::open(&path, samples, Duration::ZERO))
    }
}

/// The smallest that is taken for a JPEG of 4x2 pixels.
const PICTURE: [u8; 17] = [0xFF, 0xD8, 0xFF, 0xC0, 0, 11, 8, 0, 2, 0, 4, 1, 1, 0x11, 0, 0xFF, 0xD9];

fn coded(tape: &mut FlightTape) -> CodedPicture {
    match tape.next() {
        Some(Ok(coded)) => coded,
        other => panic!("{other:?}"),
    }
}

fn times_ms(samples: &[TapeSample]) -> Vec<i64> {
    samples.iter().map(|(_, sample)| sample.at_ns / MS).collect()
}

#[test]
fn a_picture_waits_for_the_samples_of_its_exposure() {
    let mut deck = Deck::new();
    deck.samples(0, 0, &[95]);
    deck.header(0, 7, 20 * MS, 100 * MS);
    deck.image(0, &PICTURE);
    // These are recorded behind it.
    deck.samples(1, 0, &[100]);
    deck.samples(2, 0, &[104]);
    deck.header(30, 8, 50 * MS, 130 * MS);
    deck.image(30, &PICTURE);
    let (_folder, tape) = deck.play(true);
    let mut tape = tape.unwrap();
    let first = coded(&mut tape);
    let header = first.header.unwrap();
    assert_eq!((header.stamp.sequence, first.time_ns), (7, 100 * MS));
    assert_eq!(tape.reach_ns(&header), 3 * MS);
    assert_eq!(times_ms(&tape.take_samples()), [95, 100, 104]);
    // Stream time is that of exposures: the recording's clock.
    let second = coded(&mut tape).header.unwrap();
    assert_eq!([header, second].map(|header| header.stamp.stream_ns), [20 * MS, 50 * MS]);
    assert_eq!((tape.next(), tape.fault), (None, None));
}

#[test]
fn a_packet_gets_the_stamp_of_its_frame_and_one_that_was_not_published_gets_none() {
    let mut deck = Deck::new();
    // The recording was begun in flight.
    deck.packet(0, 3, -5, false);
    for (sequence, stream_ns) in [(4, 0), (5, 20), (6, 10), (7, 30)] {
        deck.packet(0, sequence, stream_ns, sequence == 4);
    }
    for (sequence, stream_ns) in [(0, 0), (2, 20), (3, 30)] {
        deck.header(5_000, sequence, stream_ns, 1000 + stream_ns);
    }
    let (_folder, tape) = deck.play(false);
    let mut tape = tape.unwrap();
    assert_eq!(tape.codec(), VideoCodec::H264);
    let told: Vec<_> = (0..4)
        .map(|_| {
            let coded = coded(&mut tape);
            (coded.time_ns, coded.header.map(|header| header.stamp.sequence), coded.bytes[3])
        })
        .collect();
    assert_eq!(told, [(0, Some(0), 4), (20, Some(2), 5), (10, None, 6), (30, Some(3), 7)]);
    assert_eq!(tape.next(), None);
}

#[test]
fn what_rests_on_a_missing_packet_is_left_out_up_to_the_next_key_frame() {
    let mut deck = Deck::new();
    for (sequence, is_key) in [(0, true), (1, false), (3, false), (4, false), (5, true)] {
        deck.packet(0, sequence, 10 * sequence as i64, is_key);
        deck.header(0, sequence, 10 * sequence as i64, 10 * sequence as i64);
    }
    let (_folder, tape) = deck.play(false);
    let mut tape = tape.unwrap();
    let mut told = Vec::new();
    loop {
        match tape.next() {
            Some(Ok(coded)) => told.push(u64::from(coded.bytes[3])),
            Some(Err((what, why))) => {
                assert!(what.starts_with("/flockeye/frame/video, message"), "{what}");
                assert!(why.contains("packets before it are missing"), "{why}");
                told.push(99);
            }
            None => break,
        }
    }
    assert_eq!(told, [0, 1, 99, 99, 5]);
}

#[test]
fn a_sensor_that_begins_anew_is_told_by_its_epoch() {
    let mut deck = Deck::new();
    deck.samples(0, 0, &[10, 20]);
    deck.samples(0, 1, &[5]);
    deck.samples(0, 1, &[5, 6]);
    deck.header(0, 0, 0, 0);
    deck.image(0, &PICTURE);
    let (_folder, tape) = deck.play(true);
    let mut tape = tape.unwrap();
    coded(&mut tape);
    let samples = tape.take_samples();
    assert_eq!(times_ms(&samples), [10, 20, 5, 6]);
    assert_eq!(samples.iter().map(|(epoch, _)| epoch.1).collect::<Vec<_>>(), [0, 0, 1, 1]);
}

#[test]
fn damaged_messages_are_left_out_with_their_place() {
    let mut deck = Deck::new();
    let small = {
        let mut small = PICTURE;
        small[8] = 1;
        small
    };
    let images: [(&[u8], &str); 5] = [
        (&PICTURE, ""),
        (&PICTURE[..10], "end marker is missing"),
        (b"no picture", "it is no JPEG"),
        (&small, "it has 4x1 pixels, not 4x2"),
        (&PICTURE, ""),
    ];
    for (k, (bytes, _)) in images.iter().enumerate() {
        deck.header(0, k as u64, k as i64, k as i64);
        deck.image(0, bytes);
    }
    deck.image(0, &PICTURE);
    let (_folder, tape) = deck.play(false);
    let mut tape = tape.unwrap();
    for (k, (_, wrong)) in images.iter().enumerate() {
        match tape.next() {
            Some(Ok(coded)) => {
                assert_eq!(coded.header.map(|header| header.stamp.sequence), Some(k as u64));
                assert!(wrong.is_empty(), "{k}");
            }
            Some(Err((what, why))) => {
                assert_eq!(what, format!("/flockeye/frame/image, message {k}"));
                assert!(!wrong.is_empty() && why.contains(wrong), "{why}");
            }
            None => panic!("ended before {k}"),
        }
    }
    let Some(Err((_, why))) = tape.next() else { panic!("a picture without a header") };
    assert!(why.contains("no header"), "{why}");
}

#[test]
fn what_has_no_pictures_says_what_it_has() {
    let opened = |deck: Deck| deck.play(false).1.map(drop).unwrap_err().to_string();
    let error = opened(Deck::new());
    assert!(error.contains("it has no message of a frame. Cure: record with --frames"), "{error}");
    let mut deck = Deck::new();
    deck.header(0, 0, 0, 0);
    assert!(opened(deck).contains("headers alone (--frames none)"));
    let mut deck = Deck::new();
    deck.header(0, 0, 0, 0);
    deck.writer.write(&ChannelKind::of_view_images(), 0, &[]).unwrap();
    assert!(opened(deck).contains("views alone (--frames views)"));
    let mut deck = Deck::new();
    deck.header(0, 0, 0, 0);
    deck.image(0, &PICTURE[..5]);
    let error = opened(deck);
    assert!(error.contains("message 0: it was cut short"), "{error}");
    let mut deck = Deck::new();
    let other = ChannelKind {
        definition: "uint8 other\n".to_owned(),
        ..ChannelKind::of_topic(&layouts()[0])
    };
    deck.writer.write(&other, 0, &[0, 1, 0, 0, 1]).unwrap();
    let error = opened(deck);
    assert!(error.contains("by another version of Flockeye: its contract is unknown"), "{error}");
}
