//! The size of square views such that every object as wide as the margin lies wholly in one.
//!
//! A disc of half-angle e round p lies in a view of half-field h exactly if, for both axes of the
//! view, h >= atan(|x|/z) + asin(sin e / hypot(x, z)), (x, y, z) being p in the view's frame: the
//! side of the view is a plane through the middle of the sphere, tilted so that it touches the
//! disc. With r^2 = x^2 + z^2 and q^2 = r^2 - sin^2 e, tan h = (|x| q + z sin e) / (z q - |x| sin
//! e), so that no angle is needed.

use std::f64::consts::FRAC_PI_2;

use nalgebra::Vector3;

use super::hull::{Triangle, covering_cosine};

/// A square view: its axes x right, y down, z forward, in the camera frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Square {
    right: Vector3<f64>,
    down: Vector3<f64>,
    forward: Vector3<f64>,
}

impl Square {
    /// The square with these axes, rotated about the third by an angle of this cosine and sine.
    pub(super) fn new([right, down, forward]: [Vector3<f64>; 3], (cos, sin): (f64, f64)) -> Self {
        Self { right: right * cos + down * sin, down: down * cos - right * sin, forward }
    }

    /// Tangent of the half-field that contains the disc around `p` whose half-angle has this sine;
    /// infinite where no pinhole view contains it.
    pub(super) fn needed(&self, p: &Vector3<f64>, sin_half: f64) -> f64 {
        let z = self.forward.dot(p);
        if z <= 0.0 {
            return f64::INFINITY;
        }
        let along = |across: f64| {
            let x = across.abs();
            let root = x * x + z * z - sin_half * sin_half;
            if root <= 0.0 {
                return f64::INFINITY;
            }
            let q = root.sqrt();
            let below = z * q - x * sin_half;
            if below > 0.0 { (x * q + z * sin_half) / below } else { f64::INFINITY }
        };
        along(self.right.dot(p)).max(along(self.down.dot(p)))
    }

    /// Whether the view may serve points in a cap: false if every disc around them needs more than
    /// `limit`. `sin_inner` is the sine of the disc's half-angle less the cap's. It belongs to the
    /// disc that the discs of all points have in common. A negative value states their common
    /// nearness instead.
    fn is_useful(&self, middle: &Vector3<f64>, cap_sin: f64, sin_inner: f64, limit: f64) -> bool {
        // Near the view's horizon and near its axis the formula is not valid.
        let z = self.forward.dot(middle);
        let is_undecided = |across: f64| z * z + across * across <= sin_inner * sin_inner;
        z.abs() <= cap_sin
            || is_undecided(self.right.dot(middle))
            || is_undecided(self.down.dot(middle))
            || self.needed(middle, sin_inner) <= limit
    }
}

/// Tangent of the smallest half-field with which some square contains the disc around `p`.
pub(super) fn needed_by_best(squares: &[Square], p: &Vector3<f64>, sin_half: f64) -> f64 {
    squares.iter().map(|square| square.needed(p, sin_half)).fold(f64::INFINITY, f64::min)
}

/// Number of triangles after which the tolerance is doubled. Where squares meet along whole sides,
/// as those of the cube without a margin, a whole line has the same need.
const PATIENCE: usize = 100_000;

/// Tangent of the half-field beyond which the search stops (85 degrees): no pinhole view is so
/// wide.
const LARGEST_TAN: f64 = 11.43;

