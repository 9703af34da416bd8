//! Folders of images, and single ones.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::time::Duration;

use common::{Scratch, open, packed, parameters, play, raw_luma, video, watched};
use flockeye_capture::{CaptureError, EndReason, Event, FrameSource, SourceParameters, SourceSpec};
use flockeye_config::Flow;
use flockeye_contract::Range;
use flockeye_runtime::clock::monotonic_ns;

const TIMEOUT: Duration = Duration::from_secs(10);

/// JPEGs `a.jpg` to `d.jpg`, the third of another size.
fn mixed_sizes() -> Scratch {
    let scratch = Scratch::new();
    for (name, width) in [("a.jpg", 320), ("b.JPEG", 320), ("c.jpg", 160), ("d.jpg", 320)] {
        scratch.clip(name, &format!("{} ! jpegenc", video(1, width, "I420")));
    }
    std::fs::write(scratch.path("notes.txt"), "not an image").unwrap();
    scratch
}

#[test]
fn images_of_another_size_are_skipped_by_name() {
    watched(|| {
        let scratch = mixed_sizes();
        let mut source = open(scratch.folder(), parameters(Flow::Lossless));
        let mut events = Vec::new();
        let end = loop {
            match source.next(TIMEOUT).unwrap() {
                Event::Frame(picture) => {
                    assert_eq!(picture.range(), Range::Full);
                    assert_eq!(picture.stream_time(), Duration::from_secs(picture.sequence()));
                    events.push(picture.sequence().to_string());
                }
                Event::Skipped { what, why } => {
                    assert!(what.ends_with("c.jpg"), "{what}");
                    assert!(why.contains("160x240") && why.contains("320x240"), "{why}");
                    events.push("skipped".to_owned());
                }
                Event::End(reason) => break reason,
                other => panic!("{other:?}"),
            }
        };
        assert_eq!(events, ["0", "1", "skipped", "3"]);
        assert_eq!(end, EndReason::Complete { frames: 3, skipped: 1 });
    });
}

#[test]
fn broken_images_are_skipped_and_the_others_go_on() {
    watched(|| {
        let scratch = Scratch::new();
        let jpeg = scratch.clip("a.jpg", &format!("{} ! jpegenc", video(1, 320, "I420")));
        let png = scratch.clip("b.png", &format!("{} ! pngenc", video(1, 320, "RGB")));
        scratch.cut(&jpeg, "c.jpg", 0.6);
        scratch.cut(&png, "d.png", 0.6);
        std::fs::write(scratch.path("e.png"), "no picture").unwrap();
        let mut source = open(scratch.folder(), parameters(Flow::Lossless));
        let mut skipped = Vec::new();
        let end = loop {
            match source.next(TIMEOUT).unwrap() {
                Event::Skipped { what, .. } => {
                    skipped.push(what.rsplit('/').next().unwrap().to_owned())
                }
                Event::End(reason) => break reason,
                _ => {}
            }
        };
        assert_eq!(skipped, ["c.jpg", "d.png", "e.png"]);
        assert_eq!(end, EndReason::Complete { frames: 2, skipped: 3 });
    });
}

#[test]
fn gray_images_keep_their_values_and_coloured_ones_become_gray() {
    watched(|| {
        let scratch = Scratch::new();
        let truth = raw_luma(&scratch, &video(1, 322, "GRAY8"), 322, "GRAY8");
        scratch.clip("a_gray.png", &format!("{} ! pngenc", video(1, 322, "GRAY8")));
        // The same values in three equal channels.
        scratch.clip(
            "b_rgb.png",
            &format!("{} ! videoconvert ! video/x-raw,format=RGB ! pngenc", video(1, 322, "GRAY8")),
        );
        let mut source =
            open(scratch.folder(), SourceParameters { width: 322, ..parameters(Flow::Lossless) });
        let end = play(&mut source, |picture| {
            assert_eq!(picture.range(), Range::Full);
            let worst = packed(picture).iter().zip(&truth[0]).map(|(a, b)| a.abs_diff(*b)).max();
            let allowed = if picture.sequence() == 0 { 0 } else { 1 };
            assert!(worst <= Some(allowed), "image {} is off by {worst:?}", picture.sequence());
        });
        assert_eq!(end, EndReason::Complete { frames: 2, skipped: 0 });
    });
}

