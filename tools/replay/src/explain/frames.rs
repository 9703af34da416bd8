//! Lists the frames of a recording, and finds the requested one.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{bail, ensure};
use flockeye_contract::{FrameOrder, FrameStamp};

use super::asked::When;
use super::gathered::stamp_of;
use crate::recorded::{LostMessages, RecordedFlight};

/// Time after the last exposure that still belongs to that frame, seconds.
const LAST_FRAME_S: f64 = 0.25;

/// The frames of a recording.
#[derive(Debug)]
pub(super) struct FrameList {
    stamps: BTreeMap<FrameOrder, FrameStamp>,
    /// Beginning of the recording on the clock of the exposures, nanoseconds.
    begun_ns: i64,
    /// Messages that the recording lacks.
    pub lost: LostMessages,
}

impl FrameList {
    /// Reads a recording to its end or to the damage.
    pub(super) fn of(path: &Path) -> anyhow::Result<Self> {
        let mut recorded = RecordedFlight::open(path)?;
        let mut stamps = BTreeMap::new();
        let mut first_utc_ns = None;
        loop {
            match recorded.next_message() {
                Ok(Some((message, utc_ns))) => {
                    first_utc_ns.get_or_insert(utc_ns);
                    if let Some(stamp) = stamp_of(&message) {
                        stamps.entry(stamp.order()).or_insert(stamp);
                    }
                }
                Ok(None) => break,
                Err(error) if stamps.is_empty() => return Err(error),
                Err(error) => {
                    tracing::warn!("the recording is read up to here: {error:#}");
                    break;
                }
            }
        }
        let utc_from_exposure_ns = recorded.number("utc_from_exposure_ns").unwrap_or_default();
        let is_lossless = recorded.flow() == Some("lossless");
        let begun_ns = match first_utc_ns.and_then(|utc_ns| i64::try_from(utc_ns).ok()) {
            // Times of a lossless run begin at 0; others begin with the recording.
            Some(utc_ns) if !is_lossless => utc_ns - utc_from_exposure_ns,
            _ => 0,
        };
        ensure!(!stamps.is_empty(), "the recording has no frame. Cure: record for longer");
        Ok(Self { stamps, begun_ns, lost: recorded.lost() })
    }

    /// Exposure of a frame, seconds since the recording began.
    fn at_s(&self, stamp: &FrameStamp) -> f64 {
        stamp.exposure_ns.saturating_sub(self.begun_ns) as f64 * 1e-9
    }

    /// The requested frame, and its exposure, seconds since the recording began. Numbers repeat
    /// after a restart of the source; then the first frame with the number is returned.
    pub(super) fn chosen(&self, when: When) -> anyhow::Result<(FrameStamp, f64)> {
        let found = match when {
            When::Frame(number) => self.stamps.values().find(|stamp| stamp.sequence == number),
            When::Exactly { source, epoch, number } => self.stamps.values().find(|stamp| {
                (stamp.source_generation, stamp.epoch, stamp.sequence) == (source, epoch, number)
            }),
            When::At(at_s) => {
                let by_then = self.stamps.values().filter(|stamp| self.at_s(stamp) <= at_s + 1e-9);
                let last = by_then.max_by_key(|stamp| stamp.exposure_ns);
                let newest = self.stamps.values().map(|stamp| self.at_s(stamp));
                let newest_s = newest.fold(f64::MIN, f64::max);
                last.filter(|_| at_s <= newest_s + LAST_FRAME_S)
            }
        };
        let Some(stamp) = found else {
            bail!("{} is not in the recording. {}", said(when), self.extent())
        };
        Ok((*stamp, self.at_s(stamp)))
    }

    /// The first and the last frame, as text.
    fn extent(&self) -> String {
        let ends = self.stamps.first_key_value().zip(self.stamps.last_key_value());
        let Some(((_, first), (_, last))) = ends else { return String::new() };
        format!(
            "Its frames are {} to {}, from {:.3} s to {:.3} s",
            first.sequence,
            last.sequence,
            self.at_s(first),
            self.at_s(last)
        )
    }
}

fn said(when: When) -> String {
    match when {
        When::Frame(number) => format!("frame {number}"),
        When::Exactly { source, epoch, number } => format!("frame {source}.{epoch}.{number}"),
        When::At(at_s) => format!("the time {at_s} s"),
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::fixtures::stamp;

    #[test]
    fn the_last_frame_that_was_exposed_by_then_is_meant() {
        let stamps = (3..9).map(|number| (stamp(number).order(), stamp(number))).collect();
        let frames = FrameList { stamps, begun_ns: 10_000_000_000, lost: Vec::new() };
        let number = |when| frames.chosen(when).map(|(stamp, _)| stamp.sequence);
        assert_eq!(number(When::Frame(5)).unwrap(), 5);
        let FrameStamp { source_generation: source, epoch, .. } = stamp(5);
        assert_eq!(number(When::Exactly { source, epoch, number: 5 }).unwrap(), 5);
        assert!(number(When::Exactly { source, epoch: epoch + 1, number: 5 }).is_err());
        assert_eq!(number(When::At(0.1)).unwrap(), 3, "it is exposed then");
        assert_eq!(number(When::At(0.16)).unwrap(), 4);
        assert_eq!(number(When::At(0.3)).unwrap(), 8, "no newer one");
        for when in [When::Frame(2), When::Frame(9), When::At(0.05), When::At(2.0)] {
            let said = number(when).unwrap_err().to_string();
            assert!(said.contains("Its frames are 3 to 8, from 0.100 s to 0.267 s"), "{said}");
        }
    }
}
