//! Precomputed partitions, so that a start takes no time for them.
//!
//! `data/partitions.json` is the output of `flockeye partition --compute --json`. Only its
//! directions and rolls are read; [`super::Partition`] measures everything else again.

use nalgebra::{Unit, Vector3};
use serde::Deserialize;

use crate::Ray;

#[derive(Deserialize)]
struct StoredCovering {
    directions: Vec<[f64; 3]>,
    rolls_deg: Vec<f64>,
}

/// The stored coverings: the directions of each, and the roll of each view.
#[expect(clippy::expect_used, reason = "the file is part of the program; a test reads all of it")]
pub(super) fn coverings() -> impl Iterator<Item = (Vec<Ray>, Vec<f64>)> {
    let mut file: serde_json::Value =
        serde_json::from_str(include_str!("../../data/partitions.json")).expect("partitions.json");
    let coverings: Vec<StoredCovering> =
        serde_json::from_value(file["partitions"].take()).expect("partitions.json");
    coverings.into_iter().map(|covering| {
        // Exact to the last bit as written: they are unit vectors already.
        let direction = |&xyz: &[f64; 3]| Unit::new_unchecked(Vector3::from(xyz));
        (covering.directions.iter().map(direction).collect(), covering.rolls_deg)
    })
}
