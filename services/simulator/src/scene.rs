//! The parts of a frame.

use crate::drawing::DroneDrawing;
use crate::moment::Attitude;

/// The parts of a frame that change from frame to frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FrameScene<'a> {
    /// Frame number, which seeds the noise.
    pub frame: u64,
    /// Attitude of the camera in the middle of the exposure.
    pub camera: Attitude,
    /// Drawings of the bodies, farthest first, each with the index of its eye.
    pub layers: &'a [(usize, &'a DroneDrawing)],
}
