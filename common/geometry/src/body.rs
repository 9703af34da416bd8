//! Marker bodies: the place of each marker on a neighbour, and the solid that carries the markers.
//!
//! A [`Body`] is its [`Marker`]s and its [`Facet`]s: the flat sides of the solid to which the
//! markers are glued. The functions around [`squares`] make the solids that come with Flockeye.
//! [`Bodies::from_json`] reads others.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Isometry3, Point3};

mod facets;
mod file;
mod marker;
mod presets;
pub mod solid;

pub use facets::Facet;
use marker::MAX_MARKERS;
pub use marker::{FACET_PER_MARKER, Marker};
pub use presets::{TruncatedSizes, cube, plate, squares, truncated};

/// A rigid set of markers that a neighbour carries.
#[derive(Debug, Clone, PartialEq)]
pub struct Body {
    /// Its name; the neighbour's name on the network.
    pub name: String,
    /// Its markers, by rising id. Other markers are another body: see [`Body::with_markers`].
    pub markers: Vec<Marker>,
    /// Pose of the marker body on its drone.
    pub target_from_markers: Isometry3<f64>,
    facets: Vec<Facet>,
}

impl Body {
    /// A body of these markers, each on a white square [`FACET_PER_MARKER`] times as large. The
    /// other flat sides of the convex hull are the blank facets. There are none if the markers lie
    /// in one plane, or not all on the hull.
    pub fn new(name: impl Into<String>, mut markers: Vec<Marker>) -> Self {
        markers.sort_by_key(|marker| marker.id);
        let quiet_zones_m: Vec<f64> = markers.iter().map(Marker::usual_quiet_zone_m).collect();
        let facets = facets::round(&markers, &quiet_zones_m);
        Self::of_parts(name, markers, facets)
    }

    /// Creates a body from `markers` by rising id. Facets refer to markers by their index in this
    /// order.
    fn of_parts(name: impl Into<String>, markers: Vec<Marker>, facets: Vec<Facet>) -> Self {
        let target_from_markers = Isometry3::identity();
        Self { name: name.into(), markers, target_from_markers, facets }
    }

    /// Returns this solid with its markers where they were glued, not where they were meant to be.
    /// Facets stay in place. `None` unless the ids are equal and in the same order.
    pub fn with_markers(&self, markers: Vec<Marker>) -> Option<Self> {
        let ids = |markers: &[Marker]| markers.iter().map(|marker| marker.id).collect::<Vec<_>>();
        (ids(&markers) == ids(&self.markers)).then(|| Self { markers, ..self.clone() })
    }

    /// The solid's flat sides: first those with a marker, by rising id, then the blank ones.
    pub fn facets(&self) -> &[Facet] {
        &self.facets
    }

    /// The marker with this id, if the body has it.
    pub fn marker(&self, id: u32) -> Option<&Marker> {
        self.markers.binary_search_by_key(&id, |marker| marker.id).ok().map(|k| &self.markers[k])
    }

    /// Radius of the smallest sphere around the markers' origin that contains every corner, metres.
    pub fn radius(&self) -> f64 {
        self.corners().map(|corner| corner.coords.norm()).fold(0.0, f64::max)
    }

    /// Side of its largest marker, metres.
    pub fn largest_side(&self) -> f64 {
        self.markers.iter().map(Marker::side).fold(0.0, f64::max)
    }

    /// Every corner of every marker.
    pub fn corners(&self) -> impl Iterator<Item = &Point3<f64>> {
        self.markers.iter().flat_map(|marker| &marker.corners)
    }
}

/// All bodies of a swarm. No two bodies share a marker id.
#[derive(Debug, Clone, PartialEq)]
pub struct Bodies {
    /// Name of the dictionary of all markers, as in OpenCV: `DICT_5X5_250`.
    pub dictionary: String,
    bodies: Vec<Body>,
    owners: BTreeMap<u32, usize>,
}