/// The smallest half-field with which the squares contain every disc of half-angle `half_rad`, by
/// branch and bound.
///
/// The sphere is cut into triangles, at first the facets of the directions' hull. A triangle lies
/// in a cap of half-angle c around its middle m. So the disc of half-angle e + c around m contains
/// the discs of half-angle e around all its points. The need of the large disc bounds theirs. A
/// triangle whose bound is within `tolerance_rad` (or a few times that, see [`PATIENCE`]) of the
/// worst point seen is done; another is cut into four. `None`: some disc is in no view of less than
/// 170 degrees.
pub(super) fn half_field(
    squares: &[Square],
    points: &[Vector3<f64>],
    facets: &[Triangle],
    half_rad: f64,
    tolerance_rad: f64,
) -> Option<HalfFieldBound> {
    let (sin, cos) = half_rad.sin_cos();
    // The circumscribed squares contain every disc.
    let enough = half_rad + covering_cosine(facets).acos();
    let mut bound = HalfFieldBound {
        half: (sin, cos),
        limit_tan: if enough < FRAC_PI_2 { enough.tan() + 1e-9 } else { f64::INFINITY },
        tolerance_rad,
        worst_tan: 0.0,
        worst: Vec::new(),
        triangles: 0,
    };
    // Good lower bounds first: the holes, and the middles between neighbours, have large needs.
    for facet in facets {
        let [a, b, c] = facet.corners.map(|corner| points[corner]);
        for p in [facet.normal, normalized(a + b), normalized(b + c), normalized(c + a)] {
            bound.worst_tan = bound.worst_tan.max(needed_by_best(squares, &p, sin));
        }
    }
    if bound.worst_tan > LARGEST_TAN {
        return None;
    }
    let all: Vec<_> = squares.iter().collect();
    for facet in facets {
        if !bound.visit(facet.corners.map(|corner| points[corner]), &all) {
            return None;
        }
    }
    Some(bound)
}

/// A bound on the half-field that some squares need. Each visited triangle improves it.
pub(super) struct HalfFieldBound {
    /// Sine and cosine of the disc's half-angle.
    half: (f64, f64),
    /// A sufficient half-field, as tangent.
    limit_tan: f64,
    tolerance_rad: f64,
    /// The largest half-field that a tested point needs, as tangent.
    worst_tan: f64,
    /// The directions with the largest needs, in rising order.
    pub(super) worst: Vec<Vector3<f64>>,
    /// Number of visited triangles.
    pub(super) triangles: usize,
}

impl HalfFieldBound {
    /// Tangent of a half-field that contains every disc after all triangles were visited. It is
    /// never too small, and too large by the tolerance at most. A triangle that needs no more is
    /// done.
    pub(super) fn certified_tan(&self) -> f64 {
        // The tangent's slope only grows, so this is at most the tolerance beyond the worst point.
        self.worst_tan + self.tolerance_rad * (1.0 + self.worst_tan * self.worst_tan)
    }

    /// Bounds a triangle, whole or in pieces; false where that fails.
    fn visit(&mut self, [a, b, c]: [Vector3<f64>; 3], candidates: &[&Square]) -> bool {
        self.triangles += 1;
        if self.triangles.is_multiple_of(PATIENCE) {
            self.tolerance_rad *= 2.0;
        }
        let middle = normalized(a + b + c);
        let cap_cos = middle.dot(&a).min(middle.dot(&b)).min(middle.dot(&c)).min(1.0);
        let cap_sin = (1.0 - cap_cos * cap_cos).sqrt();
        let (sin, cos) = self.half;
        let large_sin = sin * cap_cos + cos * cap_sin;
        let is_pinhole = cos * cap_cos - sin * cap_sin > 0.0;
        if is_pinhole {
            let done = self.certified_tan();
            if candidates.iter().any(|square| square.needed(&middle, large_sin) <= done) {
                return true;
            }
        }
        let here = candidates
            .iter()
            .map(|square| square.needed(&middle, sin))
            .fold(f64::INFINITY, f64::min);
        if here > self.worst_tan {
            self.worst_tan = here;
            self.worst.push(middle);
        }
        if self.worst_tan > LARGEST_TAN {
            return false;
        }
        let sin_inner = sin * cap_cos - cos * cap_sin;
        let near: Vec<_> = candidates
            .iter()
            .copied()
            .filter(|square| square.is_useful(&middle, cap_sin, sin_inner, self.limit_tan))
            .collect();
        let (ab, bc, ca) = (normalized(a + b), normalized(b + c), normalized(c + a));
        [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
            .into_iter()
            .all(|triangle| self.visit(triangle, &near))
    }
}

fn normalized(vector: Vector3<f64>) -> Vector3<f64> {
    vector / vector.norm_squared().sqrt()
}
