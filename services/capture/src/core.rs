//! Which frame of which epoch a picture is, and what lies between two of them. It holds no port and no
//! clock.

use flockeye_config::Flow;
use flockeye_contract::FrameStamp;

/// When a picture was taken, as its source says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PictureTime {
    /// Its number since the source was opened, of those that it gave.
    pub sequence: u64,
    /// The number that its frame has: the same, or that of a recorded flight.
    pub number: u64,
    /// Its place in the stream, nanoseconds.
    pub stream_ns: i64,
    /// The middle of its exposure, CLOCK_MONOTONIC, nanoseconds.
    pub exposure_ns: i64,
}

/// A frame that is to be published.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stamped {
    /// Its stamp.
    pub stamp: FrameStamp,
    /// Frames of the source that were left out before it, because a newer one had come.
    pub dropped: u64,
}

/// What capture keeps between frames.
#[derive(Debug, Clone)]
pub struct Core {
    flow: Flow,
    generation: u32,
    epoch: u32,
    next_sequence: u64,
    has_ended: bool,
}

impl Core {
    /// A core of generation `generation` of this stage, before the first frame.
    pub fn new(flow: Flow, generation: u32) -> Self {
        Self { flow, generation, epoch: 0, next_sequence: 0, has_ended: false }
    }

    /// The stamp of a picture that is published at `published_ns`. In lossless flow its exposure is its
    /// stream time, so that filters see the recording's clock.
    pub fn on_picture(&mut self, time: PictureTime, published_ns: i64) -> Stamped {
        let dropped = time.sequence.saturating_sub(self.next_sequence);
        self.next_sequence = time.sequence.saturating_add(1);
        let exposure_ns = match self.flow {
            Flow::Latest => time.exposure_ns,
            Flow::Lossless => time.stream_ns,
        };
        let stamp = FrameStamp {
            sequence: time.number,
            exposure_ns,
            stream_ns: time.stream_ns,
            published_ns,
            epoch: self.epoch,
            source_generation: self.generation,
        };
        Stamped { stamp, dropped }
    }

    /// The source counts from 0 again: it loops, or was opened again.
    pub fn begin_epoch(&mut self) {
        self.epoch += 1;
        self.next_sequence = 0;
    }

    /// Which epoch it is.
    pub fn epoch(&self) -> u32 {
        self.epoch
    }

    /// The source has come to its end.
    pub fn end(&mut self) {
        self.has_ended = true;
    }

    /// Whether nothing more is to come.
    pub fn has_ended(&self) -> bool {
        self.has_ended
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn time(sequence: u64) -> PictureTime {
        let stream_ns = 40 * sequence as i64;
        PictureTime { sequence, number: sequence, stream_ns, exposure_ns: 1000 + stream_ns }
    }

    #[test]
    fn frames_left_out_by_the_source_are_counted_once() {
        let mut core = Core::new(Flow::Latest, 3);
        let dropped: Vec<u64> =
            [0, 1, 4, 5].map(|sequence| core.on_picture(time(sequence), 0).dropped).into();
        assert_eq!(dropped, [0, 0, 2, 0]);
    }

    #[test]
    fn frames_of_a_recorded_flight_keep_their_numbers_and_nothing_is_left_out() {
        let mut core = Core::new(Flow::Latest, 0);
        for (sequence, number) in [(0, 30), (1, 60), (2, 90)] {
            let Stamped { stamp, dropped } =
                core.on_picture(PictureTime { number, ..time(sequence) }, 0);
            assert_eq!((stamp.sequence, dropped), (number, 0));
        }
    }

    #[test]
    fn a_new_epoch_counts_from_zero_and_drops_nothing() {
        let mut core = Core::new(Flow::Latest, 3);
        core.on_picture(time(7), 0);
        core.begin_epoch();
        let Stamped { stamp, dropped } = core.on_picture(time(0), 2000);
        assert_eq!((stamp.order(), dropped), ((3, 1, 0), 0));
        assert_eq!((stamp.exposure_ns, stamp.published_ns), (1000, 2000));
    }

    #[test]
    fn lossless_exposures_are_stream_times() {
        let mut core = Core::new(Flow::Lossless, 0);
        let Stamped { stamp, .. } = core.on_picture(time(2), 9);
        assert_eq!((stamp.exposure_ns, stamp.stream_ns), (80, 80));
        assert!(!core.has_ended());
        core.end();
        assert!(core.has_ended());
    }
}
