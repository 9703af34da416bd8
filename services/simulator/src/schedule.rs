//! When which frame is exposed, drawn and handed over.

/// A frame that is due.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Due {
    /// Its number.
    pub frame: u64,
    /// Frames before it that could not be drawn in time.
    pub skipped: u64,
}

/// What is left of the longest time that drawing took, after each frame: one slow frame lets the next
/// hundred be drawn a little early.
const FORGETTING: f64 = 0.97;

/// Frames at a steady rate from a start.
///
/// A frame is exposed round its scheduled instant, however long the work of drawing it takes, and handed
/// over when its exposure ends: a camera's picture is there then. So it is drawn before, in the time that
/// drawing was seen to take; where that is too short it comes later.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Schedule {
    start_ns: i64,
    period_ns: f64,
    /// From the middle of a frame's exposure to its end.
    half_exposure_ns: i64,
    /// How long drawing is expected to take.
    drawing_ns: f64,
    next: u64,
}

impl Schedule {
    /// The middle of frame 0's exposure is at `start_ns`.
    pub fn new(start_ns: i64, frames_per_second: f64, exposure_s: f64) -> Self {
        Self {
            start_ns,
            period_ns: 1e9 / frames_per_second,
            half_exposure_ns: (exposure_s * 0.5e9).round() as i64,
            drawing_ns: 0.0,
            next: 0,
        }
    }

    /// The middle of frame `frame`'s exposure.
    pub fn exposure_ns(&self, frame: u64) -> i64 {
        self.start_ns + (frame as f64 * self.period_ns).round() as i64
    }

    /// When frame `frame` is handed over.
    pub fn handover_ns(&self, frame: u64) -> i64 {
        self.exposure_ns(frame) + self.half_exposure_ns
    }

    /// When the next frame is to be drawn.
    pub fn next_ns(&self) -> i64 {
        self.handover_ns(self.next) - self.drawing_ns as i64
    }

    /// The frame to draw now, if there is one: the next, or the newest that should be there already.
    pub fn due(&mut self, now_ns: i64) -> Option<Due> {
        if now_ns < self.next_ns() {
            return None;
        }
        let elapsed = (now_ns - self.handover_ns(0)) as f64 / self.period_ns;
        let frame = (elapsed.floor().max(0.0) as u64).max(self.next);
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

    fn first(frame: u64) -> Option<Due> {
        Some(Due { frame, skipped: 0 })
    }

    #[test]
    fn frames_are_there_when_their_exposure_ends() {
        let mut schedule = Schedule::new(1_000, 1e8, 4e-9);
        assert_eq!(schedule.due(1_001), None);
        assert_eq!(schedule.due(1_002), first(0));
        assert_eq!((schedule.exposure_ns(1), schedule.handover_ns(1)), (1_010, 1_012));
        assert_eq!(schedule.due(1_011), None);
        assert_eq!(schedule.due(1_012), first(1));
    }

    #[test]
    fn they_are_drawn_before() {
        let mut schedule = Schedule::new(0, 1e8, 4e-9);
        assert_eq!(schedule.due(2), first(0));
        schedule.drew(5);
        assert_eq!((schedule.next_ns(), schedule.due(6), schedule.due(7)), (7, None, first(1)));
        // Faster for once: it is not believed at once.
        schedule.drew(1);
        assert_eq!(schedule.next_ns(), 22 - 4);
        for _ in 0..200 {
            schedule.drew(1);
        }
        assert_eq!(schedule.next_ns(), 22 - 1);
        // Never more than one frame ahead.
        schedule.drew(1_000);
        assert_eq!((schedule.due(11), schedule.due(12)), (None, first(2)));
    }

    #[test]
    fn who_is_late_leaves_frames_out() {
        let mut schedule = Schedule::new(0, 1e8, 0.0);
        assert_eq!(schedule.due(35), Some(Due { frame: 3, skipped: 3 }));
        assert_eq!(schedule.due(39), None);
        schedule.drew(25);
        // One that is late is drawn all the same while no other should be there.
        assert_eq!(schedule.due(49), first(4));
        assert_eq!(schedule.due(62), Some(Due { frame: 6, skipped: 1 }));
    }
}
