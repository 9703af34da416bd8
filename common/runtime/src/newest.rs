//! Newest frame of each target, for filtering tracks of earlier frames.

use std::collections::BTreeMap;

use flockeye_contract::{FrameStamp, Track};

/// The newest frame of each target.
#[derive(Debug, Default)]
pub struct Newest(BTreeMap<u32, FrameStamp>);

impl Newest {
    /// The tracks of a frame that are not late ([`FrameStamp::is_late_beside`]) beside earlier ones
    /// of the same target.
    pub fn tracks<'t>(
        &mut self,
        stamp: &FrameStamp,
        tracks: &'t [Track],
    ) -> impl Iterator<Item = &'t Track> {
        tracks.iter().filter(|track| self.admits(track.target, stamp))
    }

    /// Whether this frame of a target is not late. A frame that is not late becomes the newest.
    fn admits(&mut self, target: u32, stamp: &FrameStamp) -> bool {
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
    fn older_frames_are_left_out_but_a_source_may_begin_anew() {
        let mut newest = Newest::default();
        assert!(newest.admits(0, &stamp(0, 500)));
        assert!(newest.admits(0, &stamp(0, 500)), "a better pose of the same frame");
        assert!(!newest.admits(0, &stamp(0, 499)));
        assert!(newest.admits(1, &stamp(0, 499)), "another neighbour");
        assert!(newest.admits(0, &stamp(0, 501)));
        assert!(newest.admits(0, &stamp(1, 0)), "another epoch");
        assert!(newest.admits(0, &stamp(1, 300)));
        assert!(newest.admits(0, &stamp(1, 0)), "anew, without another epoch");
    }
}
