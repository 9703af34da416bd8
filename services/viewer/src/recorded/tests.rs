#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use bytemuck::{Zeroable, bytes_of, cast_slice};
use flockeye_contract::{FrameHeader, FrameStamp, StageLatency, Track, TrackHeader, TrackState};
use flockeye_recording::file::RecordingFile;
use flockeye_recording::images::encode_compressed;
use flockeye_recording::losses::{Loss, encode_loss};
use flockeye_recording::message::encode;
use flockeye_recording::{ChannelKind, ContractMessage, RecordingWriter, TopicLayout, layouts};
use flockeye_runtime::resolved_file;
use tempfile::TempDir;

use super::overview::OverviewMaker;
use super::pictures::RecordedPictures;
use super::playhead::{NewFrames, Playhead};
use super::*;
use crate::picture::gray_jpeg;

/// From frame to frame.
const PERIOD_NS: i64 = 100_000_000;
/// When the recording begins, UTC.
const BEGIN_NS: i64 = 1_700_000_000_000_000_000;

fn layout(service: &str) -> TopicLayout {
    layouts().into_iter().find(|layout| layout.service == service).unwrap()
}

fn about() -> About {
    let resolved = Resolved::of(Pipeline::default()).unwrap();
    let json = serde_json::to_vec(&resolved.pipeline).unwrap();
    let bodies = serde_json::to_vec(&resolved_file::bodies(&resolved)).unwrap();
    let said = [("instance", "field"), ("utc_from_exposure_ns", "1700000000000000000")];
    About {
        utc_from_monotonic_ns: BEGIN_NS,
        metadata: said.map(|(name, value)| (name.to_owned(), value.to_owned())).into(),
        attachments: vec![
            ("pipeline.json".into(), "application/json".into(), json),
            ("bodies.json".into(), "application/json".into(), bodies),
        ],
    }
}

fn stamp(sequence: u64) -> FrameStamp {
    let exposure_ns = sequence as i64 * PERIOD_NS;
    FrameStamp { sequence, exposure_ns, ..FrameStamp::default() }
}

/// A recording of `frames` frames, ten a second. Each fifth has a picture, a third of it small;
/// frame 42 never ended. A frame ends 150 ms after it came, so two others have come by then. In
/// frames 60 to 69 the neighbour coasts.
fn record(frames: u64) -> (TempDir, Arc<Recorded>) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("flight.mcap");
    let mut writer =
        RecordingWriter::begin(RecordingFile::create(&path).unwrap(), &about()).unwrap();
    let (frame, track) = (layout("flockeye/frame"), layout("flockeye/track"));
    let of = |header: &[u8], items: &[u8], payload_bytes| ContractMessage {
        header: header.to_vec(),
        items: items.to_vec(),
        payload_bytes,
    };
    let mut events: Vec<(i64, u64, bool)> = Vec::new();
    for sequence in 0..frames {
        let at_ns = sequence as i64 * PERIOD_NS;
        events.push((at_ns, sequence, false));
        if sequence != 42 {
            events.push((at_ns + 150_000_000, sequence, true));
        }
    }
    events.sort_unstable();
    for (at_ns, sequence, is_end) in events {
        if is_end {
            let header = TrackHeader { stamp: stamp(sequence), is_last: 1, generation: 0 };
            let state = match sequence {
                60..70 => TrackState::Coasting,
                _ => TrackState::Confirmed,
            };
            let latency =
                StageLatency { total_ns: 1_000_000 * sequence as i64, ..StageLatency::default() };
            let found = Track { state: state.code(), latency, ..Track::zeroed() };
            let mut found = found;
            found.observer_from_target.orientation[3] = 1.0;
            found.predicted_observer_from_target = found.observer_from_target;
            let message = of(bytes_of(&header), cast_slice(&[found]), 0);
            let cdr = encode(&track, &message).unwrap();
            writer.write(&ChannelKind::of_topic(&track), at_ns, &cdr).unwrap();
            if sequence == 50 {
                let loss = encode_loss(
                    "flockeye/plan",
                    &Loss { recorded: 9, missing: 3, ..Loss::default() },
                );
                writer.write(&ChannelKind::of_losses(), at_ns, &loss).unwrap();
            }
        } else {
            let header = FrameHeader {
                stamp: stamp(sequence),
                width: 3840,
                height: 1920,
                stride: 3840,
                ..FrameHeader::default()
            };
            let cdr = encode(&frame, &of(bytes_of(&header), &[], 3840 * 1920)).unwrap();
            writer.write(&ChannelKind::of_topic(&frame), at_ns, &cdr).unwrap();
            if sequence.is_multiple_of(5) {
                let jpeg = gray_jpeg(&[sequence as u8; 64 * 32], 64, 32).unwrap();
                let time = flockeye_ros2::messages::Time::from_utc_ns(BEGIN_NS + at_ns).unwrap();
                let picture = encode_compressed(time, "camera", "jpeg", &jpeg);
                writer.write(&ChannelKind::of_frame_images(), at_ns, &picture).unwrap();
            }
        }
        // A chunk for each few messages; some end between a frame and its picture.
        if sequence % 3 == 2 {
            writer.flush().unwrap();
        }
    }
    writer.finish().unwrap();
    let recorded = Recorded::open(&path, 15.0).unwrap();
    (folder, Arc::new(recorded))
}

