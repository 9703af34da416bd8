//! How the stages' processes are run, as types.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How the stages' processes are run.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Stages {
    /// Camera, video file, stream or image folder to frames.
    pub capture: StageProcess,
    /// The simulated world, in place of capture.
    pub simulator: StageProcess,
    /// Frames and plans to views.
    pub rectification: StageProcess,
    /// Views to detections.
    pub detection: StageProcess,
    /// Detections to tracks and plans.
    pub fusion: StageProcess,
    /// Tracks to Zenoh.
    pub gateway: StageProcess,
}

/// How one stage's process is run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StageProcess {
    /// Program and arguments of another implementation; empty: the one that comes with Flockeye.
    pub command: Vec<String>,
    /// How many of them, for detection alone; left out: 2, so that a neighbour's view never waits
    /// behind a partition.
    #[schemars(range(min = 1, max = 16))]
    pub replicas: Option<u32>,
    /// Whether it is started again when it ends.
    pub restart: Restart,
    /// First and longest wait before it is started again, seconds; doubled each time in between.
    pub backoff_s: [f64; 2],
    /// Processors that it may run on, by number from 0; empty: all.
    pub cpus: Vec<u32>,
    /// How far it gives way to others, -20 (never) to 19; below 0 asks for a privilege. Left out: 5 for
    /// detection, since no tracked neighbour's pose waits for it, and 0 for all else.
    #[schemars(range(min = -20, max = 19))]
    pub nice: Option<i32>,
    /// The scheduling class; fifo and round_robin ask for a privilege.
    pub scheduling: Scheduling,
    /// Priority within fifo and round_robin: 1 to 99, the highest.
    #[schemars(range(min = 1, max = 99))]
    pub priority: u8,
}

/// A scheduling class of the kernel (sched(7)).
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Scheduling {
    /// Shares of the processors' time, by `nice`.
    #[default]
    Normal,
    /// The same for what computes much and need not react soon.
    Batch,
    /// Only when nobody else wants to run.
    Idle,
    /// Before all of the classes above, until it waits.
    Fifo,
    /// The same, in turn with others of its priority.
    RoundRobin,
}

impl Default for StageProcess {
    fn default() -> Self {
        Self {
            command: Vec::new(),
            replicas: None,
            restart: Restart::OnFailure,
            backoff_s: [0.1, 5.0],
            cpus: Vec::new(),
            nice: None,
            scheduling: Scheduling::Normal,
            priority: 1,
        }
    }
}

/// Whether a stage is started again when it ends.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Restart {
    /// Never: the pipeline stops with it.
    Never,
    /// When it failed.
    #[default]
    OnFailure,
    /// Always.
    Always,
}

impl Stages {
    /// Every stage with its name, in the order of the dataflow.
    pub fn iter(&self) -> impl Iterator<Item = (&'static str, &StageProcess)> {
        [
            ("capture", &self.capture),
            ("simulator", &self.simulator),
            ("rectification", &self.rectification),
            ("detection", &self.detection),
            ("fusion", &self.fusion),
            ("gateway", &self.gateway),
        ]
        .into_iter()
    }
}
