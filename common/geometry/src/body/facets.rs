//! The flat sides of a body, which carry its markers.

use nalgebra::{Point3, Vector3};

use super::marker::{MAX_MARKERS, Marker};
use super::solid::{FLATNESS_M, Solid};

/// A flat side of a body: white where it carries a marker, else blank.
#[derive(Debug, Clone, PartialEq)]
pub struct Facet {
    /// Outward unit normal, in the markers' frame.
    pub normal: Vector3<f64>,
    /// Its corners in the markers' frame, metres: a convex polygon, counter-clockwise seen from
    /// outside.
    pub outline: Vec<Point3<f64>>,
    /// Marker on this side: an index into [`super::Body::markers`].
    pub marker: Option<usize>,
}

/// Limit on the height of a hull over a marker on it, metres. The marker is wider than the square
/// whose plane was measured.
const CONVEXITY_M: f64 = 5.0 * FLATNESS_M;

/// Limit on the distance of a marker's corners from its given facet, in sides of the marker.
/// Markers are glued and measured by hand.
const GLUED_SIDES: f64 = 0.1;

/// Facets of markers with quiet zones of these widths (metres): the sides of their hull. Without a
/// hull, or where a side carries several markers, the markers' own white squares replace it.
pub(super) fn round(markers: &[Marker], quiet_zones_m: &[f64]) -> Vec<Facet> {
    let own: Vec<Facet> = (0..markers.len())
        .map(|k| Facet {
            normal: markers[k].normal(),
            outline: white_square(&markers[k], quiet_zones_m[k]),
            marker: Some(k),
        })
        .collect();
    let points: Vec<Point3<f64>> = own.iter().flat_map(|facet| &facet.outline).copied().collect();
    let height = |facet: &Facet, point: &Point3<f64>| facet.normal.dot(&(point - facet.outline[0]));
    let is_convex =
        || own.iter().all(|facet| points.iter().all(|p| height(facet, p) <= CONVEXITY_M));
    let is_flat =
        || own.iter().any(|facet| points.iter().all(|p| height(facet, p).abs() <= CONVEXITY_M));
    if markers.len() > MAX_MARKERS || !is_convex() || is_flat() {
        return own;
    }
    let normals: Vec<Vector3<f64>> = own.iter().map(|facet| facet.normal).collect();
    of_solid(&Solid::hull(points, &normals), own)
}

/// The sides of a solid, each with the marker on it.
pub(super) fn on(solid: &Solid, markers: &[Marker]) -> Vec<Facet> {
    let own = (0..markers.len()).map(|k| Facet {
        normal: markers[k].normal(),
        outline: white_square(&markers[k], 0.0),
        marker: Some(k),
    });
    of_solid(solid, own.collect())
}

/// The sides of a solid. A side with several markers is replaced by `own` of each marker.
fn of_solid(solid: &Solid, own: Vec<Facet>) -> Vec<Facet> {
    let mut carried = vec![Vec::new(); solid.faces.len()];
    for (k, facet) in own.iter().enumerate() {
        let towards = |face: usize| solid.faces[face].normal.dot(&facet.normal);
        let nearest = (0..carried.len()).max_by(|&a, &b| towards(a).total_cmp(&towards(b)));
        if let Some(face) = nearest {
            carried[face].push(k);
        }
    }
    let of_face = |face: usize, marker| Facet {
        normal: solid.faces[face].normal,
        outline: solid.faces[face].corners.clone(),
        marker,
    };
    let mut facets: Vec<Facet> = own
        .into_iter()
        .enumerate()
        .map(|(k, own)| match carried.iter().position(|markers| *markers == [k]) {
            Some(face) => of_face(face, Some(k)),
            None => own,
        })
        .collect();
    let blank = (0..carried.len()).filter(|&face| carried[face].is_empty());
    facets.extend(blank.map(|face| of_face(face, None)));
    facets
}

