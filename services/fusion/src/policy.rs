//! Which pass may run for a target in a frame, and how thorough it may be.

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
pub(crate) const SUSPENDED_FRAMES: u64 = 15;

/// Every so many frames of the direct pass are searched for markers too, for comparison. A search
/// costs four times as much as the direct pass.
pub(crate) const MARKERS_EVERY_FRAMES: u32 = 4;

/// Every third frame has time to search round the prediction of one target that is out of sight.
const SEARCH_EVERY_FRAMES: u64 = 3;

/// Whether one target may be searched for round its prediction in frame number `frame`: this pass
/// costs most, so targets take turns.
pub(crate) fn is_search_turn(frame: u64, target: usize, targets: usize) -> bool {
    let turn = frame / SEARCH_EVERY_FRAMES % targets as u64;
    frame.is_multiple_of(SEARCH_EVERY_FRAMES) && turn == target as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_take_turns_at_the_search() {
        let turns: Vec<(u64, usize)> = (0..12)
            .flat_map(|frame| (0..2).map(move |target| (frame, target)))
            .filter(|&(frame, target)| is_search_turn(frame, target, 2))
            .collect();
        assert_eq!(turns, [(0, 0), (3, 1), (6, 0), (9, 1)]);
    }
}
