//! How the stages' processes are run, as types.

use flockeye_contract::StageName;
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
    /// An autopilot's inertial sensor to samples.
    pub inertial: StageProcess,
    /// Frames and samples to the camera's own rotation.
    pub egomotion: StageProcess,
    /// Frames and plans to views.
    pub rectification: StageProcess,
    /// Views to detections.
    pub detection: StageProcess,
    /// Detections to tracks and plans.
    pub fusion: StageProcess,
    /// Tracks to the drone's autopilot, and its odometry back.
    pub autopilot: StageProcess,
    /// Tracks to the swarm over Zenoh, and the peers' reports back.
    pub gateway: StageProcess,
    /// Tracks and peers' sightings to ROS 2.
    pub ros2: StageProcess,
}

/// How one stage's process is run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StageProcess {
    /// Program and arguments of another implementation; empty: the one that comes with Flockeye.
    pub command: Vec<String>,
    /// Number of processes, for detection only. Left out: 2, so that a neighbour's view never waits behind
    /// a partition.
    #[schemars(range(min = 1, max = 16))]
    pub replicas: Option<u32>,
    /// Whether it is started again when it ends.
    pub restart: Restart,
    /// First and longest wait before it is started again, seconds; doubled each time in between.
    pub backoff_s: [f64; 2],
    /// Processors that it may run on, by number from 0; empty: all.
    pub cpus: Vec<u32>,
    /// Nice value, -20 (first) to 19; below 0 needs a privilege. Left out: 5 for detection and
    /// egomotion, because no tracked neighbour's pose waits for them, and 0 for all other stages.
    #[schemars(range(min = -20, max = 19))]
    pub nice: Option<i32>,
    /// The scheduling class; fifo and round_robin need a privilege.
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
    /// The same, for long computations that need not react soon.
    Batch,
    /// Only when no other process wants to run.
    Idle,
    /// Before all classes above, until it blocks.
    Fifo,
    /// The same, in turn with others of its priority.
    RoundRobin,
}

impl Scheduling {
    /// Whether threads of this class go before all threads that are not in real time.
    pub fn is_real_time(self) -> bool {
        matches!(self, Self::Fifo | Self::RoundRobin)
    }
}

impl Default for StageProcess {
    fn default() -> Self {
        Self {
            command: Vec::new(),
            replicas: None,
            restart: Restart::OnFailure,
            backoff_s: [0.02, 1.0],
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
    /// Never: it is given up.
    Never,
    /// When it failed.
    #[default]
    OnFailure,
    /// Always.
    Always,
}

impl Stages {
    /// How one stage is run.
    pub fn of(&self, stage: StageName) -> &StageProcess {
        match stage {
            StageName::Capture => &self.capture,
            StageName::Simulator => &self.simulator,
            StageName::Inertial => &self.inertial,
            StageName::Egomotion => &self.egomotion,
            StageName::Rectification => &self.rectification,
            StageName::Detection => &self.detection,
            StageName::Fusion => &self.fusion,
            StageName::Autopilot => &self.autopilot,
            StageName::Gateway => &self.gateway,
            StageName::Ros2 => &self.ros2,
        }
    }

    /// Every stage, in the order of the dataflow.
    pub fn iter(&self) -> impl Iterator<Item = (StageName, &StageProcess)> {
        StageName::ALL.into_iter().map(|stage| (stage, self.of(stage)))
    }
}

/// Whether a stage may run in several processes. Every stage may be started again (`restart`).
pub const fn may_have_replicas(stage: StageName) -> bool {
    matches!(stage, StageName::Detection)
}

/// The nice value of a stage where pipeline.yaml has none. No tracked neighbour's pose waits for
/// egomotion or detection, so they give way.
pub const fn usual_nice(stage: StageName) -> i32 {
    match stage {
        StageName::Egomotion | StageName::Detection => 5,
        StageName::Capture
        | StageName::Simulator
        | StageName::Inertial
        | StageName::Rectification
        | StageName::Fusion
        | StageName::Autopilot
        | StageName::Gateway
        | StageName::Ros2 => 0,
    }
}