/// Reason why a set of bodies was refused, with all of its errors.
#[derive(Debug, thiserror::Error)]
pub enum BodiesError {
    /// The file is not JSON of this form.
    #[error("not a bodies file: {0}")]
    Json(#[from] serde_json::Error),
    /// The bodies contradict themselves or each other.
    #[error("{}", .0.join("; "))]
    Contradictions(Vec<String>),
}

impl Bodies {
    /// Checks that bodies can be distinguished and that each allows a pose solution.
    ///
    /// # Errors
    /// Every contradiction found: an id shared by two bodies or repeated in one, bodies without
    /// markers, markers that are no squares, corners listed counter-clockwise.
    pub fn new(dictionary: String, bodies: Vec<Body>) -> Result<Self, BodiesError> {
        let mut problems = Vec::new();
        let mut owners: BTreeMap<u32, usize> = BTreeMap::new();
        let mut names = BTreeSet::new();
        if bodies.is_empty() {
            problems.push("there is no body; at least one is needed".to_owned());
        }
        for (index, body) in bodies.iter().enumerate() {
            let name = &body.name;
            if !names.insert(name) {
                problems.push(format!("two bodies are called '{name}'; names must differ"));
            }
            if body.markers.is_empty() {
                problems.push(format!("body '{name}' has no marker; at least one is needed"));
            }
            if body.markers.len() > MAX_MARKERS {
                problems.push(format!(
                    "body '{name}' has {} markers; at most {MAX_MARKERS} are allowed",
                    body.markers.len()
                ));
                continue;
            }
            for marker in &body.markers {
                if let Some(owner) = owners.insert(marker.id, index) {
                    let owner = &bodies[owner].name;
                    problems.push(format!(
                        "marker id {} belongs to '{owner}' and to '{name}'; each id may be used once",
                        marker.id
                    ));
                }
                problems.extend(
                    square_problem(marker)
                        .map(|why| format!("marker {} of body '{name}' {why}", marker.id)),
                );
            }
        }
        if problems.is_empty() {
            Ok(Self { dictionary, bodies, owners })
        } else {
            Err(BodiesError::Contradictions(problems))
        }
    }

    /// The bodies, in the order of their index.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = &Body> {
        self.bodies.iter()
    }

    /// Number of bodies: at least one.
    #[expect(clippy::len_without_is_empty, reason = "there is always one")]
    pub fn len(&self) -> usize {
        self.bodies.len()
    }

    /// Side of the largest marker of all, metres.
    pub fn largest_side(&self) -> f64 {
        self.bodies.iter().map(Body::largest_side).fold(0.0, f64::max)
    }

    /// The largest radius of a body, in sides of its largest marker; 0 without markers.
    pub fn radius_in_sides(&self) -> f64 {
        let with_markers = self.bodies.iter().filter(|body| !body.markers.is_empty());
        with_markers.map(|body| body.radius() / body.largest_side()).fold(0.0, f64::max)
    }

    /// The body with this index.
    pub fn get(&self, index: usize) -> Option<&Body> {
        self.bodies.get(index)
    }

    /// Index of the body that carries marker `id`; `None` if no body carries it.
    pub fn owner(&self, id: u32) -> Option<usize> {
        self.owners.get(&id).copied()
    }
}

/// Reason why four corners are no printed square, if there is one.
fn square_problem(marker: &Marker) -> Option<String> {
    if !marker.is_finite() {
        return Some("has a corner that is not a number".into());
    }
    let sides: Vec<f64> =
        (0..4).map(|k| (marker.corners[(k + 1) % 4] - marker.corners[k]).norm()).collect();
    let side = marker.side();
    if !(1e-3..=10.0).contains(&side) {
        return Some(format!("has sides of {side} m (1 mm to 10 m are allowed)"));
    }
    let diagonals = [
        (marker.corners[2] - marker.corners[0]).norm(),
        (marker.corners[3] - marker.corners[1]).norm(),
    ];
    let is_square = sides.iter().all(|length| (length / side - 1.0).abs() < 0.02)
        && diagonals.iter().all(|length| (length / side - 2f64.sqrt()).abs() < 0.03);
    if !is_square {
        return Some(format!(
            "is no square: its sides are {sides:.4?} m, its diagonals {diagonals:.4?} m"
        ));
    }
    // Diagonals of a flat square meet.
    let diagonal = |k: usize| marker.corners[k + 2] - marker.corners[k];
    let across = marker.corners[1] - marker.corners[0];
    let gap = diagonal(0).cross(&diagonal(1)).normalize().dot(&across).abs();
    if gap > 0.02 * side {
        return Some(format!("is not flat: its diagonals pass at {:.1} mm", gap * 1e3));
    }
    if marker.normal().dot(&marker.centre().coords) < -1e-6 {
        return Some("looks inwards: its corners must go clockwise seen from outside".into());
    }
    None
}

#[cfg(test)]
mod tests;
