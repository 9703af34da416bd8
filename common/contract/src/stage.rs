//! The stages of the dataflow.

/// A stage: one node of the dataflow.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum StageName {
    /// Camera, video file, stream or image folder to frames.
    Capture,
    /// The simulated world to frames, in place of capture.
    Simulator,
    /// An autopilot's inertial sensor to samples.
    Inertial,
    /// Frames and samples to the camera's own rotation.
    Egomotion,
    /// Frames and plans to views.
    Rectification,
    /// Views to detections.
    Detection,
    /// Detections to tracks and plans.
    Fusion,
    /// Tracks to the drone's autopilot, and its odometry back.
    Autopilot,
    /// Tracks to the swarm over Zenoh, and the peers' reports back.
    Gateway,
    /// Tracks and peers' sightings to ROS 2.
    Ros2,
}

impl StageName {
    /// Every stage, in the order of the dataflow.
    pub const ALL: [Self; 10] = [
        Self::Capture,
        Self::Simulator,
        Self::Inertial,
        Self::Egomotion,
        Self::Rectification,
        Self::Detection,
        Self::Fusion,
        Self::Autopilot,
        Self::Gateway,
        Self::Ros2,
    ];

    /// Its name in pipeline.yaml, in logs and in [`Health`](crate::Health).
    pub const fn name(self) -> &'static str {
        match self {
            Self::Capture => "capture",
            Self::Simulator => "simulator",
            Self::Inertial => "inertial",
            Self::Egomotion => "egomotion",
            Self::Rectification => "rectification",
            Self::Detection => "detection",
            Self::Fusion => "fusion",
            Self::Autopilot => "autopilot",
            Self::Gateway => "gateway",
            Self::Ros2 => "ros2",
        }
    }

    /// The stage of this name, if it is one of Flockeye's.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|stage| stage.name() == name)
    }

    /// Whether the stage publishes frames. One source runs in a pipeline.
    pub const fn is_source(self) -> bool {
        matches!(self, Self::Capture | Self::Simulator)
    }
}
