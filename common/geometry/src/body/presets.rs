//! The solids that come with Flockeye.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, TAU};

use nalgebra::{Point3, Vector3};

use super::solid::Solid;
use super::{Body, Facet, Marker, facets};

/// The rhombicuboctahedron with a marker on each square facet but the bottom one (preset
/// `squares`): 17 ids from `first_id`: the top; the upper ring at azimuth 0, 90, 180, 270; the belt
/// at 0, 45 .. 315; the lower ring. The printed up points to +z; on the top marker, to +x.
///
/// `edge` and `marker_side` in metres; the square facets lie (1 + sqrt 2)/2 edges from the centre.
pub fn squares(name: &str, edge: f64, marker_side: f64, first_id: u32) -> Body {
    let distance = (1.0 + 2f64.sqrt()) / 2.0 * edge;
    let directions = std::iter::once((0.0, FRAC_PI_2))
        .chain(ring(4, 0.0, FRAC_PI_4))
        .chain(ring(8, 0.0, 0.0))
        .chain(ring(4, 0.0, -FRAC_PI_4));
    let markers: Vec<Marker> = directions
        .zip(first_id..)
        .map(|(direction, id)| Site::towards(direction, distance).marker(id, marker_side))
        .collect();
    let facets = facets::on(&rhombicuboctahedron(edge, -2.0 * edge), &markers);
    Body::of_parts(name, markers, facets)
}

/// Sizes of the body [`truncated`], metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TruncatedSizes {
    /// Edge of the solid.
    pub edge_m: f64,
    /// Side of the 13 markers on square facets.
    pub marker_m: f64,
    /// Side of the 4 markers on triangles.
    pub small_marker_m: f64,
    /// Distance of the small markers from the middle of their triangle, towards the belt.
    pub small_shift_m: f64,
}

impl Default for TruncatedSizes {
    /// The body of the test flights.
    fn default() -> Self {
        Self {
            edge_m: 0.075,
            marker_m: 0.048_683,
            small_marker_m: 0.023_283,
            small_shift_m: 0.003_901,
        }
    }
}

/// The rhombicuboctahedron without its lower cupola (preset `truncated`): 17 ids from `first_id`:
/// the belt at azimuth 0, 45 .. 315; the upper ring at 0, 90, 180, 270; the top; the upper
/// triangles at 45, 135, 225, 315, which have small markers. The octagon below the belt is the
/// mount. The printed up points to +z; on the top marker, to +x.
///
/// The origin is that of the whole solid: the triangles lie (3 + sqrt 2)/(2 sqrt 3) edges from it.
pub fn truncated(name: &str, sizes: &TruncatedSizes, first_id: u32) -> Body {
    let edge = sizes.edge_m;
    let distance = (1.0 + 2f64.sqrt()) / 2.0 * edge;
    let on_squares = ring(8, 0.0, 0.0)
        .chain(ring(4, 0.0, FRAC_PI_4))
        .chain(std::iter::once((0.0, FRAC_PI_2)))
        .map(|direction| (Site::towards(direction, distance), sizes.marker_m));
    let to_triangles = (3.0 + 2f64.sqrt()) / (2.0 * 3f64.sqrt()) * edge;
    let on_triangles = ring(4, FRAC_PI_4, (1.0 / 2f64.sqrt()).atan()).map(|direction| {
        let mut site = Site::towards(direction, to_triangles);
        site.centre -= site.up * sizes.small_shift_m;
        (site, sizes.small_marker_m)
    });
    let markers: Vec<Marker> = on_squares
        .chain(on_triangles)
        .zip(first_id..)
        .map(|((site, side), id)| site.marker(id, side))
        .collect();
    let facets = facets::on(&rhombicuboctahedron(edge, -0.75 * edge), &markers);
    Body::of_parts(name, markers, facets)
}

