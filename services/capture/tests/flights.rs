//! Recordings of flights: their pictures come with the stamps that they had, and what is wrong with
//! them is said.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::path::{Path, PathBuf};
use std::time::Duration;

use common::{HEIGHT, Scratch, WIDTH, open, packed, parameters, run, video, watched};
use flockeye_capture::{CaptureError, EndReason, Event, FrameSource, SourceParameters, SourceSpec};
use flockeye_config::Flow;
use flockeye_contract::{FrameHeader, FrameStamp, Range};
use flockeye_recording::file::RecordingFile;
use flockeye_recording::images::encode_compressed;
use flockeye_recording::message::encode;
use flockeye_recording::{About, ChannelKind, ContractMessage, RecordingWriter, layouts};
use flockeye_ros2::messages::Time;

const MS: i64 = 1_000_000;

/// JPEGs that differ, and what they are decoded to by a folder of images.
fn pictures(scratch: &Scratch, count: u32) -> Vec<(Vec<u8>, Vec<u8>)> {
    let folder = scratch.path("jpeg");
    std::fs::create_dir_all(&folder).unwrap();
    let files = format!("{}/%04d.jpg", folder.display());
    run(&format!(
        "{} ! jpegenc quality=90 ! multifilesink location=\"{files}\"",
        video(count, WIDTH, "GRAY8")
    ));
    let mut source = open(&folder, parameters(Flow::Lossless));
    let mut decoded = Vec::new();
    common::play(&mut source, |picture| decoded.push(packed(picture)));
    let file = |k: usize| std::fs::read(folder.join(format!("{k:04}.jpg"))).unwrap();
    decoded.into_iter().enumerate().map(|(k, luma)| (file(k), luma)).collect()
}

fn stamp(sequence: u64, exposure_ms: i64, epoch: u32) -> FrameStamp {
    let exposure_ns = exposure_ms * MS;
    FrameStamp {
        sequence,
        epoch,
        exposure_ns,
        stream_ns: exposure_ns - 900 * MS,
        ..FrameStamp::default()
    }
}

/// Writes the frames as a recording, as the part `number` of one that was split.
fn record(path: &Path, number: u32, frames: &[(FrameStamp, &[u8])]) {
    let metadata = [("file".to_owned(), number.to_string())].into();
    let about = About { metadata, ..About::default() };
    let file = RecordingFile::create(path).unwrap();
    let mut writer = RecordingWriter::begin(file, &about).unwrap();
    let layout = layouts().into_iter().find(|layout| layout.service == "flockeye/frame").unwrap();
    for (stamp, bytes) in frames {
        let header = FrameHeader {
            stamp: *stamp,
            width: WIDTH,
            height: HEIGHT,
            stride: WIDTH,
            range: Range::Limited.code(),
            ..FrameHeader::default()
        };
        let message = ContractMessage {
            header: bytemuck::bytes_of(&header).to_vec(),
            items: Vec::new(),
            payload_bytes: u64::from(WIDTH * HEIGHT),
        };
        let cdr = encode(&layout, &message).unwrap();
        let at_ns = stamp.exposure_ns;
        writer.write(&ChannelKind::of_topic(&layout), at_ns, &cdr).unwrap();
        let image = encode_compressed(Time::default(), "camera", "jpeg", bytes);
        writer.write(&ChannelKind::of_frame_images(), at_ns, &image).unwrap();
    }
    writer.finish().unwrap();
}

/// Number, stream time and exposure in milliseconds, and the pixels.
type Frame = (u64, i64, i64, Vec<u8>);

/// All that a source says to its end.
#[derive(Debug, Default)]
struct Played {
    /// The frames of each epoch.
    epochs: Vec<Vec<Frame>>,
    skipped: Vec<String>,
    end: Option<EndReason>,
}

fn play(source: &mut FrameSource) -> Played {
    let mut played = Played { epochs: vec![Vec::new()], ..Played::default() };
    loop {
        match source.next(Duration::from_secs(5)).unwrap() {
            Event::Frame(picture) => {
                assert_eq!(picture.range(), Range::Limited, "as the frame was");
                let facts = picture.facts();
                let frame =
                    (facts.number, facts.stream_ns / MS, facts.exposure_ns / MS, packed(&picture));
                played.epochs.last_mut().unwrap().push(frame);
            }
            Event::NewEpoch => played.epochs.push(Vec::new()),
            Event::Skipped { what, why } => played.skipped.push(format!("{what}: {why}")),
            Event::End(reason) => {
                played.end = Some(reason);
                return played;
            }
            Event::Idle => {}
            other => panic!("{other:?}"),
        }
    }
}

