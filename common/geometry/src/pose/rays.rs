//! What a pose is measured by: the rays of a body's corners.

use nalgebra::{Matrix3x2, Point3, Vector3};

use crate::Ray;
use crate::body::{Body, Marker};

/// The direction in which one corner of a marker was seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CornerRay {
    /// The marker's id.
    pub marker_id: u32,
    /// Which corner, 0 to 3, in ArUco's order.
    pub corner: usize,
    /// The direction, in the camera frame.
    pub ray_in_camera: Ray,
    /// Standard deviation across the ray, in each direction, radians.
    pub deviation_rad: f64,
}

impl CornerRay {
    /// Whether its numbers are numbers and it names a corner.
    fn is_usable(&self) -> bool {
        self.corner < 4
            && (self.ray_in_camera.norm_squared() - 1.0).abs() < 1e-6
            && self.deviation_rad > 0.0
            && self.deviation_rad < 1.0
    }
}

/// The rays with each corner once: where it was seen twice (two views overlap, and resample the same
/// pixels) the one of smallest deviation stays, of equal ones the first. Rays that are not usable
/// (not finite, not of unit length, without a positive deviation) are left out. Sorted by marker,
/// then corner.
pub fn keep_sharpest(rays: &[CornerRay]) -> Vec<CornerRay> {
    let mut kept: Vec<CornerRay> = rays.iter().filter(|ray| ray.is_usable()).copied().collect();
    kept.sort_by(|a, b| {
        (a.marker_id, a.corner)
            .cmp(&(b.marker_id, b.corner))
            .then(a.deviation_rad.total_cmp(&b.deviation_rad))
    });
    kept.dedup_by_key(|ray| (ray.marker_id, ray.corner));
    kept
}

/// One ray, ready to be compared with where a pose puts its corner.
#[derive(Debug, Clone)]
pub(super) struct Sight {
    /// The corner, in the markers' frame, metres.
    pub corner: Point3<f64>,
    pub ray: Vector3<f64>,
    /// Two unit vectors that span the plane tangent to the sphere at the ray.
    pub tangent: Matrix3x2<f64>,
    /// 1 / deviation, 1/radians.
    pub weight: f64,
    /// Largest error of a ray that fits, standard deviations.
    pub gate: f64,
    /// Apparent side of its marker, standard deviations; no less than the gate.
    pub side: f64,
}

/// The rays of one marker.
#[derive(Debug, Clone)]
pub(super) struct SightedMarker<'a> {
    pub marker: &'a Marker,
    pub centre: Point3<f64>,
    pub normal: Vector3<f64>,
    /// One to four, by rising corner.
    pub sights: Vec<Sight>,
}

/// The usable rays of the body's own markers, by rising id.
pub(super) fn sighted<'a>(
    body: &'a Body,
    rays: &[CornerRay],
    options: &super::PoseOptions,
) -> Vec<SightedMarker<'a>> {
    keep_sharpest(rays)
        .chunk_by(|a, b| a.marker_id == b.marker_id)
        .filter_map(|rays| {
            let marker = body.marker(rays[0].marker_id)?;
            // The widest angle between two of its corners is a diagonal, or at least a side.
            let side_rad = rays
                .iter()
                .flat_map(|a| rays.iter().map(|b| a.ray_in_camera.angle(&b.ray_in_camera)))
                .fold(0.0, f64::max)
                / 2f64.sqrt();
            let sight = |ray: &CornerRay| {
                let weight = 1.0 / ray.deviation_rad;
                let gate = (options.gate_side * side_rad * weight).max(options.gate_deviations);
                Sight {
                    corner: marker.corners[ray.corner],
                    ray: ray.ray_in_camera.into_inner(),
                    tangent: tangent(&ray.ray_in_camera),
                    weight,
                    gate,
                    side: (side_rad * weight).max(gate),
                }
            };
            Some(SightedMarker {
                marker,
                centre: marker.centre(),
                normal: marker.normal(),
                sights: rays.iter().map(sight).collect(),
            })
        })
        .collect()
}

/// Two unit vectors across the ray and each other.
fn tangent(ray: &Ray) -> Matrix3x2<f64> {
    // The axis farthest from the ray gives the best conditioned cross product.
    let axis = match ray.iamin() {
        0 => Vector3::x(),
        1 => Vector3::y(),
        _ => Vector3::z(),
    };
    let first = ray.cross(&axis).normalize();
    Matrix3x2::from_columns(&[first, ray.cross(&first)])
}
