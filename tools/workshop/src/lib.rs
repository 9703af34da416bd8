//! The `flockeye-workshop` command: tools to write stages and to test pipelines, which are not used
//! in flight. `flockeye` passes its commands on to it.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`commands`] | the command line |
//! | `conformance` | tests a stage alone against the contract |
//! | `new_stage` | writes a stage that runs as it is |
//! | `contract` | prints the contract for other languages |
//! | `chaos` | disturbs a running pipeline, and reports how it recovers |
//! | `swarm_simulation` | flies a swarm on this machine, and compares its poses with the truth |
//! | `fleet` | pipelines that are processes of their own |
//! | `dice` | random numbers that are the same in each run |

mod chaos;
pub mod commands;
mod conformance;
mod contract;
mod dice;
mod fleet;
mod new_stage;
mod swarm_simulation;
