//! Bodies in a file.

use std::collections::BTreeMap;

use nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion, Vector3};
use serde::Deserialize;
use serde_json::{Map, Value, json};

use super::{Bodies, BodiesError, Body, Marker, facets};

#[derive(Deserialize)]
struct BodiesFile {
    dictionary: String,
    bodies: BTreeMap<String, BodyFile>,
}

#[derive(Deserialize)]
struct BodyFile {
    markers: Vec<MarkerFile>,
    #[serde(default)]
    quiet_zone_m: Option<f64>,
    #[serde(default)]
    facets: Option<Vec<Vec<[f64; 3]>>>,
    #[serde(default)]
    target_from_markers: Option<MountFile>,
}

#[derive(Deserialize)]
struct MarkerFile {
    id: u32,
    corners: [[f64; 3]; 4],
    #[serde(default)]
    quiet_zone_m: Option<f64>,
}

#[derive(Deserialize)]
struct MountFile {
    position: [f64; 3],
    /// x y z w
    orientation: [f64; 4],
}

impl Bodies {
    /// Reads the JSON form: `{"dictionary", "bodies": {name: {"markers": [{"id", "corners"}]}}}`.
    /// Bodies come in the order of their names; their index is their `target` number.
    ///
    /// A marker's white square is [`super::FACET_PER_MARKER`] times as large as its black one, or
    /// `"quiet_zone_m"` wider on each side (of the marker, or of the whole body). A body's
    /// `"facets": [[[x, y, z], ..], ..]`, counter-clockwise seen from outside, replace both. Other
    /// keys are ignored.
    ///
    /// # Errors
    /// Malformed JSON with its line and column, or every contradiction ([`Bodies::new`]).
    pub fn from_json(json: &str) -> Result<Self, BodiesError> {
        let file: BodiesFile = serde_json::from_str(json)?;
        let mut problems = Vec::new();
        let bodies: Vec<Body> =
            file.bodies.into_iter().map(|(name, body)| body.read(name, &mut problems)).collect();
        // An error of a marker is also an error of its facet, so markers come first.
        let bodies = Self::new(file.dictionary, bodies)?;
        if problems.is_empty() { Ok(bodies) } else { Err(BodiesError::Contradictions(problems)) }
    }

    /// The JSON form that [`Bodies::from_json`] reads, with every body's facets.
    pub fn to_json(&self) -> Value {
        let point = |p: &Point3<f64>| json!([p.x, p.y, p.z]);
        let bodies = self.iter().map(|body| {
            let markers = body.markers.iter().map(|marker| {
                let corners: Vec<Value> = marker.corners.iter().map(point).collect();
                json!({ "id": marker.id, "corners": corners })
            });
            let facets = body.facets().iter();
            let facets = facets.map(|facet| facet.outline.iter().map(point).collect());
            let mount = &body.target_from_markers;
            let value = json!({
                "markers": markers.collect::<Vec<Value>>(),
                "facets": facets.collect::<Vec<Vec<Value>>>(),
                "target_from_markers": {
                    "position": mount.translation.vector.as_slice(),
                    "orientation": mount.rotation.coords.as_slice(),
                },
            });
            (body.name.clone(), value)
        });
        json!({ "dictionary": self.dictionary, "bodies": bodies.collect::<Map<String, Value>>() })
    }
}

impl BodyFile {
    /// Creates the body, and adds the errors of its facets to `problems`.
    fn read(self, name: String, problems: &mut Vec<String>) -> Body {
        let mut listed = self.markers;
        listed.sort_by_key(|marker| marker.id);
        let markers: Vec<Marker> = listed
            .iter()
            .map(|marker| Marker { id: marker.id, corners: marker.corners.map(Point3::from) })
            .collect();
        let facets = match self.facets {
            Some(outlines) => {
                let outlines = outlines
                    .into_iter()
                    .map(|corners| corners.into_iter().map(Point3::from).collect());
                facets::given(&name, &markers, outlines.collect(), problems)
            }
            None => {
                let said = listed.iter().map(|marker| marker.quiet_zone_m.or(self.quiet_zone_m));
                let wrong = said.clone().flatten().find(|width| !(0.0..=10.0).contains(width));
                if let Some(width) = wrong {
                    problems.push(format!(
                        "quiet_zone_m of body '{name}' is {width}; it must be 0 to 10 m"
                    ));
                }
                let widths_m: Vec<f64> = said
                    .zip(&markers)
                    .map(|(said, marker)| said.unwrap_or_else(|| marker.usual_quiet_zone_m()))
                    .collect();
                facets::round(&markers, &widths_m)
            }
        };
        let mut body = Body::of_parts(name, markers, facets);
        if let Some(mount) = self.target_from_markers {
            body.target_from_markers = mount.isometry(&body.name, problems);
        }
        body
    }
}

impl MountFile {
    fn isometry(&self, body: &str, problems: &mut Vec<String>) -> Isometry3<f64> {
        let [x, y, z, w] = self.orientation;
        let rotation = Quaternion::new(w, x, y, z);
        let norm = rotation.norm();
        if (norm - 1.0).abs() > 1e-3 {
            problems.push(format!(
                "target_from_markers of body '{body}': a rotation's quaternion x, y, z, w has \
                 length 1, not {norm:.4}"
            ));
        }
        Isometry3::from_parts(
            Translation3::from(Vector3::from(self.position)),
            UnitQuaternion::from_quaternion(rotation),
        )
    }
}
