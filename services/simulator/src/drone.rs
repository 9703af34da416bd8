//! Shapes of the flying bodies: a printed marker body on top of its drone.

use flockeye_dictionary::Dictionary;
use flockeye_geometry::body::solid::{FLATNESS_M, Face, Solid};
use flockeye_geometry::body::{Body, Facet, Marker};
use nalgebra::{Point3, Vector3};

use crate::WorldError;

/// Reflectance of white print, of blank facets, of black ink, and of the airframe.
const WHITE: f64 = 0.85;
const BLANK: f64 = 0.66;
const BLACK: f64 = 0.035;
const CARBON: f64 = 0.05;
/// Share of the light that a spinning propeller blocks.
const PROPELLER_OPACITY: f32 = 0.16;
/// Thickness of a flat body behind its markers, metres.
const PLATE_M: f64 = 0.003;

/// A flat side of a body and its print.
#[derive(Debug, Clone)]
pub(crate) struct PaintedFace {
    /// The flat side.
    pub face: Face,
    pub reflectance: f64,
    /// Printed polygons in the markers' frame, metres. Each has a change: added to the reflectance
    /// below.
    pub print: Vec<(Vec<Point3<f64>>, f64)>,
}

#[derive(Debug, Clone)]
pub(crate) struct DronePart {
    pub solid: Solid,
    pub faces: Vec<PaintedFace>,
    /// Share of the light from behind that it blocks: 1 for all parts except propellers.
    pub opacity: f32,
}

/// A marker body on its drone, in the markers' frame.
#[derive(Debug, Clone)]
pub(crate) struct DroneShape {
    /// The neighbour's name.
    pub name: String,
    pub markers: Vec<Marker>,
    /// The marker body first, then the airframe.
    pub parts: Vec<DronePart>,
    /// Radius of the bounding sphere round the origin, metres.
    pub radius: f64,
}

impl PaintedFace {
    fn bare(face: &Face, reflectance: f64) -> Self {
        Self { face: face.clone(), reflectance, print: Vec::new() }
    }
}

impl DroneShape {
    /// Builds the drone of `body`: the convex hull of its facets, and an optional airframe of
    /// proportional size below it.
    ///
    /// # Errors
    /// A marker that the dictionary does not have; a body that is not convex.
    pub(crate) fn new(
        body: &Body,
        dictionary: &Dictionary,
        airframe: bool,
    ) -> Result<Self, WorldError> {
        let solid = body_solid(body)?;
        let mut faces: Vec<PaintedFace> =
            solid.faces.iter().map(|face| PaintedFace::bare(face, BLANK)).collect();
        for facet in body.facets() {
            let Some(marker) = facet.marker.map(|k| &body.markers[k]) else { continue };
            let towards = |painted: &PaintedFace| painted.face.normal.dot(&facet.normal);
            let carrier = faces
                .iter_mut()
                .max_by(|a, b| towards(a).total_cmp(&towards(b)))
                .ok_or_else(|| not_convex(body, facet))?;
            print_marker(carrier, facet, marker, body, dictionary)?;
        }
        let mut parts = vec![DronePart { solid, faces, opacity: 1.0 }];
        if airframe {
            let low = parts[0].solid.corners.iter().map(|p| p.z).fold(f64::INFINITY, f64::min);
            parts.extend(airframe_parts(low, body.radius()));
        }
        let radius = parts
            .iter()
            .flat_map(|part| &part.solid.corners)
            .map(|corner| corner.coords.norm())
            .fold(0.0, f64::max);
        Ok(Self { name: body.name.clone(), markers: body.markers.clone(), parts, radius })
    }

    /// Whether an opaque part of this drone hides `point` from `eye`, both in the markers' frame.
    pub(crate) fn hides(&self, eye: &Point3<f64>, point: &Point3<f64>) -> bool {
        self.parts.iter().any(|part| part.opacity >= 1.0 && part.solid.hides(eye, point))
    }

    /// The parts in the order of distance from `eye`, in the markers' frame, farthest first.
    pub(crate) fn back_to_front(&self, eye: &Point3<f64>) -> Vec<&DronePart> {
        let mut left: Vec<&DronePart> = self.parts.iter().collect();
        let mut order = Vec::with_capacity(left.len());
        while !left.is_empty() {
            let hides_another = |part: &DronePart| {
                left.iter().any(|other| {
                    !std::ptr::eq(*other, part) && part.solid.is_before(&other.solid, eye)
                })
            };
            // In a ring of parts, any part may be first. Simple boxes never form a ring.
            let next = left.iter().position(|part| !hides_another(part)).unwrap_or(0);
            order.push(left.swap_remove(next));
        }
        order
    }
}

