//! Marker bodies: which marker sits where on a neighbour.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Isometry3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};
use serde::Deserialize;

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

/// A rigid set of markers that a neighbour carries.
#[derive(Debug, Clone, PartialEq)]
pub struct Body {
    /// Its name; the neighbour's name on the network.
    pub name: String,
    /// Its markers, by rising id.
    pub markers: Vec<Marker>,
    /// Where the marker body sits on its drone.
    pub target_from_markers: Isometry3<f64>,
}

impl Body {
    /// The marker with this id, if the body has it.
    pub fn marker(&self, id: u32) -> Option<&Marker> {
        self.markers.binary_search_by_key(&id, |marker| marker.id).ok().map(|k| &self.markers[k])
    }

    /// Radius of the smallest sphere round the markers' origin that holds every corner, metres.
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

/// All bodies of a swarm: ids are shared by nobody.
#[derive(Debug, Clone, PartialEq)]
pub struct Bodies {
    /// Name of the dictionary that all markers are from, as OpenCV has it: `DICT_5X5_250`.
    pub dictionary: String,
    bodies: Vec<Body>,
    owners: BTreeMap<u32, usize>,
}

/// Why a set of bodies was refused. Everything wrong with it is named at once.
#[derive(Debug, thiserror::Error)]
pub enum BodiesError {
    /// The file is not JSON of this form.
    #[error("not a bodies file: {0}")]
    Json(#[from] serde_json::Error),
    /// The bodies contradict themselves or each other.
    #[error("{}", .0.join("; "))]
    Contradictions(Vec<String>),
}

#[derive(Deserialize)]
struct BodiesFile {
    dictionary: String,
    bodies: BTreeMap<String, BodyFile>,
}

#[derive(Deserialize)]
struct BodyFile {
    markers: Vec<MarkerFile>,
    #[serde(default)]
    target_from_markers: Option<MountFile>,
}

#[derive(Deserialize)]
struct MarkerFile {
    id: u32,
    corners: [[f64; 3]; 4],
}

#[derive(Deserialize)]
struct MountFile {
    position: [f64; 3],
    /// x y z w
    orientation: [f64; 4],
}

impl Bodies {
    /// Checks that the bodies can be told apart and solved for.
    ///
    /// # Errors
    /// Every contradiction found: ids shared by two bodies, or used twice in one, bodies without
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

    /// Reads the JSON form: `{"dictionary", "bodies": {name: {"markers": [{"id", "corners"}]}}}`.
    /// Bodies come in the order of their names; their index is their `target` number.
    ///
    /// # Errors
    /// Malformed JSON with its line and column, or every contradiction ([`Bodies::new`]).
    pub fn from_json(json: &str) -> Result<Self, BodiesError> {
        let file: BodiesFile = serde_json::from_str(json)?;
        let bodies = file.bodies.into_iter().map(|(name, body)| {
            let mut markers: Vec<_> = body.markers.into_iter().map(marker_from_file).collect();
            markers.sort_by_key(|marker| marker.id);
            let target_from_markers =
                body.target_from_markers.map_or_else(Isometry3::identity, |mount| {
                    let [x, y, z, w] = mount.orientation;
                    Isometry3::from_parts(
                        Translation3::from(Vector3::from(mount.position)),
                        UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, x, y, z)),
                    )
                });
            Body { name, markers, target_from_markers }
        });
        Self::new(file.dictionary, bodies.collect())
    }

    /// The bodies, in the order of their index.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = &Body> {
        self.bodies.iter()
    }

    /// How many there are: at least one.
    #[expect(clippy::len_without_is_empty, reason = "there is always one")]
    pub fn len(&self) -> usize {
        self.bodies.len()
    }

    /// Side of the largest marker of all, metres.
    pub fn largest_side(&self) -> f64 {
        self.bodies.iter().map(Body::largest_side).fold(0.0, f64::max)
    }

    /// The body with this index.
    pub fn get(&self, index: usize) -> Option<&Body> {
        self.bodies.get(index)
    }

    /// Index of the body that carries marker `id`; `None` for an id nobody owns.
    pub fn owner(&self, id: u32) -> Option<usize> {
        self.owners.get(&id).copied()
    }
}

fn marker_from_file(marker: MarkerFile) -> Marker {
    Marker { id: marker.id, corners: marker.corners.map(Point3::from) }
}

