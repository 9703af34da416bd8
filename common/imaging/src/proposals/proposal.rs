//! Input and output of the search for proposals.

use flockeye_geometry::Ray;

/// Sizes of the markers to search for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MarkerSizes {
    /// Apparent side of the smallest marker at the farthest distance, radians.
    pub least_rad: f64,
    /// Apparent side of the largest marker at the nearest distance, radians.
    pub most_rad: f64,
    /// Radius of a body, as a multiple of its markers' side.
    pub radius_in_sides: f64,
}

/// A place that looks like a body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Proposal {
    /// Direction of the place, in the camera frame.
    pub direction_in_camera: Ray,
    /// Apparent side of its markers, radians.
    pub side_rad: f64,
    /// Similarity to a body: a logarithm, higher is better.
    pub score: f64,
}
