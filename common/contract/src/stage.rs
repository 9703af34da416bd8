//! The stages of the dataflow.

/// A stage: one box of the dataflow.
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
    /// Tracks to Zenoh.
    Gateway,
}

impl StageName {
    /// Every stage, in the order of the dataflow.
    pub const ALL: [Self; 8] = [
        Self::Capture,
        Self::Simulator,
        Self::Inertial,
        Self::Egomotion,
        Self::Rectification,
        Self::Detection,
        Self::Fusion,
        Self::Gateway,
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
            Self::Gateway => "gateway",
        }
    }

    /// The stage of this name, if it is one of Flockeye's.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|stage| stage.name() == name)
    }

    /// Whether it publishes frames. One source runs in a pipeline.
    pub const fn is_source(self) -> bool {
        matches!(self, Self::Capture | Self::Simulator)
    }
}