/// What keeps four corners from being a printed square, if anything does.
fn square_problem(marker: &Marker) -> Option<String> {
    let finite = marker.corners.iter().all(|corner| corner.coords.iter().all(|x| x.is_finite()));
    if !finite {
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
    if marker.normal().dot(&marker.centre().coords) < -1e-6 {
        return Some("looks inwards: its corners must go clockwise seen from outside".into());
    }
    None
}

/// The rhombicuboctahedron with a marker on each square facet but the bottom one (preset
/// `squares`): 17 ids from `first_id`: the top; the upper ring at azimuth 0, 90, 180, 270; the belt
/// at 0, 45 .. 315; the lower ring. The printed up points to +z; on the top marker, to +x.
///
/// `edge` and `marker_side` in metres; the square facets lie (1 + sqrt 2)/2 edges from the centre.
pub fn squares(name: &str, edge: f64, marker_side: f64, first_id: u32) -> Body {
    let distance = (1.0 + 2f64.sqrt()) / 2.0 * edge;
    let ring = |elevation: f64, count: u32| {
        (0..count)
            .map(move |k| (f64::from(k) * std::f64::consts::TAU / f64::from(count), elevation))
    };
    let quarter = std::f64::consts::FRAC_PI_4;
    let facets = std::iter::once((0.0, 2.0 * quarter))
        .chain(ring(quarter, 4))
        .chain(ring(0.0, 8))
        .chain(ring(-quarter, 4));
    let markers = facets.zip(first_id..).map(|((azimuth, elevation), id)| {
        let (sin_az, cos_az) = azimuth.sin_cos();
        let (sin_el, cos_el) = elevation.sin_cos();
        let normal = Vector3::new(cos_el * cos_az, cos_el * sin_az, sin_el);
        // The top marker's up is +x; it tilts towards +z as the facet comes down.
        let up = if elevation > 1.5 {
            Vector3::x()
        } else {
            Vector3::new(-sin_el * cos_az, -sin_el * sin_az, cos_el)
        };
        let right = up.cross(&normal);
        let half = marker_side / 2.0;
        let at =
            |x: f64, y: f64| Point3::from(normal * distance + right * (x * half) + up * (y * half));
        Marker { id, corners: [at(-1.0, 1.0), at(1.0, 1.0), at(1.0, -1.0), at(-1.0, -1.0)] }
    });
    Body {
        name: name.to_owned(),
        markers: markers.collect(),
        target_from_markers: Isometry3::identity(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bodies(list: Vec<Body>) -> Result<Bodies, BodiesError> {
        Bodies::new("DICT_5X5_250".into(), list)
    }

    #[test]
    fn the_preset_is_the_published_solid() {
        let body = squares("alpha", 0.0625, 0.05, 0);
        assert_eq!(body.markers.len(), 17);
        // Corner values of an independently made body of the same size (its first two markers).
        let top = &body.markers[0].corners[0];
        assert!((top - Point3::new(0.025, 0.025, 0.075_444_174)).norm() < 1e-8);
        let ring = &body.markers[1].corners[2];
        assert!((ring - Point3::new(0.071_024_756, 0.025, 0.035_669_417)).norm() < 1e-8);
        for marker in &body.markers {
            assert!(marker.normal().dot(&marker.centre().coords.normalize()) > 0.999_999);
            assert!((marker.side() - 0.05).abs() < 1e-12);
        }
    }

    #[test]
    fn shared_ids_are_all_named() {
        let error = bodies(vec![squares("a", 0.06, 0.05, 0), squares("b", 0.06, 0.05, 15)])
            .expect_err("ids 15 and 16 are shared")
            .to_string();
        assert!(error.contains("id 15 belongs to 'a' and to 'b'"), "{error}");
        assert!(error.contains("id 16 belongs"), "{error}");
    }

    #[test]
    fn inward_and_crooked_markers_are_refused() {
        let mut body = squares("a", 0.06, 0.05, 0);
        body.markers[3].corners.reverse();
        body.markers[4].corners[0].x += 0.02;
        let error = bodies(vec![body]).expect_err("two markers are wrong").to_string();
        assert!(error.contains("marker 3 of body 'a' looks inwards"), "{error}");
        assert!(error.contains("marker 4 of body 'a' is no square"), "{error}");
    }

    #[test]
    fn owners_are_found_and_strangers_not() {
        let bodies =
            bodies(vec![squares("a", 0.06, 0.05, 0), squares("b", 0.06, 0.05, 17)]).expect("fine");
        assert_eq!(
            (bodies.owner(16), bodies.owner(17), bodies.owner(34)),
            (Some(0), Some(1), None)
        );
    }
}