fn not_convex(body: &Body, facet: &Facet) -> WorldError {
    let marker = facet.marker.map(|k| body.markers[k].id);
    WorldError::NotConvex { body: body.name.clone(), marker }
}

/// The convex hull of the body's facets. Each of them must lie on its surface.
fn body_solid(body: &Body) -> Result<Solid, WorldError> {
    let normals: Vec<Vector3<f64>> = body.facets().iter().map(|facet| facet.normal).collect();
    let points: Vec<_> = body.facets().iter().flat_map(|facet| &facet.outline).copied().collect();
    let mut solid = Solid::hull(points.clone(), &normals);
    if solid.is_flat() {
        let behind = points.iter().map(|point| point - normals[0] * PLATE_M);
        solid = Solid::hull(points.iter().copied().chain(behind).collect(), &normals);
    }
    let sunken = body.facets().iter().find(|facet| {
        let height = |p: &Point3<f64>| facet.normal.dot(&(p - facet.outline[0]));
        // Factor 5: a facet is wider than the square from which its plane was computed.
        solid.corners.iter().any(|p| height(p) > 5.0 * FLATNESS_M)
    });
    sunken.map_or(Ok(solid), |facet| Err(not_convex(body, facet)))
}

/// Prints a marker and its white facet on the face that carries it.
fn print_marker(
    carrier: &mut PaintedFace,
    facet: &Facet,
    marker: &Marker,
    body: &Body,
    dictionary: &Dictionary,
) -> Result<(), WorldError> {
    let pattern = dictionary.print(marker.id).ok_or_else(|| WorldError::UnknownMarker {
        body: body.name.clone(),
        id: marker.id,
        dictionary: dictionary.name().to_owned(),
        last: dictionary.marker_count().saturating_sub(1),
    })?;
    let cells = pattern.cells();
    let mut print = |corners: Vec<Point3<f64>>, change| carrier.print.push((corners, change));
    print(facet.outline.clone(), WHITE - BLANK);
    print(marker.corners.to_vec(), BLACK - WHITE);
    let [origin, right_end, _, down_end] = marker.corners;
    let cell = 1.0 / cells as f64;
    let (right, down) = ((right_end - origin) * cell, (down_end - origin) * cell);
    let at = |row: usize, column: usize| origin + right * column as f64 + down * row as f64;
    let is_white = |row: usize, column: usize| pattern.is_white(row as isize, column as isize);
    for row in 0..cells {
        // Adjacent white cells are drawn as one rectangle.
        let mut start = 0;
        while start < cells {
            let end = (start..cells).find(|&column| !is_white(row, column)).unwrap_or(cells);
            if end > start {
                let corners =
                    vec![at(row, start), at(row, end), at(row + 1, end), at(row + 1, start)];
                print(corners, WHITE - BLACK);
            }
            start = end + 1;
        }
    }
    Ok(())
}

/// A quadcopter below a body whose lowest point is at height `low`; sizes follow the body's
/// `radius`. All parts are axis-aligned boxes that do not overlap, so a plane separates any two.
fn airframe_parts(low: f64, radius: f64) -> Vec<DronePart> {
    // The sizes below belong to a body of 87 mm radius.
    let scale = radius / 0.087;
    let box_at = |x: [f64; 2], y: [f64; 2], z: [f64; 2], opacity: f32| {
        let corner = |k: usize| [x[k] * scale, y[k] * scale, low + z[k] * scale];
        let solid = Solid::cuboid(corner(0), corner(1));
        let faces = solid.faces.iter().map(|face| PaintedFace::bare(face, CARBON)).collect();
        DronePart { solid, faces, opacity }
    };
    let mut parts = vec![
        box_at([-0.012, 0.012], [-0.012, 0.012], [-0.040, -0.0005], 1.0),
        box_at([-0.110, 0.110], [-0.035, 0.035], [-0.085, -0.040], 1.0),
        box_at([0.060, 0.100], [-0.020, 0.020], [-0.110, -0.085], 1.0),
    ];
    for (front, left) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
        let span = |sign: f64, a: f64, b: f64| if sign > 0.0 { [a, b] } else { [-b, -a] };
        let arm = span(front, 0.070, 0.086);
        parts.extend([
            box_at(arm, span(left, 0.035, 0.130), [-0.068, -0.054], 1.0),
            box_at(span(front, 0.066, 0.090), span(left, 0.130, 0.154), [-0.074, -0.036], 1.0),
            box_at(span(front, 0.074, 0.082), span(left, 0.138, 0.146), [-0.120, -0.074], 1.0),
            propeller([front * 0.078 * scale, left * 0.142 * scale, low - 0.030 * scale], scale),
        ]);
    }
    parts
}

