//! The measurements of a pose: the rays of a body's corners.

use nalgebra::{Matrix3x2, Point3, Vector3};

use super::{GATE_DEVIATIONS, GATE_SIDE};
use crate::Ray;
use crate::body::{Body, Marker};

/// Direction of one corner of a marker in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CornerRay {
    /// The marker's id.
    pub marker_id: u32,
    /// Index of the corner, 0 to 3, in ArUco's order.
    pub corner: usize,
    /// The direction, in the camera frame.
    pub ray_in_camera: Ray,
    /// Standard deviation across the ray, in each direction, radians.
    pub deviation_rad: f64,
}

impl CornerRay {
    /// Whether all numbers are finite and the corner exists.
    fn is_usable(&self) -> bool {
        self.corner < 4
            && (self.ray_in_camera.norm_squared() - 1.0).abs() < 1e-6
            && self.deviation_rad > 0.0
            && self.deviation_rad < 1.0
    }
}

/// Largest distance between common corners of two sightings at one place, as a share of the
/// marker's apparent side.
const SAME_PLACE_SIDES: f64 = 0.5;

/// The rays of each marker at each place, with each corner once, by rising marker.
///
/// Overlapping views resample the same pixels, so a corner may be seen twice at one place. Then the
/// ray of smallest deviation stays, the first of equal ones. One marker at two places stays apart:
/// one is another print of it, or a reflection. Rays that are not usable (not finite, not of unit
/// length, without a positive deviation) are left out.
pub(super) fn sightings(rays: &[CornerRay]) -> Vec<Vec<CornerRay>> {
    let mut places: Vec<Vec<CornerRay>> = Vec::new();
    for sighting in in_order(rays) {
        match places.iter_mut().find(|place| is_same_place(place, &sighting)) {
            Some(place) => merge(place, &sighting),
            None => places.push(sighting),
        }
    }
    places.iter_mut().for_each(|place| place.sort_by_key(|ray| ray.corner));
    places.sort_by_key(|place| place[0].marker_id);
    places
}

/// The rays of each marker once, by rising marker. If a marker is seen at several places, the
/// sharpest counts.
pub fn keep_sharpest(rays: &[CornerRay]) -> Vec<CornerRay> {
    let deviation = |place: &Vec<CornerRay>| {
        place.iter().map(|ray| ray.deviation_rad).sum::<f64>() / place.len() as f64
    };
    let places = sightings(rays);
    places
        .chunk_by(|a, b| a[0].marker_id == b[0].marker_id)
        .filter_map(|places| places.iter().min_by(|a, b| deviation(a).total_cmp(&deviation(b))))
        .flatten()
        .copied()
        .collect()
}

/// The rays in their given order, split where another marker begins or a corner repeats. No part is
/// empty.
fn in_order(rays: &[CornerRay]) -> Vec<Vec<CornerRay>> {
    let mut sightings: Vec<Vec<CornerRay>> = Vec::new();
    for ray in rays.iter().filter(|ray| ray.is_usable()) {
        let goes_on = |sighting: &&mut Vec<CornerRay>| {
            let is_other = |other: &CornerRay| other.corner != ray.corner;
            sighting[0].marker_id == ray.marker_id && sighting.iter().all(is_other)
        };
        match sightings.last_mut().filter(goes_on) {
            Some(sighting) => sighting.push(*ray),
            None => sightings.push(vec![*ray]),
        }
    }
    sightings
}

fn is_same_place(place: &[CornerRay], sighting: &[CornerRay]) -> bool {
    let near_rad = SAME_PLACE_SIDES * apparent_side_rad(place).max(apparent_side_rad(sighting));
    place[0].marker_id == sighting[0].marker_id
        && sighting.iter().all(|ray| {
            let mut same = place.iter().filter(|other| other.corner == ray.corner);
            same.all(|other| other.ray_in_camera.angle(&ray.ray_in_camera) <= near_rad)
        })
}

fn merge(place: &mut Vec<CornerRay>, sighting: &[CornerRay]) {
    for ray in sighting {
        match place.iter_mut().find(|other| other.corner == ray.corner) {
            Some(other) if ray.deviation_rad < other.deviation_rad => *other = *ray,
            Some(_) => {}
            None => place.push(*ray),
        }
    }
}

/// The widest angle between two of a marker's corners is a diagonal, or at least a side.
fn apparent_side_rad(rays: &[CornerRay]) -> f64 {
    rays.iter()
        .flat_map(|a| rays.iter().map(|b| a.ray_in_camera.angle(&b.ray_in_camera)))
        .fold(0.0, f64::max)
        / 2f64.sqrt()
}

/// One ray, prepared for comparison with the corner at a pose.
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
    /// One to four rays, by rising corner.
    pub sights: Vec<Sight>,
}

/// The usable rays of the body's own markers, by rising id. A marker seen at two places is listed
/// twice.
pub(super) fn sighted<'a>(body: &'a Body, rays: &[CornerRay]) -> Vec<SightedMarker<'a>> {
    sightings(rays)
        .iter()
        .filter_map(|rays| {
            let marker = body.marker(rays[0].marker_id)?;
            let side_rad = apparent_side_rad(rays);
            let sight = |ray: &CornerRay| {
                let weight = 1.0 / ray.deviation_rad;
                let gate = (GATE_SIDE * side_rad * weight).max(GATE_DEVIATIONS);
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

/// Two unit vectors orthogonal to the ray and to each other.
pub(super) fn tangent(ray: &Ray) -> Matrix3x2<f64> {
    // The axis farthest from the ray gives the best conditioned cross product.
    let axis = match ray.iamin() {
        0 => Vector3::x(),
        1 => Vector3::y(),
        _ => Vector3::z(),
    };
    let first = ray.cross(&axis).normalize();
    Matrix3x2::from_columns(&[first, ray.cross(&first)])
}