fn shown(playhead: &Playhead) -> u64 {
    playhead.current().unwrap().stamp.sequence
}

#[test]
fn a_time_shows_the_last_frame_that_had_ended() {
    let (_folder, recorded) = record(300);
    assert_eq!(recorded.trouble, "");
    let hello = recorded.hello.recording.as_ref().unwrap();
    assert_eq!((hello.file.as_str(), hello.pictures), ("flight.mcap", true));
    assert!((hello.duration_s - 30.05).abs() < 1e-6, "{hello:?}");
    let mut playhead = Playhead::new(recorded.clone());
    assert_eq!(shown(&playhead), 0, "the first, although it has not ended yet");
    for (seconds, sequence) in [(20.16, 200), (20.0, 198), (5.2, 50), (1e9, 299), (0.0, 0)] {
        assert_eq!(playhead.seek(recorded.time_ns(seconds)), NewFrames::All);
        assert_eq!(shown(&playhead), sequence, "at {seconds} s");
        let oldest = &playhead.recent[0];
        let lead_s = (playhead.current().unwrap().utc_ns - oldest.utc_ns) as f64 * 1e-9;
        assert!(lead_s <= 9.0 && (lead_s > 8.8 || oldest.stamp.sequence == 0), "{lead_s}");
    }
    for odd in [f64::NAN, f64::NEG_INFINITY, f64::INFINITY] {
        playhead.seek(recorded.time_ns(odd));
    }
    assert_eq!(shown(&playhead), 299);
}

#[test]
fn steps_lead_to_each_frame_and_time_passes() {
    let (_folder, recorded) = record(300);
    let mut playhead = Playhead::new(recorded.clone());
    // Far more than are kept, on and back.
    let on: Vec<u64> = (1..300)
        .map(|_| {
            playhead.step(1);
            shown(&playhead)
        })
        .collect();
    assert_eq!(on, (1..300).filter(|n| *n != 42).chain([299]).collect::<Vec<_>>());
    let back: Vec<u64> = (0..299)
        .map(|_| {
            playhead.step(-1);
            shown(&playhead)
        })
        .collect();
    let wanted: Vec<u64> = (0..299).rev().filter(|n| *n != 42).chain([0]).collect();
    assert_eq!(back, wanted);
    playhead.step(1000);
    assert_eq!(shown(&playhead), 299);
    playhead.step(-250);
    assert_eq!(shown(&playhead), 49);
    // Stepped back, it goes on from there.
    playhead.step(-3);
    let at_ns = playhead.at_ns;
    playhead.advance(at_ns + 250_000_000);
    assert_eq!(shown(&playhead), 48);
    assert_eq!(playhead.advance(at_ns + 450_000_000), NewFrames::Last(2));
    assert_eq!(shown(&playhead), 50);
    playhead.advance(u64::MAX);
    assert!(playhead.is_at_end() && shown(&playhead) == 299);
}

