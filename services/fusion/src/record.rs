//! Detections of a worker in one view.

use flockeye_contract::{DetectedMarker, DetectionHeader};

/// Detections of a worker in one view.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// View, frame and worker.
    pub header: DetectionHeader,
    /// The markers.
    pub markers: Vec<DetectedMarker>,
}
