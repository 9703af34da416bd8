//! Video files: what comes out of them, in which order, and what is said of broken ones.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::time::Duration;

use common::{Scratch, open, packed, parameters, play, raw_luma, video, watched};
use flockeye_capture::{CaptureError, EndReason, Event, FrameSource, SourceParameters, SourceSpec};
use flockeye_config::Flow;
use flockeye_contract::Range;
use flockeye_runtime::logs::overhear;

const FRAME: Duration = Duration::from_nanos(33_333_333);

#[test]
fn lossless_gives_every_frame_in_order_and_bit_for_bit() {
    watched(|| {
        // 322 is no multiple of 4, so rows are padded.
        for (width, format, encoder) in [
            (320, "I420", "avenc_ffv1"),
            (322, "I420", "avenc_ffv1"),
            (322, "Y42B", "avenc_huffyuv"),
        ] {
            let scratch = Scratch::new();
            let clip = scratch.clip(
                "clip.mkv",
                &format!("{} ! {encoder} ! matroskamux", video(30, width, format)),
            );
            let truth = raw_luma(&scratch, &video(30, width, format), width, format);
            assert_eq!(truth.len(), 30);
            let mut source = open(&clip, SourceParameters { width, ..parameters(Flow::Lossless) });
            let mut count = 0;
            let end = play(&mut source, |picture| {
                assert_eq!(picture.sequence(), count);
                assert!(
                    packed(picture) == truth[count as usize],
                    "frame {count} of {width} {format} differs"
                );
                let off = picture.stream_time().abs_diff(FRAME * count as u32);
                assert!(off < Duration::from_millis(2), "frame {count} is off by {off:?}");
                assert_eq!(
                    picture.exposure_monotonic_ns(),
                    picture.stream_time().as_nanos() as i64
                );
                assert!(picture.stride() >= width as usize);
                assert_eq!(picture.range(), Range::Limited);
                count += 1;
            });
            assert_eq!(end, EndReason::Complete { frames: 30, skipped: 0 });
            assert!(
                matches!(source.next(Duration::ZERO).unwrap(), Event::End(again) if again == end)
            );
        }
    });
}

#[test]
fn a_slow_consumer_holds_the_decoder_back() {
    watched(|| {
        let scratch = Scratch::new();
        let clip = scratch.clip(
            "clip.mp4",
            &format!("{} ! openh264enc ! h264parse ! mp4mux", video(20, 320, "I420")),
        );
        let mut source = open(&clip, parameters(Flow::Lossless));
        let mut sequences = Vec::new();
        let end = play(&mut source, |picture| {
            std::thread::sleep(Duration::from_millis(10));
            sequences.push(picture.sequence());
        });
        assert_eq!(sequences, (0..20).collect::<Vec<_>>());
        assert_eq!(end, EndReason::Complete { frames: 20, skipped: 0 });
    });
}

#[test]
fn real_time_replaces_what_nobody_takes_and_counts_it() {
    watched(|| {
        let scratch = Scratch::new();
        let clip = scratch
            .clip("clip.mkv", &format!("{} ! avenc_ffv1 ! matroskamux", video(30, 320, "I420")));
        let mut source = open(&clip, parameters(Flow::Latest));
        let mut seen = Vec::new();
        play(&mut source, |picture| {
            seen.push((picture.sequence(), picture.stream_time(), picture.exposure_monotonic_ns()));
            if seen.len() == 1 {
                std::thread::sleep(FRAME * 10);
            }
        });
        assert!(seen.len() < 30, "nothing was left out");
        let (_, _, start_ns) = seen[0];
        for &(sequence, stream_time, exposure_ns) in &seen {
            let off = stream_time.abs_diff(FRAME * sequence as u32);
            assert!(
                off < Duration::from_millis(2),
                "frame {sequence} is said to be at {stream_time:?}"
            );
            let played = Duration::from_nanos((exposure_ns - start_ns) as u64);
            assert!(
                played + Duration::from_millis(1) > stream_time,
                "{played:?} for {stream_time:?}"
            );
        }
        assert_eq!(seen.last().unwrap().0, 29);
    });
}

