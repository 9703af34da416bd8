//! Decoders that hold frames back or do not keep up: what is done and said about them, with real
//! streams.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::time::Duration;

use common::{parameters, watched};
use flockeye_capture::{Event, FrameSource, SourceParameters, SourceSpec};
use flockeye_config::Flow;
use flockeye_runtime::clock::monotonic_ns;

const CAPS: &str = "video/x-raw,format=I420,width=320,height=240,framerate=30/1";
/// A second of start-up, two that are counted, and some to spare.
const FRAMES: usize = 110;

/// What a camera had to say.
struct Watched {
    /// What was said of frames that come late.
    late: Vec<String>,
    /// Why it was opened anew.
    lost: Vec<String>,
    /// From a frame's exposure until it was handed out, median.
    age: Duration,
    described: String,
}

/// Plays a camera for some frames, or until it has said so much.
fn watch(description: &str, decoder_threads: u32, until: impl Fn(&Watched) -> bool) -> Watched {
    let spec: SourceSpec = format!("gst:{description}").parse().unwrap();
    let params = SourceParameters { decoder_threads, ..parameters(Flow::Latest) };
    let mut source = FrameSource::open(spec, params).unwrap();
    let mut ages_ns = Vec::new();
    let mut watched = Watched {
        late: Vec::new(),
        lost: Vec::new(),
        age: Duration::ZERO,
        described: String::new(),
    };
    while ages_ns.len() < FRAMES && !until(&watched) {
        match source.next(Duration::from_secs(5)).unwrap() {
            Event::Frame(picture) => ages_ns.push(monotonic_ns() - picture.exposure_monotonic_ns()),
            Event::Late { what } => watched.late.push(what),
            Event::Lost { reason, .. } => watched.lost.push(reason),
            Event::Idle => {}
            other => panic!("{other:?}"),
        }
    }
    ages_ns.sort_unstable();
    let median_ns = ages_ns.get(ages_ns.len() / 2).copied().unwrap_or(0);
    watched.age = Duration::from_nanos(median_ns.unsigned_abs());
    watched.described = source.describe();
    watched
}

fn assert_said(watched: &Watched, wanted: &[&str]) {
    let [what] = watched.late.as_slice() else { panic!("not once: {:?}", watched.late) };
    assert!(wanted.iter().all(|part| what.contains(part)), "{wanted:?} in {what}");
}

/// The number that stands before some words.
fn number_before(text: &str, words: &str) -> f64 {
    let (before, _) = text.split_once(words).expect("the words are in it");
    before.rsplit(' ').next().and_then(|number| number.parse().ok()).expect("a number")
}

#[test]
fn a_camera_that_does_not_say_that_it_is_live_is_decoded_without_delay() {
    watched(|| {
        // Like the Theta's driver: each frame at its due time, without a live announcement.
        let theta = format!(
            "videotestsrc name=thetauvcsrc pattern=ball ! {CAPS} ! openh264enc ! h264parse ! clocksync"
        );
        let never = |_: &Watched| false;
        let at_once = watch(&theta, 0, never);
        assert!(at_once.late.is_empty() && at_once.lost.is_empty(), "{:?}", at_once.late);
        let held = watch(&theta, 3, never);
        assert_said(
            &held,
            &[
                "avdec_h264 (software) holds 2 frames back",
                "3 frames are decoded at a time",
                "Cure: source.decoder_threads: 0",
            ],
        );
        // Two frames of 33.3 ms, measured by when they came in a second.
        let each_ms = number_before(&held.late[0], " ms older");
        assert!((63.0..=70.0).contains(&each_ms), "{each_ms} ms");
        assert!(held.described.ends_with(", 2 frames late"), "{}", held.described);
        // Two frames are 67 ms.
        let older = held.age.saturating_sub(at_once.age);
        assert!(older > Duration::from_millis(40), "{:?} and {:?}", held.age, at_once.age);
    });
}

#[test]
fn frames_that_rest_on_later_ones_are_said_to_cost_time() {
    watched(|| {
        let encoder = format!(
            "videotestsrc is-live=true pattern=ball ! {CAPS} ! x265enc speed-preset=ultrafast ! h265parse"
        );
        let seen = watch(&encoder, 0, |watched| !watched.late.is_empty());
        assert_said(&seen, &["holds 2 frames back", "(B-frames). Cure: switch them off"]);
    });
}

#[test]
fn a_decoder_that_waits_for_an_order_that_never_changes_is_named() {
    watched(|| {
        let decoder = format!(
            "videotestsrc is-live=true pattern=ball ! {CAPS} ! \
             x265enc speed-preset=ultrafast tune=zerolatency ! h265parse ! libde265dec"
        );
        let seen = watch(&decoder, 0, |watched| !watched.late.is_empty());
        assert_said(&seen, &["libde265dec (software) holds", "none are. Cure: "]);
    });
}

#[test]
fn a_decoder_that_does_not_keep_up_gets_more_threads_unless_their_number_is_configured() {
    watched(|| {
        // Each frame gets to the decoder 10 ms later than the one before.
        let slow = format!(
            "videotestsrc is-live=true pattern=ball ! {CAPS} ! openh264enc ! h264parse ! queue ! \
             identity sleep-time=43000"
        );
        let fixed = watch(&slow, 1, |watched| !watched.late.is_empty());
        assert_said(&fixed, &["before the decoder, ever longer. Cure: source.decoder_threads: 0"]);
        assert!(fixed.lost.is_empty(), "{:?}", fixed.lost);
        let free = watch(&slow, 0, |watched| !watched.late.is_empty() || !watched.lost.is_empty());
        let processors = std::thread::available_parallelism().unwrap().get();
        match processors {
            1 => assert_said(&free, &["before the decoder, ever longer"]),
            _ => assert!(free.lost[0].contains("now decodes several at a time"), "{:?}", free.lost),
        }
    });
}
