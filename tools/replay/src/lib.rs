//! Tools for recorded flights. `flockeye replay` gives a stage its recorded inputs again. `flockeye
//! explain` shows what the stage decided in a frame, and why.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`recorded`] | a recording as the input and output messages of fusion |
//! | [`replay`] | runs the core of fusion by its journal, and compares its output |
//! | [`explain`] | explains why a frame gave a pose of a target, or none |
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
mod tests;
