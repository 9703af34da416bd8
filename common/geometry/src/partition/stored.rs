//! Partitions found beforehand, so that a start costs nothing.
//!
//! `data/partitions.json` is what `flockeye partition --compute --json` printed; it reads the
//! directions and rolls, and measures everything else again.

use std::sync::LazyLock;

use nalgebra::{Unit, Vector3};
use serde::Deserialize;

use super::Partition;

#[derive(Deserialize)]
struct File {
    partitions: Vec<Entry>,
}

#[derive(Deserialize)]
struct Entry {
    directions: Vec<[f64; 3]>,
    rolls_deg: Vec<f64>,
}

#[expect(clippy::expect_used, reason = "the file is part of the program; a test reads all of it")]
static PARTITIONS: LazyLock<Vec<Partition>> = LazyLock::new(|| {
    let file: File =
        serde_json::from_str(include_str!("../../data/partitions.json")).expect("partitions.json");
    let partitions = file.partitions.into_iter().map(|entry| {
        // As written, to the last bit: they are unit vectors already.
        let direction = |&xyz: &[f64; 3]| Unit::new_unchecked(Vector3::from(xyz));
        let directions = entry.directions.iter().map(direction).collect();
        Partition::new(directions, entry.rolls_deg).expect("a covering")
    });
    partitions.collect()
});

/// The stored covering by `count` circles.
pub(super) fn partition(count: usize) -> Option<Partition> {
    PARTITIONS.iter().find(|partition| partition.len() == count).cloned()
}
