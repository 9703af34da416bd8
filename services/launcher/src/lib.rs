//! The `flockeye` command: it creates the shared memory, starts and watches the stages' processes,
//! and shows their state. The data path does not need it. Commands that no flight needs are passed
//! on to other programs.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`commands`] | the command line |
//! | `other_programs` | passes commands on to the programs that do them |
//! | `up` | runs a pipeline until it ends |
//! | `supervisor` | starts, watches and replaces its processes |
//! | `swap` | replaces a process in flight, so that no frame is lost |
//! | [`control`] | the socket for requests to a running pipeline |
//! | `manage` | the commands that send requests: status, stop, start, restart, swap |
//! | `status` | status of the processes, as a table and as JSON |
//! | `run_log` | messages of a run: shown, recorded and summed up |
//! | [`process`] | one stage's process: started, restarted, stopped, never an orphan |
//! | `heartbeat` | whether a silent process hangs |
//! | `complaints` | when complaints of a process lead to its replacement |
//! | `dashboard` | state of the stages and the neighbours, as a table and as JSON |
//! | `check` | consequences of a configuration on this machine |
//! | `doctor` | faults that could keep this machine from flying, and their cures |
//! | `metrics` | metrics for Prometheus |
//! | `service_manager` | reports a run to systemd |
//! | `top` | rates and latencies of a running pipeline, live or as JSON |
//! | `trace` | frames' paths through all processes, for Perfetto |
//! | `sweep_watch` | search rate of each part of the sphere |
//! | `peers` | reports of the whole swarm over Zenoh |
//! | `keys` | the authority of a swarm, its members' keys and certificates |
//! | `clean` | removes leftovers of dead runs |
//! | `bodies` | the marker bodies |
//! | `fault_point` | steps of a hand-over at which tests stop it |
//! | [`exec`] | the first instructions of a stage's process |

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