#[test]
fn a_picture_is_the_nearest_before_and_of_no_later_frame() {
    let (_folder, recorded) = record(100);
    let mut playhead = Playhead::new(recorded.clone());
    let mut pictures = RecordedPictures::new(recorded.clone()).unwrap();
    for sequence in [99, 45, 44, 4, 0, 60, 59] {
        playhead.seek(recorded.time_ns(0.1 * sequence as f64 + 0.151));
        let seen = playhead.current().unwrap();
        assert_eq!(seen.stamp.sequence, sequence);
        let nearest = pictures.nearest(&seen.stamp, seen.utc_ns).unwrap();
        assert_eq!(nearest.sequence, sequence / 5 * 5, "of frame {sequence}");
        let picture = pictures.picture(&seen.stamp, seen.utc_ns, |_| None).unwrap();
        assert_eq!((picture.stamp.sequence, picture.size), (nearest.sequence, [64, 32]));
        assert!(picture.closeups.is_empty(), "it is smaller than the camera's frames");
    }
    assert_eq!(pictures.trouble(), None);
}

#[test]
fn an_overview_has_the_worst_of_each_part() {
    let (_folder, recorded) = record(100);
    let mut maker = OverviewMaker::new(&recorded);
    while maker.read() {}
    let overview = maker.overview();
    assert!((overview.done - 1.0).abs() < 1e-6);
    let [alpha] = &overview.states[..] else { panic!("{:?}", overview.states) };
    let count = |state| alpha.states.iter().filter(|found| **found == Some(state)).count();
    assert_eq!((alpha.target, count("coasting"), count("confirmed")), (0, 10, 89));
    assert_eq!(overview.skipped.iter().sum::<u32>(), 1);
    assert_eq!(overview.lost.iter().sum::<u32>(), 3);
    assert_eq!((overview.losses[0].topic.as_str(), overview.losses[0].lost), ("flockeye/plan", 3));
    let slowest = overview.latency_ms.iter().flatten().filter_map(|latency| latency[4]);
    assert_eq!(slowest.fold(0.0, f32::max), 99.0);
}

#[test]
fn a_recording_needs_its_configuration_and_bodies_keep_their_numbers() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("flight.mcap");
    let open = |about: &About| {
        std::fs::remove_file(&path).ok();
        let file = RecordingFile::create(&path).unwrap();
        let mut writer = RecordingWriter::begin(file, about).unwrap();
        writer.write(&ChannelKind::of_losses(), 1, &encode_loss("x", &Loss::default())).unwrap();
        writer.finish().unwrap();
        Recorded::open(&path, 15.0)
    };
    let mut lacking = about();
    lacking.attachments.remove(0);
    let error = format!("{:#}", open(&lacking).err().unwrap());
    assert!(error.contains("the recording has no pipeline.json"), "{error}");
    let mut other = about();
    other.attachments[0].2 = br#"{"warp": 9}"#.to_vec();
    let error = format!("{:#}", open(&other).err().unwrap());
    assert!(error.contains("of another version of Flockeye. Cure:"), "{error}");
    // The first by number is the last by name.
    let mut renamed = about();
    let text = String::from_utf8(renamed.attachments[1].2.clone()).unwrap();
    let mut bodies: Value = serde_json::from_str(&text).unwrap();
    let alpha = bodies["bodies"]["alpha"].clone();
    let mut other = alpha.clone();
    other["target"] = 1.into();
    for (k, marker) in other["markers"].as_array_mut().unwrap().iter_mut().enumerate() {
        marker["id"] = (500 + k).into();
    }
    bodies["bodies"] = serde_json::json!({ "zulu": alpha, "bravo": other });
    renamed.attachments[1].2 = serde_json::to_vec(&bodies).unwrap();
    let recorded = open(&renamed).unwrap();
    let names: Vec<_> = recorded.hello.bodies.iter().map(|body| body.name.as_str()).collect();
    assert_eq!(names, ["zulu", "bravo"]);
}