#[test]
fn what_decodes_too_slowly_plays_slower() {
    watched(|| {
        // 50 ms for a frame that is due after 33 ms: behind by a second at the end.
        let text = format!("{} ! identity sleep-time=50000", video(60, 320, "I420"));
        let mut source =
            FrameSource::open(SourceSpec::Description(text), parameters(Flow::Latest)).unwrap();
        let mut seen = Vec::new();
        loop {
            match source.next(Duration::from_secs(5)).unwrap() {
                Event::Frame(picture) => {
                    seen.push((picture.stream_time(), picture.exposure_monotonic_ns()))
                }
                Event::Lost { .. } => break,
                _ => {}
            }
        }
        let ((first, first_ns), (last, last_ns)) = (seen[0], seen[seen.len() - 1]);
        let slipped = Duration::from_nanos((last_ns - first_ns) as u64) - (last - first);
        assert!(slipped > Duration::from_millis(500), "{slipped:?} within {:?}", last - first);
        assert!(seen.is_sorted_by_key(|&(_, exposure_ns)| exposure_ns));
    });
}

#[test]
fn a_loop_starts_again_from_zero() {
    watched(|| {
        let scratch = Scratch::new();
        let clip = scratch
            .clip("clip.mkv", &format!("{} ! avenc_ffv1 ! matroskamux", video(5, 320, "I420")));
        let mut source =
            open(&clip, SourceParameters { looping: true, ..parameters(Flow::Lossless) });
        let mut rounds = vec![Vec::new()];
        while rounds.len() <= 3 {
            match source.next(Duration::from_secs(5)).unwrap() {
                Event::Frame(picture) => {
                    rounds.last_mut().unwrap().push((picture.sequence(), packed(&picture)))
                }
                Event::Looped { after } => {
                    assert_eq!(after, EndReason::Complete { frames: 5, skipped: 0 });
                    rounds.push(Vec::new());
                }
                other => panic!("{other:?}"),
            }
        }
        assert!(rounds[..3].iter().all(|round| round.len() == 5 && *round == rounds[0]));
    });
}

/// A recording with four thousand frames in a second, of which many are B-frames.
#[test]
fn a_decoder_that_falls_behind_leaves_out_frames_that_no_other_needs() {
    watched(|| {
        let scratch = Scratch::new();
        let video = "videotestsrc num-buffers=900 pattern=ball ! \
             video/x-raw,format=I420,width=1280,height=640,framerate=4000/1";
        let coded = "x265enc speed-preset=ultrafast ! h265parse ! mp4mux";
        let clip = scratch.clip("fast.mp4", &format!("{video} ! {coded}"));
        flockeye_runtime::logs::init();
        let left_out = overhear("flockeye_capture", "frames are left out");
        let mut numbers = Vec::new();
        let params = SourceParameters {
            flow: Flow::Latest,
            decoder_threads: 1,
            ..SourceParameters::new(1280, 640)
        };
        let end = play(&mut open(&clip, params), |picture| {
            let stamp = picture.facts();
            let expected = (stamp.stream_ns + 125_000) / 250_000;
            assert_eq!(stamp.sequence as i64, expected, "{stamp:?}");
            numbers.push(stamp.sequence);
        });
        assert!(matches!(end, EndReason::Complete { .. }), "{end}");
        assert!(left_out.heard().0 > 0, "no frame is left out before the decoder");
        assert!(numbers.is_sorted() && numbers.last().is_some_and(|last| *last >= 897));
    });
}

#[test]
fn cut_recordings_play_to_where_they_were_cut() {
    watched(|| {
        let scratch = Scratch::new();
        let h264 = format!("{} ! openh264enc ! h264parse", video(60, 320, "I420"));
        for (name, muxer) in [("clip.mkv", "matroskamux"), ("clip.mp4", "mp4mux faststart=true")] {
            let whole = scratch.clip(name, &format!("{h264} ! {muxer}"));
            let cut = scratch.cut(&whole, &format!("cut_{name}"), 0.6);
            let end = play(&mut open(&cut, parameters(Flow::Lossless)), |_| {});
            let EndReason::Truncated { decoded, reason } = end else { panic!("{name}: {end}") };
            assert!((10..55).contains(&decoded), "{name}: {decoded}");
            assert!(reason.contains("cut short"), "{reason}");
        }
    });
}

