//! The `flockeye` command: it creates the shared memory, starts and watches the stages' processes,
//! and shows what they do. The data path does not need it. Commands that no flight needs are passed
//! on to other programs.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`commands`] | the command line |
//! | `other_programs` | passes commands on to the programs that do them |
//! | `up` | runs a pipeline until it ends |
//! | `supervisor` | starts, watches and replaces its processes |
//! | `swap` | replaces a process in flight, so that no frame is lost |
//! | [`control`] | the socket by which a running pipeline is asked to do something |
//! | `manage` | the commands that ask: status, stop, start, restart, swap |
//! | `status` | what runs, as a table and as JSON |
//! | `run_log` | what a run receives: shown, recorded and summed up |
//! | [`process`] | one stage's process: started, restarted, stopped, never an orphan |
//! | `heartbeat` | whether a silent process hangs |
//! | `complaints` | when complaints of a process lead to its replacement |
//! | `dashboard` | what the stages and the neighbours are doing, as a table and as JSON |
//! | `check` | what a configuration means on this machine |
//! | `doctor` | what could keep this machine from flying, and what to do about it |
//! | `metrics` | what is offered to Prometheus |
//! | `service_manager` | reports a run to systemd |
//! | `top` | where a running pipeline's time goes, live or as JSON |
//! | `trace` | frames' paths through all processes, for Perfetto |
//! | `sweep_watch` | how often a running pipeline searches each part of the sphere |
//! | `peers` | what the whole swarm reports over Zenoh |
//! | `keys` | the authority of a swarm, its members' keys and certificates |
//! | `clean` | removes what dead runs left behind |
//! | `bodies` | the marker bodies |
//! | `fault_point` | where tests stop a hand-over |
//! | [`exec`] | the first instructions of a stage's process |

#![warn(unreachable_pub)]

mod bodies;
mod check;
mod clean;
pub mod commands;
mod complaints;
pub mod control;
mod dashboard;
mod doctor;
pub mod exec;
mod fault_point;
mod heartbeat;
mod keys;
mod manage;
mod metrics;
mod other_programs;
mod peers;
pub mod process;
mod run_log;
mod service_manager;
mod status;
mod supervisor;
mod swap;
mod sweep_watch;
mod top;
mod trace;
mod trace_events;
mod up;

pub use swap::shadow::can_shadow;
