//! The `flockeye-lab` command: preparation and evaluation of runs. `flockeye` passes its commands
//! on to it.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`commands`] | the command line |
//! | `eval` | compares recorded poses with the truth |
//! | [`evaluation`] | the comparison itself |
//! | `report` | the comparison as a page with figures |
//! | `experiment` | repeats the paper's tables, and tests the consistency of covariances |
//! | `film` | draws simulated flights as videos |
//! | `partition` | partitions of the sphere as table, JSON and drawings |
//! | `markers` | a body's facets on paper, to print and glue |
//! | `calibrate` | commands that measure the real poses of markers, camera, lenses and sensors |
//! | [`calibration`] | the mathematics of these commands |
//! | `up_process` | runs `flockeye up` as a process of its own |

mod calibrate;
pub mod calibration;
pub mod commands;
mod eval;
pub mod evaluation;
mod experiment;
mod film;
mod markers;
mod partition;
mod report;
mod svg;
mod up_process;
