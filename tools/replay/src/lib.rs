//! Work on recorded flights: `flockeye replay` gives a stage again what it got, and `flockeye
//! explain` says what it decided in a frame, and why.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`recorded`] | a recording as the messages that fusion got and gave |
//! | [`replay`] | runs the core of fusion as its journal says, and compares what it gives with what it gave |
//! | [`explain`] | why a frame of a recording gave a pose of a target, or none |
//! | [`commands`] | the command line |

pub mod commands;
mod explain;
mod recorded;
mod replay;

#[cfg(test)]
#[path = "../../../common/imaging/tests/drawn_body/mod.rs"]
mod drawn_body;
#[cfg(test)]
mod fixtures;
#[cfg(test)]
mod flights;