/// A marker's square, wider by `quiet_zone_m` on each side, counter-clockwise seen from outside.
fn white_square(marker: &Marker, quiet_zone_m: f64) -> Vec<Point3<f64>> {
    let centre = marker.centre();
    let scale = 1.0 + 2.0 * quiet_zone_m / marker.side();
    marker.corners.iter().rev().map(|corner| centre + (corner - centre) * scale).collect()
}

/// Facets as given for the body `name`; their errors are added to `problems`.
pub(super) fn given(
    name: &str,
    markers: &[Marker],
    outlines: Vec<Vec<Point3<f64>>>,
    problems: &mut Vec<String>,
) -> Vec<Facet> {
    let mut facets = Vec::new();
    for (index, outline) in outlines.into_iter().enumerate() {
        match normal_of(&outline) {
            Ok(normal) => facets.push(Facet { normal, outline, marker: None }),
            Err(why) => problems.push(format!("facet {index} of body '{name}' {why}")),
        }
    }
    for (k, marker) in markers.iter().enumerate() {
        let reach_m = GLUED_SIDES * marker.side();
        match facets.iter_mut().find(|facet| facet.holds(marker, reach_m)) {
            None => problems.push(format!(
                "marker {} of body '{name}' lies on none of the body's facets",
                marker.id
            )),
            Some(Facet { marker: Some(other), .. }) => problems.push(format!(
                "markers {} and {} of body '{name}' lie on one facet; each needs its own",
                markers[*other].id, marker.id
            )),
            Some(facet) => facet.marker = Some(k),
        }
    }
    facets.sort_by_key(|facet| facet.marker.unwrap_or(usize::MAX));
    facets
}

impl Facet {
    /// Whether the marker has the direction of the facet and its corners lie on it, at most
    /// `reach_m` beside or above.
    pub fn holds(&self, marker: &Marker, reach_m: f64) -> bool {
        let count = self.outline.len();
        let is_on = |corner: &Point3<f64>| {
            let beside = |k: usize| {
                let edge = self.outline[(k + 1) % count] - self.outline[k];
                let inwards = self.normal.cross(&edge).normalize();
                inwards.dot(&(corner - self.outline[k])) >= -reach_m
            };
            self.normal.dot(&(corner - self.outline[0])).abs() <= reach_m && (0..count).all(beside)
        };
        marker.normal().dot(&self.normal) > 0.9 && marker.corners.iter().all(is_on)
    }
}

/// The outward normal of a polygon, or the reason why it is no facet.
fn normal_of(outline: &[Point3<f64>]) -> Result<Vector3<f64>, String> {
    if !outline.iter().flat_map(|p| p.iter()).all(|x| x.is_finite()) {
        return Err("has a corner that is not a number".into());
    }
    let count = outline.len();
    if !(3..=64).contains(&count) {
        return Err(format!("has {count} corners; 3 to 64 are allowed"));
    }
    let middle = outline.iter().map(|p| p.coords).sum::<Vector3<f64>>() / count as f64;
    let from_middle = |k: usize| outline[k % count].coords - middle;
    // Newell's method: correct for any flat polygon.
    let area: Vector3<f64> = (0..count).map(|k| from_middle(k).cross(&from_middle(k + 1))).sum();
    let size = (0..count).map(|k| from_middle(k).norm()).fold(0.0, f64::max);
    if size < 1e-3 || area.norm() < 1e-4 * size * size {
        return Err("has no area".into());
    }
    let normal = area.normalize();
    let off = (0..count).map(|k| normal.dot(&from_middle(k)).abs()).fold(0.0, f64::max);
    if off > 0.02 * size {
        return Err(format!("is not flat: a corner is {:.1} mm off its plane", off * 1e3));
    }
    let turn = |k: usize| {
        let at = |n: usize| outline[(k + n) % count];
        (at(1) - at(0)).cross(&(at(2) - at(1))).dot(&normal)
    };
    if (0..count).any(|k| turn(k) < -1e-6 * size * size) {
        return Err("is not convex".into());
    }
    Ok(normal)
}
