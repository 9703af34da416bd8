//! The convex hull of directions: its facets are the holes between circles.
//!
//! The points of the sphere farthest from all directions are the vertices of the spherical Voronoi
//! diagram. These are the circumcentres of the hull's facets. So the covering radius is the largest
//! circumradius of a facet, exactly.

use nalgebra::Vector3;

/// Height over which a point counts as above a facet's plane. Rounding is below 1e-15, and a hull
/// that differs by so little has the same circumradii.
const ABOVE: f64 = 1e-13;

/// A triangle of the hull; where four directions lie on one circle it is half of their facet.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Triangle {
    /// Indices of its corners, counterclockwise seen from outside.
    pub(super) corners: [usize; 3],
    /// Its unit normal, outwards: the direction of its circumcentre.
    pub(super) normal: Vector3<f64>,
    /// Distance of its plane from the middle of the sphere: the cosine of its circumradius.
    /// Negative where the hull does not contain the middle.
    pub(super) cosine: f64,
}

impl Triangle {
    fn new(points: &[Vector3<f64>], corners: [usize; 3]) -> Option<Self> {
        let [a, b, c] = corners.map(|corner| points[corner]);
        let across = (b - a).cross(&(c - a));
        let norm = across.norm_squared().sqrt();
        if norm < 1e-12 {
            return None;
        }
        let normal = across / norm;
        Some(Self { corners, normal, cosine: normal.dot(&a) })
    }

    fn height(&self, point: &Vector3<f64>) -> f64 {
        self.normal.dot(point) - self.cosine
    }
}

/// The 2 N - 4 facets of the hull of N unit vectors; `None` where two of them coincide or all lie
/// in one plane.
///
/// Points are added one by one: the facets visible from a point are removed, and the border of the
/// gap is joined to it.
pub(super) fn hull(points: &[Vector3<f64>]) -> Option<Vec<Triangle>> {
    let start = tetrahedron(points)?;
    let count = points.len();
    let mut facets = Vec::with_capacity(2 * count);
    for corners in [[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]]
        .map(|face| face.map(|corner: usize| start[corner]))
    {
        facets.push(Triangle::new(points, corners)?);
    }
    // Round in which the facet of each directed edge was removed.
    let mut taken = vec![0; count * count];
    let mut gap = Vec::new();
    for (index, point) in points.iter().enumerate() {
        if start.contains(&index) {
            continue;
        }
        gap.clear();
        facets.retain(|facet: &Triangle| {
            let is_seen = facet.height(point) > ABOVE;
            if is_seen {
                let [a, b, c] = facet.corners;
                for (from, to) in [(a, b), (b, c), (c, a)] {
                    taken[from * count + to] = index + 1;
                    gap.push((from, to));
                }
            }
            !is_seen
        });
        for &(from, to) in &gap {
            if taken[to * count + from] != index + 1 {
                facets.push(Triangle::new(points, [from, to, index])?);
            }
        }
    }
    (facets.len() == 2 * count - 4).then_some(facets)
}

/// Four points that are far from one plane, positively oriented.
fn tetrahedron(points: &[Vector3<f64>]) -> Option<[usize; 4]> {
    let farthest = |measure: &dyn Fn(&Vector3<f64>) -> f64| {
        let best = (0..points.len())
            .max_by(|&a, &b| measure(&points[a]).total_cmp(&measure(&points[b])))?;
        (measure(&points[best]) > 1e-9).then_some(best)
    };
    let first = *points.first()?;
    let a = farthest(&|p| (p - first).norm_squared())?;
    let along = points[a] - first;
    let b = farthest(&|p| along.cross(&(p - first)).norm_squared())?;
    let across = along.cross(&(points[b] - first));
    let c = farthest(&|p| across.dot(&(p - first)).abs())?;
    // From the fourth point the others must appear clockwise.
    let is_above = across.dot(&(points[c] - first)) > 0.0;
    Some(if is_above { [0, b, a, c] } else { [0, a, b, c] })
}

/// Cosine of the covering radius: of the largest circumradius among the facets.
pub(super) fn covering_cosine(facets: &[Triangle]) -> f64 {
    facets.iter().map(|facet| facet.cosine).fold(1.0, f64::min)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::random::Chance;

    #[test]
    fn nothing_is_above_a_facet() {
        for stream in 0..200 {
            let mut random = Chance::stream(7, stream);
            let count = 4 + (stream % 40) as usize;
            let points: Vec<_> = (0..count).map(|_| random.portable_direction()).collect();
            let facets = hull(&points).unwrap();
            assert_eq!(facets.len(), 2 * count - 4);
            for facet in &facets {
                assert!(points.iter().all(|point| facet.height(point) < 1e-12));
            }
        }
    }

    #[test]
    fn square_facets_are_two_triangles() {
        let cube: Vec<_> = (0..8)
            .map(|bits: u8| {
                let sign = |bit: u8| if bits >> bit & 1 == 0 { 1.0 } else { -1.0 };
                Vector3::new(sign(0), sign(1), sign(2)) / 3f64.sqrt()
            })
            .collect();
        let facets = hull(&cube).unwrap();
        assert_eq!(facets.len(), 12);
        assert!(facets.iter().all(|facet| (facet.cosine - 1.0 / 3f64.sqrt()).abs() < 1e-12));
    }

    #[test]
    fn flat_and_double_points_have_no_hull() {
        let (x, y, z) = (Vector3::x(), Vector3::y(), Vector3::z());
        assert!(hull(&[x, y, -x, -y]).is_none());
        assert!(hull(&[x, y, z, -x - y, x]).is_none());
        assert!(hull(&[]).is_none());
    }
}
