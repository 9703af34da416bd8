//! Detection of observers whose sightings contradict the others'.
//!
//! If all observers are right, the graph of all sightings fits as well as the covariances predict.
//! Otherwise each observer is left out in turn, as in satellite navigation (RAIM; Parkinson and
//! Axelrad, 1988). An observer is wrong if its sightings add more to the misfit than chance can;
//! the worst goes first.

use std::collections::BTreeSet;

use flockeye_geometry::filter::chi_square_quantile;

use super::graph::{PairPose, solve};

/// Probability of a false alarm for one observer in one check. With eight observers and ten checks
/// per second this is one false alarm in 200 minutes.
const CHANCE: f64 = 1e-6;

/// The observers whose sightings contradict the others'. `edges` are sightings, each `from` its
/// observer. Drone 0 is this drone, and always trusted.
pub(super) fn contradicting(drones: usize, edges: &[PairPose]) -> Vec<usize> {
    let mut left_out = Vec::new();
    let mut remaining = edges.to_vec();
    loop {
        let all = solve(drones, &remaining);
        if all.degrees == 0 || all.chi_square <= misfit_of_chance(all.degrees) {
            return left_out;
        }
        let observers: BTreeSet<usize> =
            remaining.iter().map(|edge| edge.from).filter(|&observer| observer != 0).collect();
        let mut worst: Option<(f64, usize)> = None;
        for observer in observers {
            let others: Vec<PairPose> =
                remaining.iter().filter(|edge| edge.from != observer).copied().collect();
            let without = solve(drones, &others);
            let degrees = all.degrees.saturating_sub(without.degrees);
            if degrees == 0 {
                continue;
            }
            let excess = (all.chi_square - without.chi_square) / misfit_of_chance(degrees);
            if excess > 1.0 && worst.is_none_or(|(most, _)| excess > most) {
                worst = Some((excess, observer));
            }
        }
        let Some((_, observer)) = worst else { return left_out };
        left_out.push(observer);
        remaining.retain(|edge| edge.from != observer);
    }
}

fn misfit_of_chance(degrees: usize) -> f64 {
    chi_square_quantile(degrees as f64, 1.0 - CHANCE)
}