#[test]
fn an_mp4_without_its_index_says_so() {
    watched(|| {
        let scratch = Scratch::new();
        let h264 = format!("{} ! openh264enc ! h264parse ! mp4mux", video(60, 320, "I420"));
        let cut = scratch.cut(&scratch.clip("clip.mp4", &h264), "cut.mp4", 0.6);
        let error =
            FrameSource::open(SourceSpec::File(cut), parameters(Flow::Lossless)).unwrap_err();
        assert!(
            matches!(&error, CaptureError::NotAVideo { reason, .. } if reason.contains("moov")),
            "{error}"
        );
    });
}

#[test]
fn what_is_no_video_is_refused() {
    watched(|| {
        let scratch = Scratch::new();
        std::fs::write(scratch.path("text.mp4"), "frame,t_s,body\n0,0.0,alpha\n").unwrap();
        std::fs::write(scratch.path("empty.mp4"), "").unwrap();
        scratch.clip("sound.mkv", "audiotestsrc num-buffers=20 ! vorbisenc ! matroskamux");
        for name in ["text.mp4", "empty.mp4", "sound.mkv"] {
            let error =
                FrameSource::open(SourceSpec::File(scratch.path(name)), parameters(Flow::Latest))
                    .unwrap_err();
            assert!(matches!(error, CaptureError::NotAVideo { .. }), "{name}: {error:?}");
            assert!(error.to_string().contains(name), "{error}");
        }
        let gone =
            FrameSource::open(SourceSpec::File(scratch.path("gone.mp4")), parameters(Flow::Latest))
                .unwrap_err();
        assert!(matches!(gone, CaptureError::Missing { .. }), "{gone:?}");
    });
}

#[test]
fn another_size_is_refused_with_the_cure() {
    watched(|| {
        let scratch = Scratch::new();
        let clip = scratch
            .clip("clip.mkv", &format!("{} ! avenc_ffv1 ! matroskamux", video(5, 322, "I420")));
        let error =
            FrameSource::open(SourceSpec::File(clip), parameters(Flow::Lossless)).unwrap_err();
        let CaptureError::Size { expected, found, .. } = &error else { panic!("{error}") };
        assert_eq!((*expected, *found), ((320, 240), (322, 240)));
        assert!(
            error.to_string().contains("set camera.width to 322 and camera.height to 240"),
            "{error}"
        );
    });
}

#[test]
fn a_file_says_what_decodes_it() {
    watched(|| {
        let scratch = Scratch::new();
        let clip = scratch
            .clip("clip.mkv", &format!("{} ! avenc_ffv1 ! matroskamux", video(5, 320, "I420")));
        let source = open(&clip, parameters(Flow::Lossless));
        let text = source.describe();
        for part in
            ["clip.mkv", "320x240", "30.00 frames/s", "I420", "limited", "avdec_ffv1 (software)"]
        {
            assert!(text.contains(part), "{part} is missing in: {text}");
        }
        assert!(!source.is_camera());
    });
}

#[test]
fn video_is_told_from_pictures_that_are_coded_each_by_itself() {
    watched(|| {
        let scratch = Scratch::new();
        let decodes_video = |name: &str, coder: &str| {
            let clip =
                scratch.clip(name, &format!("{}{coder} ! matroskamux", video(5, 320, "I420")));
            open(&clip, parameters(Flow::Lossless)).decodes_video()
        };
        assert!(decodes_video("h264.mkv", " ! openh264enc ! h264parse"));
        assert!(!decodes_video("mjpeg.mkv", " ! jpegenc"));
        assert!(!decodes_video("raw.mkv", ""));
    });
}
