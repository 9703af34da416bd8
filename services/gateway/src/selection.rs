//! Selection of the reported frames, where the rate is limited (`gateway.report_hz`).

use std::collections::VecDeque;

use flockeye_contract::FrameStamp;

/// Maximum decisions that are kept: more tracks of those frames may arrive.
const REMEMBERED: usize = 16;
/// Ratio of the period to the time by which a frame may be early: exposures are not evenly spaced.
const EARLY: i64 = 4;

/// Decides once for each frame, so that it is reported completely or not at all.
#[derive(Debug, Default)]
pub(crate) struct FrameSelection {
    /// Period of reports, nanoseconds. `None`: each frame is reported.
    period_ns: Option<i64>,
    due_ns: i64,
    decided: VecDeque<(FrameStamp, bool)>,
}

impl FrameSelection {
    /// A selection of at most `hz` frames per second on average. `None`: all of them.
    pub(crate) fn new(hz: Option<f64>) -> Self {
        Self { period_ns: hz.map(|hz| (1e9 / hz) as i64), ..Self::default() }
    }

    /// Whether the frame with this exposure is reported.
    pub(crate) fn admits(&mut self, stamp: &FrameStamp, exposure_ns: i64) -> bool {
        let Some(period_ns) = self.period_ns else { return true };
        let known = self.decided.iter().find(|(other, _)| other.order() == stamp.order());
        if let Some((_, is_reported)) = known {
            return *is_reported;
        }
        let is_begun_anew = self.due_ns - exposure_ns > 2 * period_ns;
        let is_due = exposure_ns + period_ns / EARLY >= self.due_ns;
        let is_reported = is_due || is_begun_anew;
        if is_reported {
            let next_ns = self.due_ns + period_ns;
            let is_on_time = !is_begun_anew && next_ns > exposure_ns;
            self.due_ns = if is_on_time { next_ns } else { exposure_ns + period_ns };
        }
        if self.decided.len() == REMEMBERED {
            self.decided.pop_front();
        }
        self.decided.push_back((*stamp, is_reported));
        is_reported
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn stamp(sequence: u64) -> FrameStamp {
        FrameStamp { sequence, ..FrameStamp::default() }
    }

    /// Frames that are reported of `count` at `frame_hz`, whose exposures are off by up to a tenth
    /// of the time between them.
    fn reported(report_hz: f64, frame_hz: f64, count: u64, seed: u64) -> usize {
        let mut selection = FrameSelection::new(Some(report_hz));
        let exposure_ns = |sequence: u64| {
            let off =
                (sequence ^ seed).wrapping_mul(0x9e37_79b9_7f4a_7c15) as f64 / u64::MAX as f64;
            ((sequence as f64 + 0.2 * (off - 0.5)) * 1e9 / frame_hz) as i64
        };
        let admitted = (0..count).filter(|k| selection.admits(&stamp(*k), exposure_ns(*k)));
        admitted.count()
    }

    proptest! {
        #[test]
        fn as_many_are_reported_as_asked(report_hz in 1.0..60.0, frame_hz in 5.0..60.0, seed: u64) {
            let seconds = 60.0;
            let count = (seconds * frame_hz) as u64;
            let share = reported(report_hz, frame_hz, count, seed) as f64 / count as f64;
            let wanted = f64::min(report_hz / frame_hz, 1.0);
            prop_assert!((share - wanted).abs() < 0.02 * wanted + 2.0 / count as f64, "{share} of {wanted}");
        }
    }

    #[test]
    fn a_rate_of_the_camera_itself_leaves_no_frame_out() {
        assert_eq!(reported(30.0, 30.0, 300, 7), 300);
    }

    #[test]
    fn all_that_is_said_of_a_frame_is_reported_or_nothing() {
        let mut selection = FrameSelection::new(Some(10.0));
        let ms = 1_000_000;
        assert!(selection.admits(&stamp(0), 0));
        assert!(!selection.admits(&stamp(1), 33 * ms));
        assert!(selection.admits(&stamp(0), 0), "its other half, late");
        assert!(selection.admits(&stamp(3), 100 * ms));
        assert!(!selection.admits(&stamp(1), 33 * ms));
    }

    #[test]
    fn a_source_that_begins_anew_is_reported_at_once() {
        let mut selection = FrameSelection::new(Some(1.0));
        assert!(selection.admits(&stamp(500), 100_000_000_000));
        let anew = FrameStamp { epoch: 1, ..stamp(0) };
        assert!(selection.admits(&anew, 0));
    }

    #[test]
    fn without_a_rate_all_are_reported() {
        let mut selection = FrameSelection::new(None);
        assert!((0..100).all(|k| selection.admits(&stamp(k), k as i64)));
    }
}
