//! Sequence numbers and stream times of decoded frames.

use std::time::Duration;

/// Counter of decoded frames before any is dropped. Stream times start at the first frame.
#[derive(Debug, Default)]
pub(crate) struct Census {
    pub(crate) first: Duration,
    previous: Option<(u64, Duration)>,
}

impl Census {
    /// Counts frames that were left out before the next one.
    pub(crate) fn skip(&mut self, frames: u64) {
        self.previous.iter_mut().for_each(|(sequence, _)| *sequence += frames);
    }

    /// Numbers the next decoded frame. `time` is its time stamp in the stream; `frame` is the frame
    /// period, for streams without time stamps. Returns its sequence number and its time since the
    /// stream's first frame.
    pub(crate) fn enter(
        &mut self,
        time: Option<Duration>,
        frame: Option<Duration>,
    ) -> (u64, Duration) {
        let (sequence, expected) = match self.previous {
            Some((sequence, time)) => (sequence + 1, time + frame.unwrap_or_default()),
            None => (0, Duration::ZERO),
        };
        let time = time.unwrap_or(expected);
        if sequence == 0 {
            self.first = time;
        }
        self.previous = Some((sequence, time));
        (sequence, time.saturating_sub(self.first))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_counts_from_the_first_frame() {
        const FRAME: Duration = Duration::from_nanos(33_366_667);
        let mut census = Census::default();
        let start = Duration::from_millis(80);
        assert_eq!(census.enter(Some(start), Some(FRAME)), (0, Duration::ZERO));
        assert_eq!(census.enter(Some(start + FRAME), Some(FRAME)), (1, FRAME));
        assert_eq!(census.enter(None, Some(FRAME)), (2, 2 * FRAME));
        census.skip(2);
        assert_eq!(census.enter(Some(start + 5 * FRAME), Some(FRAME)), (5, 5 * FRAME));
    }
}
