//! What a detection worker found in one view.

use flockeye_contract::{DetectedMarker, DetectionHeader};

/// What a detection worker found in one view.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// Which view, of which frame, by whom.
    pub header: DetectionHeader,
    /// The markers.
    pub markers: Vec<DetectedMarker>,
}
