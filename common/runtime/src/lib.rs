//! What all processes of Flockeye share.
//!
//! A stage is a type that implements [`Stage`]; its `main` is one line, [`stage::main`]. Everything
//! that all stages share is here:
//!
//! | module | what it is for |
//! | --- | --- |
//! | [`instance`] | where one pipeline's shared memory and files live, and who owns it |
//! | [`kept`] | processes that fly on when their launcher dies |
//! | [`recorders`] | how running recorders are found and asked |
//! | [`memory`] | how large each topic's shared memory is, and whether it fits |
//! | [`newest`] | the newest frame of each target |
//! | [`ports`] | publishers and subscribers of the contract's topics |
//! | [`listening`] | whose messages count while a stage is swapped, and complaints |
//! | [`onlooker`] | reading a running pipeline beside its stages |
//! | [`stage`] | the loop: wait, step, send health, drain, stop |
//! | [`credits`] | when a source may send its next frame |
//! | [`resolved_file`] | what follows from the configuration, for stages in other languages |
//! | [`whole_file`] | files that are there as a whole or not at all |
//! | [`saved_state`] | what a process keeps for its successor |
//! | [`health`] | counters and latency quantiles |
//! | [`health_rates`] | what follows from reports of health over time |
//! | [`findings`] | what is found when a machine is examined |
//! | [`background`] | threads for work that nobody waits for |
//! | [`scheduling`] | the scheduling policy of a thread |
//! | `umask` | the umask of a thread that binds sockets |
//! | [`backoff`] | waits between attempts |
//! | [`slots`] | messages that wait for a slow receiver: the newest of each kind |
//! | [`lock`] | locks that survive a panic |
//! | [`clock`] | CLOCK_MONOTONIC |
//! | [`logs`] | structured logs, and warnings that are not repeated on every frame |

#![warn(unreachable_pub)]

pub mod background;
pub mod backoff;
pub mod clock;
pub mod credits;
pub mod findings;
pub mod health;
pub mod health_rates;
pub mod instance;
pub mod kept;
pub mod listening;
pub mod lock;
pub mod logs;
pub mod memory;
pub mod newest;
pub mod onlooker;
pub mod ports;
pub mod recorders;
pub mod resolved_file;
pub mod saved_state;
pub mod scheduling;
pub mod slots;
pub mod stage;
mod umask;
pub mod whole_file;

pub use stage::{Context, Stage, Step};
