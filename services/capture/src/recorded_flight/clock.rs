//! Conversion of a recorded flight's samples to the clock of its playback.

use flockeye_contract::{FrameStamp, ImuSample};

use crate::SourcePicture;
use crate::picture::{Epoch, TapeSample};

/// Epochs of a recorded flight's sensor, renumbered.
#[derive(Debug, Default)]
pub(crate) struct FlightClock {
    epoch: u32,
    /// Recorded epoch of the last sample.
    recorded: Option<Epoch>,
}

impl FlightClock {
    /// The samples of a picture on the clock of its frame, grouped by epoch.
    pub(crate) fn samples_of(
        &mut self,
        picture: &SourcePicture,
        stamp: &FrameStamp,
    ) -> Vec<(u32, Vec<ImuSample>)> {
        let Some(recorded) = &picture.recorded else { return Vec::new() };
        self.on_clock(&recorded.samples, recorded.header.stamp.exposure_ns, stamp.exposure_ns)
    }

    fn on_clock(
        &mut self,
        samples: &[TapeSample],
        recorded_ns: i64,
        played_ns: i64,
    ) -> Vec<(u32, Vec<ImuSample>)> {
        let mut rows: Vec<(u32, Vec<ImuSample>)> = Vec::new();
        for (epoch, sample) in samples {
            let begins = self.recorded.replace(*epoch).is_some_and(|before| before != *epoch);
            self.epoch += u32::from(begins);
            let at_ns = sample.at_ns.saturating_sub(recorded_ns).saturating_add(played_ns);
            let sample = ImuSample { at_ns, ..*sample };
            match rows.last_mut() {
                Some((of, row)) if *of == self.epoch => row.push(sample),
                _ => rows.push((self.epoch, vec![sample])),
            }
        }
        rows
    }

    pub(crate) fn begin_epoch(&mut self) {
        *self = Self { epoch: self.epoch + 1, recorded: None };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_of_a_flight_keep_their_distance_to_the_exposure_and_their_epochs() {
        let of = |epoch: Epoch, at_ns| (epoch, ImuSample { at_ns, ..ImuSample::default() });
        let mut clock = FlightClock::default();
        let mut sent = |samples: &[TapeSample]| -> Vec<(u32, Vec<i64>)> {
            let rows = clock.on_clock(samples, 1000, 5000);
            let times = |row: Vec<ImuSample>| row.iter().map(|sample| sample.at_ns).collect();
            rows.into_iter().map(|(epoch, row)| (epoch, times(row))).collect()
        };
        assert_eq!(sent(&[of((0, 3), 990), of((0, 3), 1010)]), [(0, vec![4990, 5010])]);
        // The sensor began anew, twice.
        let later = [of((0, 3), 1020), of((0, 4), 30), of((1, 0), 40)];
        assert_eq!(sent(&later), [(0, vec![5020]), (1, vec![4030]), (2, vec![4040])]);
    }
}
