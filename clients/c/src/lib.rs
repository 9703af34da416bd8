//! `libflockeye_stage`: stages in C, or in a language that can call C. They use the same runtime as
//! Flockeye's own stages.
//!
//! The header `include/flockeye/stage.h` describes each function and the duties of its caller. The
//! functions are `unsafe` for one reason: they take raw pointers from C. The header states what
//! these must point to.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`stage`] | a stage: it joins, runs its loop, sends health, ends |
//! | [`configuration`] | values of the configuration, without pointers |
//! | [`lookup`] | numbers and texts of the configuration, and the body of a marker |
//! | [`ports`] | subscribers and publishers of any topic, by name |
//! | [`failure`] | the reason of the last failure |

pub mod configuration;
pub mod failure;
pub mod lookup;
pub mod ports;
pub mod stage;
