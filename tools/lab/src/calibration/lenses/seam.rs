//! What the two lenses see of a body that spans their seam.

use nalgebra::{Isometry3, Point3};

use crate::calibration::sight::Sight;

/// A marker as one lens sees it.
pub(super) struct LensSighting {
    pub lens: usize,
    pub corners: [Point3<f64>; 4],
    pub sights: [Sight; 4],
}

/// A frame in which a body spans the seam.
pub(super) struct SeamFrame {
    pub camera_from_markers: Isometry3<f64>,
    pub sightings: Vec<LensSighting>,
}
