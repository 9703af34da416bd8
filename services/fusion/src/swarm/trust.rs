//! Of which neighbours the pixels alone tell the pose, and for which markers are searched as well.

use std::collections::{BTreeMap, BTreeSet};

/// For so many frames a neighbour's markers are waited for after they contradicted its pose.
pub(super) const DOUBTED_FRAMES: u64 = 15;

/// Where a neighbour's pose waits for no marker, they are searched for in every so manyth frame all the
/// same, to be compared with it. That search costs four times what the pose does.
const MARKERS_EVERY_FRAMES: u32 = 4;

/// What the frames so far say.
#[derive(Debug, Default)]
pub struct Trust {
    /// Neighbours whose decoded markers contradicted their pose, and for how many frames that counts.
    doubted: BTreeMap<usize, u64>,
    /// In how many frames in a row each neighbour's pose did not wait for its markers.
    in_a_row: BTreeMap<usize, u32>,
}

impl Trust {
    /// Markers said something else than the pose that came before they were decoded.
    pub fn doubt(&mut self, target: usize) {
        self.doubted.insert(target, DOUBTED_FRAMES);
    }

    /// Whether a neighbour's markers are waited for.
    pub fn is_doubted(&self, target: usize) -> bool {
        self.doubted.contains_key(&target)
    }

    /// A frame has ended in which the poses of these neighbours did not wait for their markers.
    pub fn end_frame(&mut self, peeked: &BTreeSet<usize>) {
        self.doubted.retain(|_, left| {
            *left -= 1;
            *left > 0
        });
        self.in_a_row.retain(|target, _| peeked.contains(target));
        for &target in peeked {
            let in_a_row = self.in_a_row.entry(target).or_default();
            *in_a_row = in_a_row.wrapping_add(1);
        }
    }

    /// Whether a neighbour's gaze view in the next frame need not be searched for markers.
    pub fn needs_no_markers(&self, target: usize) -> bool {
        self.in_a_row.get(&target).is_some_and(|in_a_row| {
            // Not all neighbours in the same frame.
            let turn = in_a_row.wrapping_add(target as u32);
            !self.is_doubted(target) && !turn.is_multiple_of(MARKERS_EVERY_FRAMES)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn markers_are_searched_in_every_fourth_frame_by_turns() {
        let mut trust = Trust::default();
        assert!(!trust.needs_no_markers(0), "nothing is known yet");
        let both = BTreeSet::from([0, 1]);
        let mut searched = [0, 0];
        let mut together = 0;
        for _ in 0..40 {
            trust.end_frame(&both);
            let now = [0, 1].map(|target| !trust.needs_no_markers(target));
            searched = [0, 1].map(|k| searched[k] + u32::from(now[k]));
            together += u32::from(now == [true, true]);
        }
        assert_eq!((searched, together), ([10, 10], 0));
    }

    #[test]
    fn who_is_doubted_or_was_not_seen_at_once_is_searched() {
        let mut trust = Trust::default();
        trust.end_frame(&BTreeSet::from([0, 1]));
        assert!(trust.needs_no_markers(0) && trust.needs_no_markers(1));
        trust.doubt(0);
        assert!(trust.is_doubted(0) && !trust.needs_no_markers(0));
        trust.end_frame(&BTreeSet::from([0]));
        assert!(!trust.needs_no_markers(1), "it was not seen in the last frame");
        for _ in 0..DOUBTED_FRAMES {
            trust.end_frame(&BTreeSet::from([0]));
        }
        assert!(!trust.is_doubted(0));
    }
}
