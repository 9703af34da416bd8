//! When which frame is exposed.

/// A frame that is due.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Due {
    /// Its number.
    pub frame: u64,
    /// Frames before it that could not be rendered in time.
    pub skipped: u64,
}

/// Frames at a steady rate from a start. A frame is exposed at its scheduled instant, however long
/// the work of rendering it takes afterwards.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Schedule {
    start_ns: i64,
    period_ns: f64,
    next: u64,
}

impl Schedule {
    /// Frame 0 is exposed at `start_ns`.
    pub fn new(start_ns: i64, frames_per_second: f64) -> Self {
        Self { start_ns, period_ns: 1e9 / frames_per_second, next: 0 }
    }

    /// When frame `frame` is exposed.
    pub fn exposure_ns(&self, frame: u64) -> i64 {
        self.start_ns + (frame as f64 * self.period_ns).round() as i64
    }

    /// When the next frame is exposed.
    pub fn next_ns(&self) -> i64 {
        self.exposure_ns(self.next)
    }

    /// The newest frame whose instant has come, if there is one that was not due before.
    pub fn due(&mut self, now_ns: i64) -> Option<Due> {
        if now_ns < self.next_ns() {
            return None;
        }
        let elapsed = (now_ns - self.start_ns) as f64 / self.period_ns;
        let frame = (elapsed.floor() as u64).max(self.next);
        let skipped = frame - self.next;
        self.next = frame + 1;
        Some(Due { frame, skipped })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_come_at_their_instants() {
        let mut schedule = Schedule::new(1_000, 1e8);
        assert_eq!(schedule.due(999), None);
        assert_eq!(schedule.due(1_000), Some(Due { frame: 0, skipped: 0 }));
        assert_eq!(schedule.due(1_009), None);
        assert_eq!(schedule.due(1_010), Some(Due { frame: 1, skipped: 0 }));
        assert_eq!(schedule.exposure_ns(1), 1_010);
    }

    #[test]
    fn who_is_late_leaves_frames_out() {
        let mut schedule = Schedule::new(0, 1e8);
        assert_eq!(schedule.due(35), Some(Due { frame: 3, skipped: 3 }));
        assert_eq!(schedule.due(39), None);
    }
}
