//! Stage: tracks to Zenoh, and the peers' reports back.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`report`] | a track as what goes over the network |
//! | [`stage`] | the ports around it |

pub mod report;
pub mod stage;
