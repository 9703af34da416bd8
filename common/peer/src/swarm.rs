//! Where all drones of a swarm are, by what each of them sees of the others.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`replay`] | a filter whose measurements may come late and out of order |
//! | [`graph`] | poses of all drones from the pairs that see each other, by least squares |
//! | [`honesty`] | whose sightings contradict the others' |
//! | [`view`] | all of that, fed with sightings as they come |
//!
//! Each measurement counts once. What two drones measure of each other goes into one filter,
//! because the errors of measurements are independent. Where only filtered poses are at hand, their
//! errors share what both filters assume, and covariance intersection combines them. Then each pair
//! is one edge of a graph, so that a chain and a loop of pairs count each of them once too.

mod graph;
mod honesty;
mod replay;
mod view;

pub use view::{DronePlace, SwarmView};

#[cfg(test)]
mod tests;
