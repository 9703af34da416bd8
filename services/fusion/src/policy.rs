//! Which pass may run for a target in a frame, and how thorough it may be.

use std::collections::{BTreeMap, BTreeSet};

/// How much time the measurement of a frame may take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TimeBudget {
    /// As much as it takes: every pass runs for every frame, and none waits in the background.
    Unlimited,
    /// Until the next frame comes.
    OneFrame,
    /// The budget is spent: newer frames wait already.
    Overspent,
}

/// For so many frames a target's direct pass is suspended after markers contradicted its pose.
pub const SUSPENDED_FRAMES: u64 = 15;

/// Every so many frames of the direct pass are searched for markers too, for comparison. A search
/// costs four times as much as the direct pass.
const MARKERS_EVERY_FRAMES: u32 = 4;

/// Every third frame has time to search round the prediction of one target that is out of sight.
const SEARCH_EVERY_FRAMES: u64 = 3;

/// Whether one target may be searched for round its prediction in frame number `frame`: this pass costs
/// most, so targets take turns.
pub fn is_search_turn(frame: u64, target: usize, targets: usize) -> bool {
    let turn = frame / SEARCH_EVERY_FRAMES % targets as u64;
    frame.is_multiple_of(SEARCH_EVERY_FRAMES) && turn == target as u64
}

/// Which targets the direct pass measures, and which of their regions need not be searched for markers.
#[derive(Debug, Default)]
pub struct DirectPassPolicy {
    /// Targets whose markers contradicted a direct pose, and for how many more frames that counts.
    suspended: BTreeMap<usize, u64>,
    /// In how many frames in a row the direct pass has measured each target.
    in_a_row: BTreeMap<usize, u32>,
}

impl DirectPassPolicy {
    /// Notes that markers contradicted a pose of the direct pass.
    pub fn suspend(&mut self, target: usize) {
        self.suspended.insert(target, SUSPENDED_FRAMES);
    }

    /// Whether a target has to wait for its markers.
    pub fn is_suspended(&self, target: usize) -> bool {
        self.suspended.contains_key(&target)
    }

    /// Ends a frame in which the direct pass measured these targets.
    pub fn end_frame(&mut self, measured: &BTreeSet<usize>) {
        self.suspended.retain(|_, left| {
            *left -= 1;
            *left > 0
        });
        self.in_a_row.retain(|target, _| measured.contains(target));
        for &target in measured {
            let in_a_row = self.in_a_row.entry(target).or_default();
            *in_a_row = in_a_row.wrapping_add(1);
        }
    }

    /// Whether the region of interest of a target need not be searched for markers in the next frame.
    pub fn needs_no_markers(&self, target: usize) -> bool {
        self.in_a_row.get(&target).is_some_and(|in_a_row| {
            // Offset by the target, so that not all are searched in the same frame.
            let turn = in_a_row.wrapping_add(target as u32);
            !self.is_suspended(target) && !turn.is_multiple_of(MARKERS_EVERY_FRAMES)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn markers_are_searched_in_every_fourth_frame_by_turns() {
        let mut policy = DirectPassPolicy::default();
        assert!(!policy.needs_no_markers(0), "nothing is known yet");
        let both = BTreeSet::from([0, 1]);
        let mut searched = [0, 0];
        let mut together = 0;
        for _ in 0..40 {
            policy.end_frame(&both);
            let now = [0, 1].map(|target| !policy.needs_no_markers(target));
            searched = [0, 1].map(|k| searched[k] + u32::from(now[k]));
            together += u32::from(now == [true, true]);
        }
        assert_eq!((searched, together), ([10, 10], 0));
    }

    #[test]
    fn suspended_and_missed_targets_are_searched_for_markers() {
        let mut policy = DirectPassPolicy::default();
        policy.end_frame(&BTreeSet::from([0, 1]));
        assert!(policy.needs_no_markers(0) && policy.needs_no_markers(1));
        policy.suspend(0);
        assert!(policy.is_suspended(0) && !policy.needs_no_markers(0));
        policy.end_frame(&BTreeSet::from([0]));
        assert!(!policy.needs_no_markers(1), "the last frame did not measure it");
        for _ in 0..SUSPENDED_FRAMES {
            policy.end_frame(&BTreeSet::from([0]));
        }
        assert!(!policy.is_suspended(0));
    }

    #[test]
    fn targets_take_turns_at_the_search() {
        let turns: Vec<(u64, usize)> = (0..12)
            .flat_map(|frame| (0..2).map(move |target| (frame, target)))
            .filter(|&(frame, target)| is_search_turn(frame, target, 2))
            .collect();
        assert_eq!(turns, [(0, 0), (3, 1), (6, 0), (9, 1)]);
    }
}
