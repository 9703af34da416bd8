//! The rendered flight, where it is at hand.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::time::{Duration, Instant};

use common::{open, play, watched};
use flockeye_capture::{EndReason, SourceParameters};
use flockeye_config::Flow;
use flockeye_contract::Range;

#[test]
fn the_flight_has_300_frames_a_thirtieth_of_a_second_apart() {
    let Some(recordings) = flockeye_require::recordings() else { return };
    let flight = recordings.join("flight1/flight1.mp4");
    watched(move || {
        let mut source = open(
            &flight,
            SourceParameters { flow: Flow::Lossless, ..SourceParameters::new(3840, 1920) },
        );
        println!("{}", source.describe());
        let begun = Instant::now();
        let mut count = 0;
        let end = play(&mut source, |picture| {
            assert_eq!(picture.sequence(), u64::from(count));
            let off = picture.stream_time().abs_diff(Duration::from_secs(1) * count / 30);
            assert!(
                off < Duration::from_micros(100),
                "frame {count} is at {:?}",
                picture.stream_time()
            );
            assert_eq!(
                (picture.range(), picture.luma().len()),
                (Range::Limited, picture.stride() * 1919 + 3840)
            );
            count += 1;
        });
        assert_eq!(end, EndReason::Complete { frames: 300, skipped: 0 });
        println!("{:.1} ms a frame", begun.elapsed().as_secs_f64() * 1e3 / 300.0);
    });
}
