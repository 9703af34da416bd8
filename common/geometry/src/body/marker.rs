//! One marker of a body.

use crate::Ray;
use nalgebra::{Isometry3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// Side of a marker's white facet where the file states none, in sides of the black square.
pub const FACET_PER_MARKER: f64 = 1.25;

/// Most markers of a body.
pub(super) const MAX_MARKERS: usize = 100;

/// One printed marker of a body.
#[derive(Debug, Clone, PartialEq)]
pub struct Marker {
    /// Its id in the dictionary.
    pub id: u32,
    /// Corners of the black square in the markers' frame, metres, in ArUco's order: clockwise from
    /// the printed pattern's top left, seen from outside.
    pub corners: [Point3<f64>; 4],
}

impl Marker {
    /// Middle of the black square.
    pub fn centre(&self) -> Point3<f64> {
        Point3::from(self.corners.iter().map(|corner| corner.coords).sum::<Vector3<f64>>() / 4.0)
    }

    /// Outward unit normal.
    pub fn normal(&self) -> Vector3<f64> {
        // Clockwise seen from outside: right cross up points outwards.
        let right = self.corners[1] - self.corners[0];
        let up = self.corners[0] - self.corners[3];
        right.cross(&up).normalize()
    }

    /// Mean length of a side, metres.
    pub fn side(&self) -> f64 {
        (0..4).map(|k| (self.corners[(k + 1) % 4] - self.corners[k]).norm()).sum::<f64>() / 4.0
    }

    /// Range of the marker with its corners on these rays, metres, from its longest side: a tilt
    /// shortens that side least.
    pub fn range_m(&self, rays: &[Ray; 4]) -> f64 {
        let longest = (0..4).map(|k| rays[k].angle(&rays[(k + 1) % 4])).fold(0.0, f64::max);
        self.side() / longest.max(1e-6)
    }

    /// Width of the white margin around the marker where the file states none, metres.
    pub fn usual_quiet_zone_m(&self) -> f64 {
        (FACET_PER_MARKER - 1.0) / 2.0 * self.side()
    }

    /// Whether all corners are finite.
    pub(super) fn is_finite(&self) -> bool {
        self.corners.iter().flat_map(|corner| corner.iter()).all(|x| x.is_finite())
    }

    /// `markers_from_marker`: origin at the centre, x to the printed right, y to its top, z out.
    pub fn markers_from_marker(&self) -> Isometry3<f64> {
        let right = (self.corners[1] - self.corners[0]).normalize();
        let normal = self.normal();
        let axes = Rotation3::from_basis_unchecked(&[right, normal.cross(&right), normal]);
        Isometry3::from_parts(
            Translation3::from(self.centre().coords),
            UnitQuaternion::from_rotation_matrix(&axes),
        )
    }
}
