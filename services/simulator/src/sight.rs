//! What one eye sees of a body.

use crate::density::Density;
use crate::moment::Placement;

/// A body in the part of the image that one eye takes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Sight {
    /// Where the eye sees it.
    pub placement: Placement,
    /// How many pixels the image has there.
    pub density: Density,
}
