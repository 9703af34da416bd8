//! What was said of each neighbour last, so that nothing older is said after it.

use std::collections::BTreeMap;

use flockeye_contract::FrameStamp;

/// A frame behind by more was not late: its source has begun anew without saying so.
const LATEST_BY_FRAMES: u64 = 64;

/// The newest frame of each target.
#[derive(Debug, Default)]
pub struct Newest(BTreeMap<u32, FrameStamp>);

impl Newest {
    /// Whether what this frame says of a target is not older than what was said of it before; then it
    /// is what was said last. Fusion may say what one frame shows of a neighbour after what the next
    /// does, and whoever hears only the last word must not get an old one.
    pub fn is_newest(&mut self, target: u32, stamp: &FrameStamp) -> bool {
        let is_older = self.0.get(&target).is_some_and(|last| {
            (last.source_generation, last.epoch) == (stamp.source_generation, stamp.epoch)
                && (1..=LATEST_BY_FRAMES).contains(&last.sequence.wrapping_sub(stamp.sequence))
        });
        if !is_older {
            self.0.insert(target, *stamp);
        }
        !is_older
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stamp(epoch: u32, sequence: u64) -> FrameStamp {
        FrameStamp { epoch, sequence, ..FrameStamp::default() }
    }

    #[test]
    fn nothing_older_is_said_but_a_source_may_begin_anew() {
        let mut newest = Newest::default();
        assert!(newest.is_newest(0, &stamp(0, 500)));
        assert!(newest.is_newest(0, &stamp(0, 500)), "a better word on the same frame");
        assert!(!newest.is_newest(0, &stamp(0, 499)));
        assert!(newest.is_newest(1, &stamp(0, 499)), "another neighbour");
        assert!(newest.is_newest(0, &stamp(0, 501)));
        assert!(newest.is_newest(0, &stamp(1, 0)), "another epoch");
        assert!(newest.is_newest(0, &stamp(1, 300)));
        assert!(newest.is_newest(0, &stamp(1, 0)), "anew, without another epoch");
    }
}
