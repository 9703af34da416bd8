//! What a frame is made from.

use crate::drawing::DroneDrawing;
use crate::moment::Attitude;

/// Everything that a frame is made from.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FrameScene<'a> {
    /// Chooses the noise.
    pub frame: u64,
    /// The camera's, in the middle of the exposure.
    pub camera: Attitude,
    /// The bodies' drawings, farthest first, each with the index of the eye that sees it.
    pub layers: &'a [(usize, &'a DroneDrawing)],
}
