//! Poses of all drones of a swarm, from their sightings of each other.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`replay`] | a filter for measurements that arrive late and out of order |
//! | [`graph`] | poses of all drones from pairwise sightings, by least squares |
//! | [`honesty`] | detection of observers that contradict the others |
//! | [`view`] | combines these parts, with sightings as they arrive |
//!
//! Each measurement counts once. Both drones' measurements of each other go into one filter,
//! because the errors of measurements are independent. The error of a camera's lens
//! model is not: it is the same in all frames, and the filter makes it too small. Filtered poses have correlated errors from
//! shared assumptions, so covariance intersection combines them. Each pair is one edge of a graph,
//! so chains and loops count each edge once too.

mod graph;
mod honesty;
mod replay;
mod view;

pub use view::{DronePlace, SwarmView};

#[cfg(test)]
mod tests;
