//! Schedule of the exposure, drawing and publication of frames.

/// Times of a frame, nanoseconds of CLOCK_MONOTONIC.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Times {
    /// Middle of the exposure.
    pub exposure_ns: i64,
    /// Time of publication.
    pub handover_ns: i64,
    /// Time of publication of the next frame: from then on this frame is too late.
    pub next_ns: i64,
}

/// Decay of the maximum drawing time, per frame. After a slow frame, the next hundred frames are
/// dropped slightly earlier.
const FORGETTING: f64 = 0.97;

/// Frames at a constant rate from a start time.
///
/// A frame's exposure is centred on its scheduled time, independent of the drawing time. As with a
/// camera, the frame is published when its exposure ends, so it is drawn before. A frame that would
/// be ready only when the next one is due is dropped.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ExposureSchedule {
    start_ns: i64,
    period_ns: f64,
    half_exposure_ns: i64,
    /// Expected drawing time.
    drawing_ns: f64,
    next: u64,
}

impl ExposureSchedule {
    /// A schedule after frame 0. The middle of its exposure was at `start_ns`; it was published
    /// `half_exposure_ns` later.
    pub(crate) fn new(start_ns: i64, frames_per_second: f64, half_exposure_ns: i64) -> Self {
        Self {
            start_ns,
            period_ns: 1e9 / frames_per_second,
            half_exposure_ns,
            drawing_ns: 0.0,
            next: 1,
        }
    }

    /// A schedule that begins at `now_ns` or at its start, whichever is later. Frames before that
    /// are not counted as dropped.
    pub(crate) fn joining(
        start_ns: i64,
        frames_per_second: f64,
        half_exposure_ns: i64,
        now_ns: i64,
    ) -> Self {
        let schedule = Self::new(start_ns, frames_per_second, half_exposure_ns);
        let elapsed = (now_ns - schedule.times(0).handover_ns) as f64 / schedule.period_ns;
        // Next whole frame number; the cast makes a negative number 0.
        Self { next: elapsed.ceil() as u64, ..schedule }
    }

    /// The times of frame `frame`.
    pub(crate) fn times(&self, frame: u64) -> Times {
        let exposure_ns = |frame: u64| {
            self.start_ns.saturating_add((frame as f64 * self.period_ns).round() as i64)
        };
        let handover_ns = |frame| exposure_ns(frame).saturating_add(self.half_exposure_ns);
        Times {
            exposure_ns: exposure_ns(frame),
            handover_ns: handover_ns(frame),
            next_ns: handover_ns(frame.saturating_add(1)),
        }
    }

    /// The time to begin drawing the next frame, so that it is ready `frames_ahead` frames before
    /// it is due. Earlier drawing would compete with the detection in the last frame.
    pub(crate) fn begin_ns(&self, frames_ahead: u64) -> i64 {
        let drawn_ns = self.times(self.next.saturating_sub(frames_ahead)).handover_ns;
        drawn_ns.saturating_sub(self.drawing_ns as i64)
    }

    /// The frame to draw now, and the number of frames dropped before it. It is the next frame or,
    /// if that is late, the newest frame due when drawing ends.
    pub(crate) fn draw(&mut self, now_ns: i64) -> (u64, u64) {
        let drawn_ns = now_ns + self.drawing_ns as i64;
        let elapsed = (drawn_ns - self.times(0).handover_ns) as f64 / self.period_ns;
        let frame = (elapsed.floor() as u64).max(self.next);
        let skipped = frame - self.next;
        self.next = frame + 1;
        (frame, skipped)
    }

    /// Notes the drawing time of a frame. The expected time is at most one period.
    pub(crate) fn drew(&mut self, took_ns: i64) {
        self.drawing_ns = (FORGETTING * self.drawing_ns).max(took_ns as f64).min(self.period_ns);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_there_when_their_exposure_ends() {
        let schedule = ExposureSchedule::new(1_000, 1e8, 2);
        let times = Times { exposure_ns: 1_010, handover_ns: 1_012, next_ns: 1_022 };
        assert_eq!(schedule.times(1), times);
        let last = schedule.times(u64::MAX);
        assert_eq!((last.handover_ns, last.next_ns), (i64::MAX, i64::MAX));
    }

    #[test]
    fn they_are_drawn_one_after_the_other_however_early() {
        let mut schedule = ExposureSchedule::new(0, 1e8, 2);
        for frame in 1..9 {
            schedule.drew(5);
            assert_eq!(schedule.begin_ns(0), schedule.times(frame).handover_ns - 5);
            let two_before = schedule.times(frame.saturating_sub(2));
            assert_eq!(schedule.begin_ns(2), two_before.handover_ns - 5);
            assert_eq!(schedule.draw(3), (frame, 0));
        }
    }

    #[test]
    fn who_joins_begins_with_the_next_frame_and_has_left_none_out() {
        let joined_at = |now_ns| {
            let mut schedule = ExposureSchedule::joining(1_000, 1e8, 2, now_ns);
            schedule.draw(now_ns)
        };
        assert_eq!(joined_at(0), (0, 0), "before its start");
        assert_eq!(joined_at(1_033), (4, 0));
    }

    #[test]
    fn who_is_late_leaves_frames_out() {
        let mut schedule = ExposureSchedule::new(0, 1e8, 0);
        assert_eq!(schedule.draw(35), (3, 2));
        schedule.drew(8);
        // Drawn by 49, before the next one should be there; then by 65, which is too late for 5.
        assert_eq!(schedule.draw(41), (4, 0));
        assert_eq!(schedule.draw(57), (6, 1));
        // Quicker for once: it is not believed at once.
        schedule.drew(1);
        assert_eq!(schedule.draw(83), (9, 2));
        (0..200).for_each(|_| schedule.drew(1));
        assert_eq!(schedule.draw(103), (10, 0));
        schedule.drew(1_000);
        assert_eq!(schedule.draw(103), (11, 0), "one period at most");
    }
}
