//! `libflockeye_stage`: stages in C and in whatever calls C, over the runtime that Flockeye's own
//! stages have.
//!
//! The header `include/flockeye/stage.h` says what each function does and what its caller owes.
//! Everything here is `unsafe` for that reason alone: C hands over pointers, and promises in the
//! header what they are.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`stage`] | a stage: it joins, runs its loop, sends health, ends |
//! | [`configuration`] | what the configuration says, without pointers |
//! | [`lookup`] | numbers and texts of the configuration, and whose a marker is |
//! | [`ports`] | subscribers and publishers of any topic, by name |
//! | [`failure`] | why the last call failed |

pub mod configuration;
pub mod failure;
pub mod lookup;
pub mod ports;
pub mod stage;
