//! Which window a partition is searched with this time.

use crate::detector::Threshold;

/// Partitions that are told apart; of more, those share a turn that lie so far apart in the sweep.
const PARTITIONS: usize = 256;

/// By turns: in flight a partition is searched with one window at a time, so that the sphere is
/// searched nearly twice as often. Most markers are found with either, and the others at one of the next
/// visits: each worker counts its own, so of one visit more than there are workers two differ.
#[derive(Debug, Clone)]
pub struct Turns {
    next: [u8; PARTITIONS],
}

impl Default for Turns {
    fn default() -> Self {
        Self { next: [0; PARTITIONS] }
    }
}

impl Turns {
    /// The one of `thresholds` whose turn it is in a partition. The first is the one that finds most.
    pub fn take(&mut self, partition: u32, thresholds: &[Threshold]) -> Vec<Threshold> {
        let turn = &mut self.next[partition as usize % PARTITIONS];
        let place = usize::from(*turn).checked_rem(thresholds.len()).unwrap_or(0);
        *turn = turn.wrapping_add(1);
        thresholds.get(place).copied().into_iter().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_partition_gets_each_window_in_turn() {
        let windows = [7, 31].map(|window_px| Threshold { window_px, darker_by: 4 });
        let mut turns = Turns::default();
        let mut take = |partition| turns.take(partition, &windows)[0].window_px;
        assert_eq!([take(0), take(0), take(0)], [7, 31, 7]);
        assert_eq!([take(5), take(6), take(5), take(6)], [7, 7, 31, 31]);
        // As many times as there is room to count, and whatever a foreign rectifier calls it.
        let seen: Vec<usize> = (0..600).map(|_| take(u32::MAX)).collect();
        assert!(seen.windows(2).all(|pair| pair[0] != pair[1]));
        assert!(turns.take(0, &[]).is_empty());
    }
}
