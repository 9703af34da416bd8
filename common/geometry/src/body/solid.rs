//! Convex solids: hulls, boxes, and occlusion between them.

use nalgebra::{Point3, Vector3};

/// One flat side of a solid.
#[derive(Debug, Clone)]
pub struct Face {
    /// Outward unit normal.
    pub normal: Vector3<f64>,
    /// Distance of its plane from the origin along the normal, metres.
    pub offset: f64,
    /// Its corners in order round the normal, metres.
    pub corners: Vec<Point3<f64>>,
}

impl Face {
    /// Height of `point` above the face's plane, metres; negative inside the solid.
    pub fn height(&self, point: &Point3<f64>) -> f64 {
        self.normal.dot(&point.coords) - self.offset
    }
}

/// A convex polyhedron, in the markers' frame.
#[derive(Debug, Clone)]
pub struct Solid {
    /// Its sides.
    pub faces: Vec<Face>,
    /// Its corners, each once.
    pub corners: Vec<Point3<f64>>,
}

/// Points this near to a plane count as on it, metres. Bodies are measured no more precisely.
pub const FLATNESS_M: f64 = 1e-4;

impl Solid {
    /// The box between two opposite corners.
    pub fn cuboid(low: [f64; 3], high: [f64; 3]) -> Self {
        let corners = (0..8).map(|k| {
            let pick = |axis: usize| if k >> axis & 1 == 0 { low[axis] } else { high[axis] };
            Point3::new(pick(0), pick(1), pick(2))
        });
        Self::hull(corners.collect(), &[])
    }

    /// The convex hull of points that do not all lie in one plane. Planes of `known_normals` that
    /// touch the hull from outside become faces first, so that they keep their exact normals.
    ///
    /// Every triple of points is tried as a face: fast enough for the hundred points of a body.
    pub fn hull(points: Vec<Point3<f64>>, known_normals: &[Vector3<f64>]) -> Self {
        let mut corners: Vec<Point3<f64>> = Vec::new();
        for point in points {
            if corners.iter().all(|corner| (corner - point).norm() > FLATNESS_M) {
                corners.push(point);
            }
        }
        let mut faces: Vec<Face> = Vec::new();
        for normal in known_normals {
            add_face(&mut faces, &corners, *normal);
        }
        let count = corners.len();
        for a in 0..count {
            for b in a + 1..count {
                for c in b + 1..count {
                    let cross = (corners[b] - corners[a]).cross(&(corners[c] - corners[a]));
                    // Three points nearly in a line define no plane.
                    if cross.norm() < 1e-8 {
                        continue;
                    }
                    let normal = cross.normalize();
                    let height = |k: usize| normal.dot(&(corners[k] - corners[a]));
                    let outwards = if (0..count).all(|k| height(k) < FLATNESS_M) {
                        normal
                    } else if (0..count).all(|k| height(k) > -FLATNESS_M) {
                        -normal
                    } else {
                        continue;
                    };
                    let on_one_face = |face: &Face| {
                        [a, b, c].iter().all(|&k| face.height(&corners[k]).abs() < FLATNESS_M)
                    };
                    if !faces.iter().any(on_one_face) {
                        add_face(&mut faces, &corners, outwards);
                    }
                }
            }
        }
        Self { faces, corners }
    }

    /// Whether all corners lie in one plane, so that the solid has no inside.
    pub fn is_flat(&self) -> bool {
        self.faces
            .iter()
            .any(|face| self.corners.iter().all(|corner| face.height(corner).abs() < FLATNESS_M))
    }

    /// Whether the line from `eye` to `point` passes through the solid before it reaches `point`.
    pub fn hides(&self, eye: &Point3<f64>, point: &Point3<f64>) -> bool {
        // Clip the segment against every face (Cyrus and Beck 1978); points on a face stay visible.
        let (mut enter, mut leave) = (0.0f64, 1.0 - 1e-6f64);
        for face in &self.faces {
            let (from, to) = (face.height(eye), face.height(point));
            if from > 0.0 && to > 0.0 {
                return false;
            }
            let slope = to - from;
            if slope < 0.0 {
                enter = enter.max(-from / slope);
            } else if slope > 0.0 {
                leave = leave.min(-from / slope);
            }
        }
        enter + 1e-6 < leave
    }

    /// Whether this solid can hide a part of `other` from `eye`. It cannot if a face of either
    /// separates the two and the eye is on the side of `other`. If no face separates the solids,
    /// the nearer one hides the other.
    pub fn is_before(&self, other: &Self, eye: &Point3<f64>) -> bool {
        // Heights of the eye above those faces of one solid that have the other solid outside.
        let parting = |of: &Self, from: &Self| -> Vec<f64> {
            let outside = |face: &&Face| from.corners.iter().all(|p| face.height(p) > -1e-9);
            of.faces.iter().filter(outside).map(|face| face.height(eye)).collect()
        };
        let (own, others) = (parting(self, other), parting(other, self));
        if own.is_empty() && others.is_empty() {
            return (self.middle() - eye).norm() < (other.middle() - eye).norm();
        }
        own.into_iter().all(|height| height <= 0.0) && others.into_iter().all(|height| height > 0.0)
    }

    fn middle(&self) -> Point3<f64> {
        let sum: Vector3<f64> = self.corners.iter().map(|corner| corner.coords).sum();
        Point3::from(sum / self.corners.len().max(1) as f64)
    }
}

