//! When which frame is exposed, drawn and handed over.

/// A frame that is due.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Due {
    /// Its number.
    pub frame: u64,
    /// Frames before it that could not be drawn in time.
    pub skipped: u64,
}

/// When a frame is exposed and given away, nanoseconds of CLOCK_MONOTONIC.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Times {
    /// The middle of its exposure.
    pub exposure_ns: i64,
    /// When it is handed over.
    pub handover_ns: i64,
}

/// What is left of the longest time that drawing took, after each frame: one slow frame lets the next
/// hundred be drawn a little early.
const FORGETTING: f64 = 0.97;

/// Frames at a steady rate from a start.
///
/// A frame is exposed round its scheduled instant, however long the work of drawing it takes, and handed
/// over when its exposure ends: a camera's picture is there then. So it is drawn before, in the time that
/// drawing was seen to take. Where that is too short it comes later; one that would come when the next one
/// should be there is left out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Schedule {
    start_ns: i64,
    period_ns: f64,
    half_exposure_ns: i64,
    /// How long drawing is expected to take.
    drawing_ns: f64,
    next: u64,
}

impl Schedule {
    /// The middle of frame 0's exposure was at `start_ns`; `half_exposure_ns` later it was handed over.
    pub fn new(start_ns: i64, frames_per_second: f64, half_exposure_ns: i64) -> Self {
        Self {
            start_ns,
            period_ns: 1e9 / frames_per_second,
            half_exposure_ns,
            drawing_ns: 0.0,
            next: 1,
        }
    }

    /// When frame `frame` is exposed and handed over.
    pub fn times(&self, frame: u64) -> Times {
        let exposure_ns = self.start_ns + (frame as f64 * self.period_ns).round() as i64;
        Times { exposure_ns, handover_ns: exposure_ns + self.half_exposure_ns }
    }

    /// When the next frame is to be drawn.
    pub fn next_ns(&self) -> i64 {
        self.times(self.next).handover_ns - self.drawing_ns as i64
    }

    /// The frame to draw now, if there is one: the newest that is to be there once it is drawn.
    pub fn due(&mut self, now_ns: i64) -> Option<Due> {
        if now_ns < self.next_ns() {
            return None;
        }
        let drawn_ns = now_ns + self.drawing_ns as i64;
        let elapsed = (drawn_ns - self.times(0).handover_ns) as f64 / self.period_ns;
        let frame = (elapsed.floor() as u64).max(self.next);
        let skipped = frame - self.next;
        self.next = frame + 1;
        Some(Due { frame, skipped })
    }

    /// Takes note of how long a frame took to draw. None is begun more than a period early.
    pub fn drew(&mut self, took_ns: i64) {
        self.drawing_ns = (FORGETTING * self.drawing_ns).max(took_ns as f64).min(self.period_ns);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(frame: u64) -> Option<Due> {
        Some(Due { frame, skipped: 0 })
    }

    #[test]
    fn frames_are_there_when_their_exposure_ends() {
        let mut schedule = Schedule::new(1_000, 1e8, 2);
        assert_eq!(schedule.times(1), Times { exposure_ns: 1_010, handover_ns: 1_012 });
        assert_eq!((schedule.due(1_011), schedule.due(1_012)), (None, frame(1)));
        assert_eq!((schedule.due(1_021), schedule.due(1_022)), (None, frame(2)));
    }

    #[test]
    fn they_are_drawn_before() {
        let mut schedule = Schedule::new(0, 1e8, 2);
        schedule.drew(5);
        assert_eq!((schedule.next_ns(), schedule.due(6), schedule.due(7)), (7, None, frame(1)));
        // Faster for once: it is not believed at once.
        schedule.drew(1);
        assert_eq!(schedule.next_ns(), 22 - 4);
        for _ in 0..200 {
            schedule.drew(1);
        }
        assert_eq!(schedule.next_ns(), 22 - 1);
        // Never more than one frame ahead.
        schedule.drew(1_000);
        assert_eq!((schedule.due(11), schedule.due(12)), (None, frame(2)));
    }

    #[test]
    fn who_is_late_leaves_frames_out() {
        let mut schedule = Schedule::new(0, 1e8, 0);
        assert_eq!(schedule.due(35), Some(Due { frame: 3, skipped: 2 }));
        assert_eq!(schedule.due(39), None);
        schedule.drew(8);
        // Drawn by 49, before the next one should be there; then by 65, which is too late for 5.
        assert_eq!(schedule.due(41), frame(4));
        assert_eq!(schedule.due(57), Some(Due { frame: 6, skipped: 1 }));
    }
}
