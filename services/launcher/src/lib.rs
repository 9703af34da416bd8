//! The `flockeye` command: it creates the shared memory, starts and watches the stages' processes,
//! and shows what they do. The data path does not need it. Commands that evaluate are passed on to
//! `flockeye-lab`.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`commands`] | the command line |
//! | [`lab`] | passes commands on to `flockeye-lab` |
//! | [`up`] | runs a pipeline until it ends |
//! | [`supervisor`] | starts, watches and replaces its processes |
//! | [`swap`] | replaces a process in flight, so that no frame is lost |
//! | [`control`] | the socket by which a running pipeline is asked to do something |
//! | [`manage`] | the commands that ask: status, stop, start, restart, swap |
//! | [`chaos`] | disturbs a running pipeline, and reports how it recovers |
//! | [`status`] | what runs, as a table and as JSON |
//! | [`run_log`] | what a run receives: shown, recorded and summed up |
//! | [`process`] | one stage's process: started, restarted, stopped, never an orphan |
//! | [`heartbeat`] | whether a silent process hangs |
//! | [`complaints`] | when what others say of a process leads to its replacement |
//! | [`dashboard`] | what the stages and the neighbours are doing, as a table and as JSON |
//! | [`check`] | what a configuration means on this machine |
//! | [`doctor`] | what could keep this machine from flying, and what to do about it |
//! | [`metrics`] | what is offered to Prometheus |
//! | [`service_manager`] | what systemd is told of a run |
//! | [`top`] | where a running pipeline's time goes, live or as JSON |
//! | [`trace`] | frames' paths through all processes, for Perfetto |
//! | [`attach`] | a running pipeline's messages, read beside its stages |
//! | [`sweep_watch`] | how often a running pipeline searches each part of the sphere |
//! | [`peers`] | what the whole swarm reports over Zenoh |
//! | [`swarm`] | a simulated swarm on this machine, compared with the truth |
//! | [`keys`] | the authority of a swarm, its members' keys and certificates |
//! | [`clean`] | removes what dead runs left behind |
//! | [`schema`] | the JSON Schema of pipeline.yaml |
//! | [`bodies`], [`contract`] | the marker bodies; the contract for other languages |
//! | [`stage`] | writes stages of one's own |
//! | [`conformance`] | tests a stage alone against the contract |
//! | [`dice`] | chance that repeats |
//! | [`fault_point`] | where tests stop a hand-over |
//! | [`exec`] | the first instructions of a stage's process |

pub mod attach;
pub mod bodies;
pub mod chaos;
pub mod check;
pub mod clean;
pub mod commands;
pub mod complaints;
pub mod conformance;
pub mod contract;
pub mod control;
pub mod dashboard;
pub mod dice;
pub mod doctor;
pub mod exec;
pub mod fault_point;
pub mod heartbeat;
pub mod keys;
pub mod lab;
pub mod manage;
pub mod metrics;
pub mod peers;
pub mod process;
pub mod run_log;
pub mod schema;
pub mod service_manager;
pub mod stage;
pub mod status;
pub mod supervisor;
pub mod swap;
pub mod swarm;
pub mod sweep_watch;
pub mod top;
pub mod trace;
mod trace_events;
pub mod up;