fn flight(scratch: &Scratch, frames: &[(FrameStamp, &[u8])]) -> PathBuf {
    let path = scratch.path("flight.mcap");
    record(&path, 0, frames);
    path
}

#[test]
fn pictures_come_with_their_stamps_and_gaps_and_epochs() {
    watched(|| {
        let scratch = Scratch::new();
        let pictures = pictures(&scratch, 6);
        // Frames 11 and 13 are missing; then the source began anew.
        let stamps =
            [(10, 1000, 0), (12, 1080, 0), (14, 1160, 0), (0, 3000, 1), (1, 3040, 1), (5, 3200, 1)];
        let frames: Vec<(FrameStamp, &[u8])> = stamps
            .iter()
            .zip(&pictures)
            .map(|(&(sequence, ms, epoch), (jpeg, _))| (stamp(sequence, ms, epoch), &jpeg[..]))
            .collect();
        let path = flight(&scratch, &frames);
        let mut source = open(&path, parameters(Flow::Lossless));
        assert!(source.describe().contains("320x240"), "{}", source.describe());
        let Played { epochs, skipped, end } = play(&mut source);
        assert_eq!((skipped, end), (vec![], Some(EndReason::Complete { frames: 6, skipped: 0 })));
        let told: Vec<Vec<_>> = epochs
            .iter()
            .map(|epoch| epoch.iter().map(|of| (of.0, of.1, of.2)).collect())
            .collect();
        // The stream goes on as exposures did.
        let wanted = [
            vec![(10, 100, 100), (12, 180, 180), (14, 260, 260)],
            vec![(0, 2100, 2100), (1, 2140, 2140), (5, 2300, 2300)],
        ];
        assert_eq!(told, wanted);
        for ((_, _, _, luma), (_, truth)) in epochs.iter().flatten().zip(&pictures) {
            assert!(luma == truth, "pixels are those of the JPEG");
        }
    });
}

#[test]
fn real_time_keeps_the_distances_of_exposures() {
    watched(|| {
        let scratch = Scratch::new();
        let pictures = pictures(&scratch, 4);
        let times = [1000, 1100, 1130, 1400];
        let frames: Vec<(FrameStamp, &[u8])> =
            (0..4).map(|k| (stamp(k as u64, times[k], 0), &pictures[k].0[..])).collect();
        let mut source = open(&flight(&scratch, &frames), parameters(Flow::Latest));
        let begun = std::time::Instant::now();
        let Played { epochs, .. } = play(&mut source);
        assert!(begun.elapsed() > Duration::from_millis(350), "{:?}", begun.elapsed());
        let [epoch] = &epochs[..] else { panic!("one epoch") };
        let first = epoch[0].2;
        let told: Vec<i64> = epoch.iter().map(|frame| frame.2 - first).collect();
        // In whole milliseconds of another clock.
        let off = |k: usize| (told[k] - (times[k] - times[0])).abs();
        assert!((0..4).all(|k| off(k) <= 1), "{told:?}");
        assert!(epoch[3].2 <= flockeye_runtime::clock::monotonic_ns() / MS);
    });
}

#[test]
fn damaged_pictures_are_counted_and_the_others_come() {
    watched(|| {
        let scratch = Scratch::new();
        let pictures = pictures(&scratch, 5);
        let mut nonsense = pictures[1].0.clone();
        let end = nonsense.len() - 2;
        // Tables that no decoder takes, between markers that are right.
        let table = nonsense.windows(2).position(|pair| pair == [0xFF, 0xC4]).unwrap();
        nonsense[table + 5..table + 21].fill(0xFF);
        let cut = &pictures[2].0[..end / 2];
        let bytes: [&[u8]; 5] = [&pictures[0].0, &nonsense, cut, &pictures[3].0, &pictures[4].0];
        let frames: Vec<(FrameStamp, &[u8])> =
            (0..5).map(|k| (stamp(k as u64, 1000 + 40 * k as i64, 0), bytes[k])).collect();
        let mut source = open(&flight(&scratch, &frames), parameters(Flow::Lossless));
        let Played { epochs, skipped, end } = play(&mut source);
        let numbers: Vec<u64> = epochs[0].iter().map(|frame| frame.0).collect();
        assert_eq!(numbers, [0, 3, 4], "{skipped:?} {end:?}");
        assert_eq!(end, Some(EndReason::Complete { frames: 3, skipped: 2 }), "{skipped:?}");
        assert!(
            skipped.iter().any(|told| told.contains("frame 1: its picture cannot be decoded")),
            "{skipped:?}"
        );
        assert!(
            skipped.iter().any(|told| told.contains("message 2: it was cut short")),
            "{skipped:?}"
        );
    });
}

