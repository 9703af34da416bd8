//! What was said of each neighbour last, so that nothing older is said after it.

use std::collections::BTreeMap;

use flockeye_contract::FrameStamp;

/// The newest frame of each target.
#[derive(Debug, Default)]
pub struct Newest(BTreeMap<u32, FrameStamp>);

impl Newest {
    /// Whether what this frame says of a target is not late ([`FrameStamp::is_late_beside`]); then it is
    /// what was said last.
    pub fn is_newest(&mut self, target: u32, stamp: &FrameStamp) -> bool {
        let is_late = self.0.get(&target).is_some_and(|last| stamp.is_late_beside(last));
        if !is_late {
            self.0.insert(target, *stamp);
        }
        !is_late
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