/// A spinning propeller: a thin translucent disc.
fn propeller(centre: [f64; 3], scale: f64) -> DronePart {
    let ring = |z: f64| {
        (0..20).map(move |k| {
            let (sin, cos) = (f64::from(k) * std::f64::consts::TAU / 20.0).sin_cos();
            let radius = 0.064 * scale;
            Point3::new(centre[0] + radius * cos, centre[1] + radius * sin, centre[2] + z)
        })
    };
    let solid =
        Solid::hull(ring(0.0).chain(ring(0.003 * scale)).collect(), &[Vector3::z(), -Vector3::z()]);
    // Only the two discs are drawn, not the rim.
    let faces = solid
        .faces
        .iter()
        .filter(|face| face.normal.z.abs() > 0.99)
        .map(|face| PaintedFace::bare(face, CARBON))
        .collect();
    DronePart { solid, faces, opacity: PROPELLER_OPACITY }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use flockeye_geometry::body::squares;

    use super::*;

    fn dict_5x5_250() -> Dictionary {
        Dictionary::load("DICT_5X5_250").unwrap()
    }

    fn alpha(first_id: u32) -> Body {
        squares("alpha", 0.0625, 0.05, first_id)
    }

    #[test]
    fn each_marker_is_printed_on_its_own_facet() {
        let drone = DroneShape::new(&alpha(0), &dict_5x5_250(), true).unwrap();
        let body = &drone.parts[0];
        let printed = body.faces.iter().filter(|face| !face.print.is_empty()).count();
        assert_eq!((body.faces.len(), printed), (26, 17));
        for face in &body.faces {
            for (corners, _) in &face.print {
                assert!(corners.iter().all(|c| face.face.height(c).abs() < 1e-9));
            }
        }
        assert!(drone.radius > 0.15 && drone.radius < 0.3, "{}", drone.radius);
    }

    #[test]
    fn an_airframe_hides_from_below_and_not_from_above() {
        let drone = DroneShape::new(&alpha(0), &dict_5x5_250(), true).unwrap();
        let lower = drone.markers.iter().find(|marker| marker.id == 13).unwrap().centre();
        assert!(drone.hides(&Point3::new(0.15, 0.0, -1.0), &lower));
        assert!(!drone.hides(&Point3::new(2.0, 0.0, 0.0), &lower));
        let bare = DroneShape::new(&alpha(0), &dict_5x5_250(), false).unwrap();
        assert!(!bare.hides(&Point3::new(0.15, 0.0, -1.0), &lower));
    }

    #[test]
    fn parts_come_farthest_first() {
        let drone = DroneShape::new(&alpha(0), &dict_5x5_250(), true).unwrap();
        for eye in [[1.0, 0.3, 0.2], [0.1, -0.2, -0.9], [-0.5, 0.6, 0.8], [0.0, 0.0, 1.5]] {
            let eye = Point3::from(eye);
            let order = drone.back_to_front(&eye);
            assert_eq!(order.len(), drone.parts.len());
            for (k, part) in order.iter().enumerate() {
                let hidden = order[k + 1..].iter().find(|o| part.solid.is_before(&o.solid, &eye));
                assert!(hidden.is_none(), "from {eye}, part {k} hides a later one");
            }
        }
    }

    #[test]
    fn flat_bodies_get_a_back_and_hollow_ones_are_refused() {
        let markers = alpha(0).markers;
        let plate = Body::new("plate", markers[..1].to_vec());
        let drone = DroneShape::new(&plate, &dict_5x5_250(), false).unwrap();
        assert_eq!(drone.parts[0].faces.len(), 6);

        let mut hollow = markers;
        let inwards = hollow[1].normal() * -0.02;
        hollow[1].corners.iter_mut().for_each(|corner| *corner += inwards);
        let error =
            DroneShape::new(&Body::new("alpha", hollow), &dict_5x5_250(), false).unwrap_err();
        assert!(error.to_string().contains("marker 1 of body 'alpha'"), "{error}");
    }

    #[test]
    fn unknown_patterns_are_refused() {
        let error = DroneShape::new(&alpha(240), &dict_5x5_250(), false).unwrap_err();
        assert!(error.to_string().contains("marker 250 of body 'alpha'"), "{error}");
    }
}