/// A cube with a marker on each side but the bottom one, the mount (preset `cube`): 5 ids from
/// `first_id`: the top; the sides at azimuth 0, 90, 180, 270. The printed up points to +z; on the
/// top marker, to +x. `edge` and `marker_side` in metres.
pub fn cube(name: &str, edge: f64, marker_side: f64, first_id: u32) -> Body {
    let half = edge / 2.0;
    let directions = std::iter::once((0.0, FRAC_PI_2)).chain(ring(4, 0.0, 0.0));
    let markers: Vec<Marker> = directions
        .zip(first_id..)
        .map(|(direction, id)| Site::towards(direction, half).marker(id, marker_side))
        .collect();
    let facets = facets::on(&Solid::cuboid([-half; 3], [half; 3]), &markers);
    Body::of_parts(name, markers, facets)
}

/// One marker on a square plate of edge `edge`, looking along +z from the origin, its printed up
/// towards +x (preset `plate`). Its back is not modelled. `edge` and `marker_side` in metres.
pub fn plate(name: &str, edge: f64, marker_side: f64, id: u32) -> Body {
    let site = Site::towards((0.0, FRAC_PI_2), 0.0);
    let mut outline = site.marker(id, edge).corners.to_vec();
    outline.reverse();
    let facet = Facet { normal: Vector3::z(), outline, marker: Some(0) };
    Body::of_parts(name, vec![site.marker(id, marker_side)], vec![facet])
}

/// The rhombicuboctahedron's vertices above the height `lowest`, and their hull. They are all
/// permutations of (+-1, +-1, +-(1 + sqrt 2)) * edge/2.
fn rhombicuboctahedron(edge: f64, lowest: f64) -> Solid {
    let mut vertices = Vec::new();
    for axis in 0..3 {
        for signs in 0..8 {
            let sign = |bit: usize| if signs >> bit & 1 == 0 { -1.0 } else { 1.0 };
            let mut vertex = Vector3::new(sign(0), sign(1), sign(2));
            vertex[axis] *= 1.0 + 2f64.sqrt();
            vertices.push(Point3::from(vertex * (edge / 2.0)));
        }
    }
    vertices.retain(|vertex| vertex.z > lowest);
    // The facets have the directions of a cube's faces, edges and corners.
    let steps = || [-1.0, 0.0, 1.0].into_iter();
    let normals = steps()
        .flat_map(|x| steps().flat_map(move |y| steps().map(move |z| Vector3::new(x, y, z))))
        .filter_map(|normal| normal.try_normalize(0.5));
    Solid::hull(vertices, &normals.collect::<Vec<_>>())
}

/// Azimuth and elevation (radians) of `count` facets all round, the first at `azimuth`.
fn ring(count: u32, azimuth: f64, elevation: f64) -> impl Iterator<Item = (f64, f64)> {
    (0..count).map(move |k| (azimuth + f64::from(k) * TAU / f64::from(count), elevation))
}

/// Place of a marker: the middle of its facet.
struct Site {
    centre: Vector3<f64>,
    normal: Vector3<f64>,
    up: Vector3<f64>,
}

impl Site {
    /// Place on the facet in this azimuth and elevation (radians), `distance` metres from the
    /// body's centre.
    fn towards((azimuth, elevation): (f64, f64), distance: f64) -> Self {
        let (sin_az, cos_az) = azimuth.sin_cos();
        let (sin_el, cos_el) = elevation.sin_cos();
        let normal = Vector3::new(cos_el * cos_az, cos_el * sin_az, sin_el);
        // The top marker's up is +x; it tilts towards +z as the facet comes down.
        let up = if elevation > 1.5 {
            Vector3::x()
        } else {
            Vector3::new(-sin_el * cos_az, -sin_el * sin_az, cos_el)
        };
        // Exact values, so that plates lie in their plane.
        let normal = if elevation > 1.5 { Vector3::z() } else { normal };
        Self { centre: normal * distance, normal, up }
    }

    fn marker(&self, id: u32, side: f64) -> Marker {
        let right = self.up.cross(&self.normal);
        let half = side / 2.0;
        let at =
            |x: f64, y: f64| Point3::from(self.centre + right * (x * half) + self.up * (y * half));
        Marker { id, corners: [at(-1.0, 1.0), at(1.0, 1.0), at(1.0, -1.0), at(-1.0, -1.0)] }
    }
}
