//! Rules on which pass may run for a target in a frame, and on its thoroughness.

/// Time budget for the measurement of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TimeBudget {
    /// Unlimited: every pass runs for every frame, and none waits in the background.
    Unlimited,
    /// Until the next frame comes.
    OneFrame,
    /// The budget is spent: newer frames wait already.
    Overspent,
}

/// Number of frames for which a target's direct pass is suspended after markers contradicted its
/// pose.
pub(crate) const SUSPENDED_FRAMES: u64 = 15;

/// Period in frames at which targets of the direct pass are searched for markers too, for
/// comparison. A search costs four times as much as the direct pass.
pub(crate) const MARKERS_EVERY_FRAMES: u32 = 4;

/// Period in frames at which there is time for a search around the prediction of one target out of
/// sight.
const SEARCH_EVERY_FRAMES: u64 = 3;

/// Whether one target may be searched for around its prediction in frame number `frame`. This pass
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
