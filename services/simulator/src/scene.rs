//! What a frame is made from.

use crate::drawing::Drawing;
use crate::moment::Attitude;

/// A drawing over the others, from the eye of this index.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Layer<'a> {
    /// Which eye sees it.
    pub eye: usize,
    /// What is seen.
    pub drawing: &'a Drawing,
}

/// Everything that a frame is made from.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Scene<'a> {
    /// Chooses the noise.
    pub frame: u64,
    /// The camera's, in the middle of the exposure.
    pub camera: Attitude,
    /// The bodies, farthest first.
    pub layers: &'a [Layer<'a>],
}
