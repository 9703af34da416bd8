//! The `flockeye` command: it creates the shared memory, starts and watches the stages' processes,
//! and shows what they do. The data path never needs it.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`cli`] | the command line |
//! | [`up`] | runs a pipeline until it ends |
//! | [`process`] | one stage's process: started, restarted, stopped, never an orphan |
//! | [`dashboard`] | what the stages and the neighbours are doing, as a table |
//! | [`screen`] | the terminal: log lines above, the table below |
//! | [`record`] | poses and truth as CSV |
//! | [`evaluation`] | poses against the truth |
//! | [`report`] | the same as a page with figures |
//! | [`experiment`] | the paper's tables anew, and how consistent covariances are |
//! | [`check`] | what a configuration means on this machine |
//! | [`partition`] | partitions of the sphere as table, JSON and drawings |
//! | [`markers`] | a body's facets on paper, to print and glue |
//! | [`calibrate`] | where a body's markers really are |
//! | [`sweep`] | how often each part of the sphere is searched |
//! | [`top`] | where a running pipeline's time goes, live or as JSON |
//! | [`trace`] | frames' ways through all processes, for Perfetto |
//! | [`attach`] | a running pipeline's messages, read beside its stages |
//! | [`peers`] | what the whole swarm reports over Zenoh |
//! | [`clean`] | removes what dead runs left behind |
//! | [`exec`] | the first instructions of a stage's process |

pub mod attach;
pub mod calibrate;
pub mod check;
pub mod clean;
pub mod cli;
pub mod dashboard;
pub mod evaluation;
pub mod exec;
pub mod experiment;
pub mod markers;
pub mod partition;
pub mod peers;
pub mod process;
pub mod record;
pub mod report;
pub mod schema;
pub mod screen;
mod svg;
pub mod sweep;
pub mod top;
pub mod trace;
pub mod up;