#[test]
fn a_loop_starts_again() {
    watched(|| {
        let scratch = Scratch::new();
        let pictures = pictures(&scratch, 2);
        let frames: Vec<(FrameStamp, &[u8])> = (0..2)
            .map(|k| (stamp(k as u64, 1000 + 40 * k as i64, 0), &pictures[k].0[..]))
            .collect();
        let path = flight(&scratch, &frames);
        let mut source =
            open(&path, SourceParameters { looping: true, ..parameters(Flow::Lossless) });
        let mut told = Vec::new();
        while told.len() < 9 {
            match source.next(Duration::from_secs(5)).unwrap() {
                Event::Frame(picture) => told.push(Some(picture.facts().number)),
                Event::Looped { after: EndReason::Complete { frames: 2, .. } } => told.push(None),
                Event::Idle => {}
                other => panic!("{other:?}"),
            }
        }
        assert_eq!(told[..6], [Some(0), Some(1), None, Some(0), Some(1), None]);
    });
}

#[test]
fn a_recording_that_was_split_is_played_in_order() {
    watched(|| {
        let scratch = Scratch::new();
        let pictures = pictures(&scratch, 3);
        for number in 0..3 {
            let name = match number {
                0 => "flight.mcap".to_owned(),
                number => format!("flight-{number}.mcap"),
            };
            let frame = (
                stamp(u64::from(number), 1000 + 40 * i64::from(number), 0),
                &pictures[number as usize].0[..],
            );
            record(&scratch.path(&name), number, &[frame]);
        }
        for (name, wanted) in [("flight.mcap", vec![0, 1, 2]), ("flight-1.mcap", vec![1, 2])] {
            let mut source = open(&scratch.path(name), parameters(Flow::Lossless));
            let Played { epochs, .. } = play(&mut source);
            let numbers: Vec<u64> = epochs[0].iter().map(|frame| frame.0).collect();
            assert_eq!(numbers, wanted, "{name}");
        }
    });
}

#[test]
fn what_is_cut_off_plays_to_there_and_what_is_none_is_refused() {
    watched(|| {
        let scratch = Scratch::new();
        let pictures = pictures(&scratch, 40);
        let frames: Vec<(FrameStamp, &[u8])> = (0..40)
            .map(|k| (stamp(k as u64, 1000 + 40 * k as i64, 0), &pictures[k].0[..]))
            .collect();
        let whole = flight(&scratch, &frames);
        let refused = |path: &Path| {
            let spec: SourceSpec = path.to_str().unwrap().parse().unwrap();
            FrameSource::open(spec, parameters(Flow::Lossless)).unwrap_err()
        };
        // A recorder that is killed has written whole chunks; all of these are in one.
        let cut = scratch.cut(&whole, "cut.mcap", 0.5);
        let error = refused(&cut).to_string();
        assert!(error.contains("cut.mcap was cut off"), "{error}");
        let bytes = std::fs::read(&whole).unwrap();
        // The data are whole, the index is not.
        let without_index = scratch.path("killed.mcap");
        std::fs::write(&without_index, &bytes[..bytes.len() - 200]).unwrap();
        let Played { epochs, end, .. } =
            play(&mut open(&without_index, parameters(Flow::Lossless)));
        assert_eq!(epochs[0].len(), 40);
        let Some(EndReason::Truncated { decoded: 40, reason }) = end else { panic!("{end:?}") };
        assert!(reason.contains("killed.mcap was cut off"), "{reason}");
        for (name, bytes, wanted) in [
            ("text.mcap", &b"no recording"[..], "is no MCAP file"),
            ("empty.mcap", b"", "is empty"),
            (
                "damaged.mcap",
                &[&bytes[..200], &[0xAA; 2000][..], &bytes[2200..]].concat(),
                "damaged.mcap",
            ),
        ] {
            std::fs::write(scratch.path(name), bytes).unwrap();
            let error = refused(&scratch.path(name)).to_string();
            assert!(error.contains(wanted) && error.contains("Cure:"), "{name}: {error}");
        }
        let gone = refused(&scratch.path("gone.mcap"));
        assert!(matches!(gone, CaptureError::Missing { .. }), "{gone}");
        let small = SourceParameters { width: 300, ..parameters(Flow::Lossless) };
        let error = FrameSource::open(SourceSpec::Flight(whole), small).unwrap_err();
        assert!(matches!(error, CaptureError::Size { found: (WIDTH, HEIGHT), .. }), "{error}");
    });
}