#[test]
fn real_time_shows_images_at_their_rate() {
    watched(|| {
        let scratch = mixed_sizes();
        let rate = SourceParameters { images_per_second: 10.0, ..parameters(Flow::Latest) };
        let mut source = open(scratch.folder(), rate);
        let mut shown = Vec::new();
        let mut idle = 0;
        let mut events = 0;
        let end = loop {
            match source.next(Duration::from_millis(2)).unwrap() {
                Event::Frame(picture) => shown.push((
                    picture.sequence(),
                    picture.exposure_monotonic_ns(),
                    monotonic_ns(),
                )),
                Event::Idle => idle += 1,
                Event::Skipped { .. } => {}
                Event::End(reason) => break reason,
                other => panic!("{other:?}"),
            }
            events += 1;
            assert!(events < 10_000, "it does not end");
        };
        assert!(idle > 0, "images are not paced");
        let (first, start_ns, _) = shown[0];
        assert_eq!(first, 0);
        for &(sequence, exposure_ns, handed_out_ns) in &shown {
            assert_eq!(exposure_ns - start_ns, sequence as i64 * 100_000_000);
            assert!(handed_out_ns >= exposure_ns, "image {sequence} is early");
        }
        assert!(matches!(end, EndReason::Complete { frames, .. } if frames == shown.len() as u64));
    });
}

#[test]
fn a_folder_loops_but_not_over_nothing() {
    watched(|| {
        let scratch = Scratch::new();
        scratch.clip("a.jpg", &format!("{} ! jpegenc", video(1, 320, "I420")));
        let looping = SourceParameters { looping: true, ..parameters(Flow::Lossless) };
        let mut source = open(scratch.folder(), looping.clone());
        for _ in 0..3 {
            assert!(
                matches!(source.next(TIMEOUT).unwrap(), Event::Frame(picture) if picture.sequence() == 0)
            );
            assert!(matches!(source.next(TIMEOUT).unwrap(), Event::Looped { .. }));
        }
        let mut unusable = open(scratch.folder(), SourceParameters { width: 100, ..looping });
        assert!(matches!(unusable.next(TIMEOUT).unwrap(), Event::Skipped { .. }));
        assert!(matches!(
            unusable.next(TIMEOUT).unwrap(),
            Event::End(EndReason::Complete { frames: 0, skipped: 1 })
        ));
    });
}

#[test]
fn a_single_image_is_a_recording_of_one_frame() {
    watched(|| {
        let scratch = Scratch::new();
        let image = scratch.clip("a.jpg", &format!("{} ! jpegenc", video(1, 320, "I420")));
        let mut sequences = Vec::new();
        let end = play(&mut open(&image, parameters(Flow::Lossless)), |picture| {
            sequences.push(picture.sequence())
        });
        assert_eq!((sequences, end), (vec![0], EndReason::Complete { frames: 1, skipped: 0 }));
    });
}

#[test]
fn an_empty_folder_and_a_senseless_rate_are_refused() {
    watched(|| {
        let scratch = Scratch::new();
        let spec = SourceSpec::Folder(scratch.folder().to_owned());
        let empty = FrameSource::open(spec.clone(), parameters(Flow::Lossless)).unwrap_err();
        assert!(matches!(empty, CaptureError::EmptyFolder { .. }), "{empty}");
        let rate = SourceParameters { images_per_second: 0.0, ..parameters(Flow::Lossless) };
        let senseless = FrameSource::open(spec, rate).unwrap_err();
        assert!(
            matches!(senseless, CaptureError::Parameter { name: "images_per_second", .. }),
            "{senseless}"
        );
    });
}
