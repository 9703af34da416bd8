//! Functions that all processes of Flockeye share.
//!
//! A stage is a type that implements [`Stage`]; its `main` is one line, [`stage::main`]. Everything
//! that all stages share is here:
//!
//! | module | what it is for |
//! | --- | --- |
//! | [`instance`] | folder, shared memory and owner of each pipeline |
//! | [`kept`] | processes that fly on when their launcher dies |
//! | [`recorders`] | discovery and control of running recorders |
//! | [`memory`] | size of each topic's shared memory, and the check against free memory |
//! | [`newest`] | the newest frame of each target |
//! | [`ports`] | publishers and subscribers of the contract's topics |
//! | [`listening`] | selection of messages while a stage is swapped, and complaints |
//! | [`onlooker`] | access of tools to a running pipeline's messages |
//! | [`stage`] | the loop: wait, step, send health, drain, stop |
//! | [`credits`] | flow control: when a source may send its next frame |
//! | [`resolved_file`] | values derived from the configuration, for stages in other languages |
//! | [`whole_file`] | atomic files |
//! | [`saved_state`] | saved states of workers for their successors |
//! | [`health`] | counters and latency quantiles |
//! | [`health_rates`] | rates from successive health reports |
//! | [`findings`] | findings of the examination of a machine |
//! | [`background`] | threads for background work |
//! | [`scheduling`] | the scheduling policy of a thread |
//! | `umask` | the umask of a thread that binds sockets |
//! | [`backoff`] | waits between attempts |
//! | [`slots`] | messages that wait for a slow receiver: the newest of each kind |
//! | [`lock`] | locks that survive a panic |
//! | [`clock`] | CLOCK_MONOTONIC |
//! | [`logs`] | structured logs, and warnings that are not repeated on every frame |

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
