//! The covering method: the smallest circles that leave no gap.
//!
//! [`Ascent`] brings many random starts to their local optimum. Then the best one is disturbed
//! repeatedly (one to three directions move elsewhere), and the better result is kept. The numbers
//! of attempts depend on N alone, never on time, and every operation is rounded alike on every
//! machine. So a seed always gives the same partition.

use nalgebra::Vector3;

use super::ascent::Ascent;
use crate::random::Chance;

/// Finds `count` directions with the smallest known covering radius.
pub(super) fn directions(count: usize, seed: u64) -> Vec<Vector3<f64>> {
    // Enough attempts to reach the same optimum from other seeds for up to 32 directions. For more
    // directions an attempt takes longer, so their number follows from the acceptable time of a
    // start.
    let attempts: usize = if count <= 32 { 1_200 } else { (200_000 / (count * count)).max(16) };
    let starts = attempts as u64 / 4;
    let mut best: Option<Ascent> = None;
    for start in 0..starts {
        let mut random = Chance::stream(seed, start);
        let points = (0..count).map(|_| random.portable_direction()).collect();
        // Small numbers of directions are best found without relaxation, large ones only with it.
        let attempt = if start % 4 == 0 { climb(points, 0, 1.0) } else { climb(points, 30, 0.1) };
        keep_better(&mut best, attempt);
    }
    let mut random = Chance::stream(seed, starts);
    for _ in starts..attempts as u64 {
        let Some(so_far) = &best else { break };
        let mut points = so_far.points.clone();
        for _ in 0..1 + random.below(3) {
            points[random.below(count)] = random.portable_direction();
        }
        keep_better(&mut best, climb(points, 10, 0.1));
    }
    match best {
        Some(mut best) => {
            best.go_on(1e-6, 1e-14);
            best.points
        }
        None => Vec::new(),
    }
}

/// The optimum near `points` after `rounds` of relaxation; `None` where they have no hull.
fn climb(points: Vec<Vector3<f64>>, rounds: usize, first_gap: f64) -> Option<Ascent> {
    let mut ascent = Ascent::new(points)?;
    ascent.relax(rounds);
    ascent.go_on(first_gap, 1e-7);
    Some(ascent)
}

fn keep_better(best: &mut Option<Ascent>, attempt: Option<Ascent>) {
    let Some(attempt) = attempt else { return };
    if best.as_ref().is_none_or(|best| attempt.cosine() > best.cosine() + 1e-9) {
        *best = Some(attempt);
    }
}
