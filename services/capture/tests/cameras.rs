//! Cameras, played by GStreamer's test source: their clock, their loss, their return.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::time::Duration;

use common::{parameters, watched};
use flockeye_capture::{CaptureError, Event, FrameSource, SourceParameters, SourceSpec};
use flockeye_config::Flow;
use flockeye_runtime::clock::monotonic_ns;

const TIMEOUT: Duration = Duration::from_secs(5);
const CAPS: &str = "video/x-raw,format=NV12,width=320,height=240,framerate=30/1";

fn camera(description: &str, params: SourceParameters) -> FrameSource {
    FrameSource::open(format!("gst:{description}").parse().unwrap(), params).unwrap()
}

fn quick(flow: Flow) -> SourceParameters {
    let ms = Duration::from_millis;
    SourceParameters { reopen_min: ms(20), reopen_max: ms(50), stall: ms(500), ..parameters(flow) }
}

#[test]
fn a_camera_that_goes_away_is_opened_again() {
    watched(|| {
        let mut source = camera(
            &format!("videotestsrc is-live=true num-buffers=5 ! {CAPS}"),
            quick(Flow::Latest),
        );
        assert!(source.is_camera());
        let mut rounds: Vec<Vec<u64>> = vec![Vec::new()];
        while rounds.len() <= 3 {
            match source.next(TIMEOUT).unwrap() {
                Event::Frame(picture) => rounds.last_mut().unwrap().push(picture.sequence()),
                Event::Lost { reason, retry_in } => {
                    assert!(reason.contains("videotestsrc"), "{reason}");
                    assert_eq!(
                        retry_in,
                        Duration::from_millis(20),
                        "a frame came, so the wait starts anew"
                    );
                    rounds.push(Vec::new());
                }
                Event::Idle => {}
                other => panic!("{other:?}"),
            }
        }
        for round in &rounds[..3] {
            assert!(
                !round.is_empty()
                    && round.is_sorted()
                    && round.iter().all(|&sequence| sequence < 5),
                "{round:?}"
            );
        }
    });
}

#[test]
fn a_camera_that_is_not_there_is_waited_for_longer_and_longer() {
    watched(|| {
        let missing = SourceSpec::V4l2("/dev/video-that-is-not-there".into());
        let mut source = FrameSource::open(missing, quick(Flow::Latest)).unwrap();
        let mut waits = Vec::new();
        while waits.len() < 4 {
            match source.next(TIMEOUT).unwrap() {
                Event::Lost { reason, retry_in } => {
                    assert!(
                        reason.contains("/dev/video-that-is-not-there") && reason.contains("Cure"),
                        "{reason}"
                    );
                    waits.push(retry_in.as_millis());
                }
                Event::Idle => {}
                other => panic!("{other:?}"),
            }
        }
        assert_eq!(waits, [20, 40, 50, 50]);
    });
}

#[test]
fn a_camera_that_falls_silent_is_lost() {
    watched(|| {
        let stalling = format!("videotestsrc is-live=true ! {CAPS} ! valve drop=true");
        let mut source = camera(&stalling, quick(Flow::Latest));
        loop {
            match source.next(Duration::from_millis(50)).unwrap() {
                Event::Lost { reason, .. } => {
                    break assert!(reason.contains("no frame for 0.5 s"), "{reason}");
                }
                Event::Idle => {}
                other => panic!("{other:?}"),
            }
        }
    });
}

#[test]
fn exposure_is_arrival_less_the_latency() {
    watched(|| {
        let latency = Duration::from_millis(250);
        let params = SourceParameters { latency, ..quick(Flow::Latest) };
        let before_ns = monotonic_ns();
        let mut source = camera(&format!("videotestsrc is-live=true ! {CAPS} ! jpegenc"), params);
        let mut last = None;
        while last.is_none_or(|(sequence, _)| sequence < 10) {
            if let Event::Frame(picture) = source.next(TIMEOUT).unwrap() {
                let arrival_ns = picture.exposure_monotonic_ns() + latency.as_nanos() as i64;
                assert!(
                    (before_ns..=monotonic_ns()).contains(&arrival_ns),
                    "{before_ns} {arrival_ns}"
                );
                if let Some((sequence, previous_ns)) = last {
                    assert!(picture.sequence() > sequence && arrival_ns > previous_ns);
                }
                last = Some((picture.sequence(), arrival_ns));
            }
        }
        let text = source.describe();
        assert!(text.contains("jpegdec (software)") && text.contains("I420"), "{text}");
    });
}

#[test]
fn a_description_in_lossless_flow_is_a_recording() {
    watched(|| {
        let mut source =
            camera(&format!("videotestsrc num-buffers=7 ! {CAPS}"), quick(Flow::Lossless));
        let mut count = 0;
        let end = common::play(&mut source, |picture| {
            assert_eq!(picture.sequence(), count);
            assert_eq!(picture.format(), "NV12");
            count += 1;
        });
        assert_eq!(end.to_string(), "complete: 7 frames");
    });
}

#[test]
fn packed_colour_becomes_gray() {
    watched(|| {
        let packed = CAPS.replace("NV12", "YUY2");
        let mut source =
            camera(&format!("videotestsrc num-buffers=2 ! {packed}"), quick(Flow::Lossless));
        common::play(&mut source, |picture| assert_eq!(picture.format(), "GRAY8"));
    });
}

#[test]
fn missing_elements_say_what_to_install() {
    watched(|| {
        let unknown = "nosuchsrc ! queue".parse().unwrap();
        let error = FrameSource::open(unknown, quick(Flow::Latest)).unwrap_err();
        assert!(
            matches!(&error, CaptureError::MissingElement { element, .. } if element == "nosuchsrc"),
            "{error:?}"
        );
        let senseless = "videotestsrc ! ! queue".parse().unwrap();
        let error = FrameSource::open(senseless, quick(Flow::Latest)).unwrap_err();
        assert!(matches!(error, CaptureError::Description { .. }), "{error:?}");
        match FrameSource::open(SourceSpec::Theta, quick(Flow::Latest)) {
            Err(CaptureError::MissingElement { element, cure }) => {
                assert_eq!(element, "thetauvcsrc");
                assert!(cure.contains("gstthetauvc"), "{cure}");
            }
            Err(other) => panic!("{other:?}"),
            Ok(_) => println!("SKIPPED: the Theta driver is installed here"),
        }
    });
}

#[test]
fn a_size_that_changes_in_mid_stream_is_an_error() {
    watched(|| {
        let description = format!(
            "concat name=joined videotestsrc num-buffers=3 ! {CAPS} ! joined. \
             videotestsrc num-buffers=3 ! {} ! joined. joined. ! identity",
            CAPS.replace("width=320", "width=160")
        );
        let mut source = camera(&description, quick(Flow::Lossless));
        let mut frames = 0;
        let error = loop {
            match source.next(TIMEOUT) {
                Ok(Event::Frame(_)) => frames += 1,
                Ok(other) => panic!("{other:?}"),
                Err(error) => break error,
            }
        };
        assert_eq!(frames, 3);
        assert!(matches!(error, CaptureError::Size { found: (160, 240), .. }), "{error:?}");
    });
}
