//! The `flockeye-lab` command: everything that prepares runs and evaluates them. `flockeye` passes
//! its commands on to it.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`commands`] | the command line |
//! | `eval` | compares recorded poses with the truth |
//! | [`evaluation`] | the comparison itself |
//! | `report` | the same as a page with figures |
//! | `experiment` | the paper's tables again, and how consistent covariances are |
//! | `partition` | partitions of the sphere as table, JSON and drawings |
//! | `markers` | a body's facets on paper, to print and glue |
//! | `calibrate` | the commands that find where a body's markers, the camera, its lenses and a sensor really are |
//! | [`calibration`] | the mathematics of these commands |
//! | `up_process` | runs `flockeye up` as a process of its own |

mod calibrate;
pub mod calibration;
pub mod commands;
mod eval;
pub mod evaluation;
mod experiment;
mod markers;
mod partition;
mod report;
mod svg;
mod up_process;