/// Adds the face that touches `corners` from the side of `normal`, if it has at least three.
fn add_face(faces: &mut Vec<Face>, corners: &[Point3<f64>], normal: Vector3<f64>) {
    let offset = corners.iter().map(|p| normal.dot(&p.coords)).fold(f64::NEG_INFINITY, f64::max);
    let mut face = Face { normal, offset, corners: Vec::new() };
    let touching: Vec<Point3<f64>> =
        corners.iter().filter(|p| face.height(p) > -FLATNESS_M).copied().collect();
    let known = |f: &Face| f.normal.dot(&normal) > 0.999_999;
    if touching.len() < 3 || faces.iter().any(known) {
        return;
    }
    face.corners = outline(&touching, &normal);
    if face.corners.len() >= 3 {
        faces.push(face);
    }
}

/// The corners of the convex polygon round points of one plane, counter-clockwise round `normal`
/// (Andrew's monotone chain, 1979). Points on its edges are left out.
fn outline(points: &[Point3<f64>], normal: &Vector3<f64>) -> Vec<Point3<f64>> {
    // The axis with the smallest component of the normal.
    let axis = Vector3::ith(normal.iamin(), 1.0);
    let across = normal.cross(&axis).normalize();
    let along = normal.cross(&across);
    // Rounded, and without a negative zero, so that points above each other are sorted by height.
    let nanometres = |x: f64| (x * 1e9).round() + 0.0;
    let flat =
        |p: &Point3<f64>| (nanometres(across.dot(&p.coords)), nanometres(along.dot(&p.coords)));
    let mut sorted = points.to_vec();
    sorted.sort_by(|a, b| {
        let (a, b) = (flat(a), flat(b));
        a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1))
    });
    let turns_left = |a: &Point3<f64>, b: &Point3<f64>, c: &Point3<f64>| {
        (b - a).cross(&(c - b)).dot(normal) > 1e-9
    };
    let chain = |points: &mut dyn Iterator<Item = &Point3<f64>>| {
        let mut chain: Vec<Point3<f64>> = Vec::new();
        for point in points {
            while let [.., a, b] = chain.as_slice()
                && !turns_left(a, b, point)
            {
                chain.pop();
            }
            chain.push(*point);
        }
        // The last point is the first of the other chain.
        chain.pop();
        chain
    };
    let mut corners = chain(&mut sorted.iter());
    corners.extend(chain(&mut sorted.iter().rev()));
    // Because of rounding, a chain may end in the middle of an edge.
    let count = corners.len();
    let is_corner = |k: usize| {
        turns_left(&corners[(k + count - 1) % count], &corners[k], &corners[(k + 1) % count])
    };
    (0..count).filter(|&k| is_corner(k)).map(|k| corners[k]).collect()
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;

    fn cube() -> Solid {
        Solid::cuboid([-1.0; 3], [1.0; 3])
    }

    #[test]
    fn a_box_has_six_faces_of_four_corners() {
        let cube = cube();
        assert_eq!((cube.faces.len(), cube.corners.len()), (6, 8));
        for face in &cube.faces {
            assert_eq!(face.corners.len(), 4);
            assert!((face.offset - 1.0).abs() < 1e-12);
            let turn = (face.corners[1] - face.corners[0])
                .cross(&(face.corners[2] - face.corners[1]))
                .dot(&face.normal);
            assert!((turn - 4.0).abs() < 1e-9, "counter-clockwise round the normal: {turn}");
        }
    }

    #[test]
    fn the_preset_body_is_a_rhombicuboctahedron() {
        let body = crate::body::squares("a", 0.0625, 0.0625, 0);
        let normals: Vec<_> = body.markers.iter().map(|marker| marker.normal()).collect();
        let hull = Solid::hull(body.corners().copied().collect(), &normals);
        let with = |sides: usize| hull.faces.iter().filter(|f| f.corners.len() == sides).count();
        assert_eq!((hull.corners.len(), hull.faces.len(), with(4), with(3)), (24, 26, 18, 8));
        assert!(!hull.is_flat());
    }

    #[test]
    fn a_segment_through_the_box_is_hidden_and_beside_it_is_not() {
        let cube = cube();
        let eye = Point3::new(5.0, 0.0, 0.0);
        assert!(cube.hides(&eye, &Point3::new(-5.0, 0.2, 0.3)));
        assert!(!cube.hides(&eye, &Point3::new(-5.0, 4.0, 0.0)));
        assert!(!cube.hides(&eye, &Point3::new(2.0, 0.0, 0.0)), "in front");
        assert!(!cube.hides(&eye, &Point3::new(1.0, 0.5, 0.5)), "on the near face");
        assert!(cube.hides(&eye, &Point3::new(-1.0, 0.5, 0.5)), "on the far face");
    }

    #[test]
    fn order_follows_the_parting_plane_and_not_the_distance() {
        // A long plank under the eye is nearer in the middle, yet the small box on it hides it.
        let plank = Solid::cuboid([-10.0, -1.0, -1.0], [10.0, 1.0, 0.0]);
        let on_it = Solid::cuboid([8.0, -0.5, 0.0], [9.0, 0.5, 1.0]);
        let eye = Point3::new(0.0, 0.0, 3.0);
        assert!(on_it.is_before(&plank, &eye) && !plank.is_before(&on_it, &eye));
        let below = Point3::new(0.0, 0.0, -3.0);
        assert!(plank.is_before(&on_it, &below) && !on_it.is_before(&plank, &below));
    }
}
