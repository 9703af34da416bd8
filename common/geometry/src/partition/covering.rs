//! The covering method: the smallest circles that leave no gap.
//!
//! Many random starts, each brought to its local optimum by [`Ascent`]; then the best one is
//! disturbed again and again (one to three directions are put elsewhere), and the better result
//! kept. The numbers of attempts depend on N alone, never on time, and every operation is rounded
//! alike on every machine: a seed means one partition.

use nalgebra::Vector3;

use super::ascent::Ascent;
use super::random::Random;

/// How long the search goes on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Effort {
    /// Random starts.
    starts: u64,
    /// Disturbances of the best.
    hops: u64,
}

impl Effort {
    /// What repeats the same optimum from other seeds for up to 32 directions; beyond, where an
    /// attempt takes longer, as much as a start of the pipeline can wait for.
    fn of(count: usize) -> Self {
        let attempts = if count <= 32 { 1_200 } else { (200_000 / (count * count)).max(16) };
        let starts = attempts as u64 / 4;
        Self { starts, hops: attempts as u64 - starts }
    }
}

/// `count` directions whose covering radius is, as far as is known, the smallest there is.
pub(super) fn directions(count: usize, seed: u64) -> Vec<Vector3<f64>> {
    let effort = Effort::of(count);
    let mut best: Option<Ascent> = None;
    for start in 0..effort.starts {
        let mut random = Random::new(seed, start);
        let points = (0..count).map(|_| random.direction()).collect();
        // Small numbers are found rather without relaxation, large ones only with it.
        let attempt = if start % 4 == 0 { climb(points, 0, 1.0) } else { climb(points, 30, 0.1) };
        keep_better(&mut best, attempt);
    }
    let mut random = Random::new(seed, effort.starts);
    for _ in 0..effort.hops {
        let Some(so_far) = &best else { break };
        let mut points = so_far.points().to_vec();
        for _ in 0..1 + random.below(3) {
            points[random.below(count)] = random.direction();
        }
        keep_better(&mut best, climb(points, 10, 0.1));
    }
    match best {
        Some(mut best) => {
            best.go_on(1e-6, 1e-14);
            best.points().to_vec()
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
