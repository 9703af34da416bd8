//! The partition of the sphere: which directions to look along so that nothing is missed
//! (section III-A of the paper).

use std::f64::consts::PI;

use crate::Ray;
use crate::view::View;
use nalgebra::{Unit, Vector3};

/// Directions whose circles of one common diameter cover the sphere.
#[derive(Debug, Clone, PartialEq)]
pub struct Partition {
    directions: Vec<Ray>,
    covering_diameter_rad: f64,
}

/// Why a partition gives no views.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum PartitionError {
    /// The square round a circle and its margin would not fit a pinhole image.
    #[error(
        "a partition's circle of {:.1} degrees with a margin of {:.1} degrees gives no view: the \
         margin must be 0 or more and both together below {:.0} degrees; take a smaller margin or \
         more partitions",
        .diameter_rad.to_degrees(), .margin_rad.to_degrees(), LARGEST_FIELD_RAD.to_degrees()
    )]
    Field {
        /// The covering diameter, radians.
        diameter_rad: f64,
        /// The margin asked for, radians.
        margin_rad: f64,
    },
    /// A resolution that gives no picture.
    #[error("{pixels_per_radian} pixels for each radian give no view: 1 to 100000 are allowed")]
    Resolution {
        /// Pixels for each radian at the view's middle.
        pixels_per_radian: f64,
    },
}

/// Beyond this field a pinhole image stretches its rim more than eight times.
const LARGEST_FIELD_RAD: f64 = 140.0 / 180.0 * PI;

impl Partition {
    /// The 12 vertices of the icosahedron: the best covering of the sphere by 12 circles
    /// (L. Fejes Toth, 1953), of 74.7547 degrees.
    ///
    /// They are the cyclic permutations of (0, +-1, +-phi), phi the golden ratio; the order begins
    /// ahead (+x) and ends behind, so that a search in fixed order looks ahead first.
    pub fn icosahedron() -> Self {
        let phi = (1.0 + 5f64.sqrt()) / 2.0;
        let directions = [
            (phi, 0.0, 1.0),
            (phi, 0.0, -1.0),
            (1.0, phi, 0.0),
            (1.0, -phi, 0.0),
            (0.0, 1.0, phi),
            (0.0, -1.0, phi),
            (0.0, 1.0, -phi),
            (0.0, -1.0, -phi),
            (-1.0, phi, 0.0),
            (-1.0, -phi, 0.0),
            (-phi, 0.0, 1.0),
            (-phi, 0.0, -1.0),
        ]
        .map(|(x, y, z)| Unit::new_normalize(Vector3::new(x, y, z)));
        Self::from_directions(directions.to_vec())
    }

    /// Measures what circles the directions need. They must not all lie in one plane.
    fn from_directions(directions: Vec<Ray>) -> Self {
        let covering_diameter_rad = 2.0 * covering_radius_rad(&directions);
        Self { directions, covering_diameter_rad }
    }

    /// The middles of the circles, unit vectors in the camera frame; their order is the
    /// partitions' numbering.
    pub fn directions(&self) -> &[Ray] {
        &self.directions
    }

    /// How many partitions there are: the paper's N.
    #[expect(clippy::len_without_is_empty, reason = "a partition of the sphere is never empty")]
    pub fn len(&self) -> usize {
        self.directions.len()
    }

    /// The smallest diameter, radians, with which circles round the directions leave no gap: the
    /// paper's theta.
    pub fn covering_diameter_rad(&self) -> f64 {
        self.covering_diameter_rad
    }

    /// One upright square view for each partition, at the sphere's own resolution in its middle.
    ///
    /// Each is the square round a circle of diameter theta + `margin_rad`, so that whatever is at
    /// most `margin_rad` wide lies wholly in some view, wherever it is.
    /// `pixels_per_radian` is the sphere image's, and becomes the focal length in pixels.
    ///
    /// # Errors
    /// A margin or resolution for which there is no pinhole image.
    pub fn views(
        &self,
        margin_rad: f64,
        pixels_per_radian: f64,
    ) -> Result<Vec<View>, PartitionError> {
        let diameter_rad = self.covering_diameter_rad;
        let field_rad = diameter_rad + margin_rad;
        // Written so that NaN is refused too.
        if !(margin_rad >= 0.0 && field_rad < LARGEST_FIELD_RAD) {
            return Err(PartitionError::Field { diameter_rad, margin_rad });
        }
        if !(1.0..=1e5).contains(&pixels_per_radian) {
            return Err(PartitionError::Resolution { pixels_per_radian });
        }
        // One pixel more, because n pixels' centres span only n - 1.
        let size_px = (2.0 * pixels_per_radian * (field_rad / 2.0).tan()).ceil() as u32 + 1;
        let view = |direction: &Ray| View {
            focal_px: pixels_per_radian,
            ..View::looking_at(direction, field_rad, size_px)
        };
        Ok(self.directions.iter().map(view).collect())
    }

    /// Angle between the directions of two partitions, radians; `None` if one does not exist.
    pub fn distance_rad(&self, from: usize, to: usize) -> Option<f64> {
        Some(self.directions.get(from)?.angle(self.directions.get(to)?))
    }

    /// The partition whose direction is nearest to `ray_in_camera`; the lower number in a tie.
    pub fn nearest(&self, ray_in_camera: &Ray) -> usize {
        let mut nearest = (0, f64::NEG_INFINITY);
        for (index, direction) in self.directions.iter().enumerate() {
            let cosine = direction.dot(ray_in_camera);
            if cosine > nearest.1 {
                nearest = (index, cosine);
            }
        }
        nearest.0
    }
}

/// Largest angle, radians, between any point of the sphere and the direction nearest to it.
///
/// The points farthest from all directions are the circumcentres of the facets of the directions'
/// convex hull (the vertices of the spherical Voronoi diagram), so each triple that has all others
/// on one side is measured. O(N^4): for a few dozen directions.
fn covering_radius_rad(directions: &[Ray]) -> f64 {
    let mut radius: f64 = 0.0;
    for (a, p) in directions.iter().enumerate() {
        for (b, q) in directions.iter().enumerate().skip(a + 1) {
            for r in &directions[b + 1..] {
                let Some(normal) = (q.into_inner() - p.into_inner())
                    .cross(&(r.into_inner() - p.into_inner()))
                    .try_normalize(1e-12)
                else {
                    continue;
                };
                let offset = normal.dot(p);
                let side = |d: &Ray| normal.dot(d) - offset;
                if directions.iter().all(|d| side(d) < 1e-9) {
                    radius = radius.max(offset.clamp(-1.0, 1.0).acos());
                } else if directions.iter().all(|d| side(d) > -1e-9) {
                    radius = radius.max((-offset).clamp(-1.0, 1.0).acos());
                }
            }
        }
    }
    radius
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use proptest::prelude::*;

    const PIXELS_PER_RADIAN: f64 = 3840.0 / std::f64::consts::TAU;

    #[test]
    fn the_covering_diameter_is_the_best_known() {
        let partition = Partition::icosahedron();
        assert_eq!(partition.len(), 12);
        assert!((partition.covering_diameter_rad().to_degrees() - 74.7547).abs() < 5e-5);
        // A facet's circumcentre is that far from its corners and nearer to none: nothing smaller
        // than the diameter covers.
        let hole = Unit::new_normalize(Vector3::new(1.0, 1.0, 1.0));
        let nearest = &partition.directions()[partition.nearest(&hole)];
        assert!((2.0 * nearest.angle(&hole) - partition.covering_diameter_rad()).abs() < 1e-9);
    }

    #[test]
    fn fewer_directions_need_larger_circles() {
        let octahedron = [Vector3::x_axis(), Vector3::y_axis(), Vector3::z_axis()]
            .into_iter()
            .flat_map(|axis| [axis, -axis])
            .collect();
        let theta = Partition::from_directions(octahedron).covering_diameter_rad();
        assert!((theta.to_degrees() - 109.4712).abs() < 5e-5);
    }

    #[test]
    fn neighbours_on_the_icosahedron_are_five() {
        let partition = Partition::icosahedron();
        for from in 0..12 {
            let near = (0..12).filter(|&to| {
                let distance = partition.distance_rad(from, to).unwrap().to_degrees();
                (distance - 63.4349).abs() < 1e-3
            });
            assert_eq!(near.count(), 5);
        }
        assert_eq!(partition.distance_rad(0, 12), None);
    }

    #[test]
    fn views_have_the_spheres_resolution() {
        let views = Partition::icosahedron().views(0.0, PIXELS_PER_RADIAN).unwrap();
        assert!(views.iter().all(|view| view.focal_px == PIXELS_PER_RADIAN));
        assert!(views.iter().all(|view| view.size_px == 935), "{}", views[0].size_px);
    }

    #[test]
    fn impossible_views_are_refused() {
        let partition = Partition::icosahedron();
        for (margin, resolution) in
            [(-0.1, 600.0), (2.0, 600.0), (f64::NAN, 600.0), (0.1, 0.0), (0.1, f64::NAN)]
        {
            assert!(partition.views(margin, resolution).is_err(), "{margin} {resolution}");
        }
    }

    fn direction() -> impl Strategy<Value = Ray> {
        (-1.0..1.0f64, 0.0..std::f64::consts::TAU).prop_map(|(z, longitude)| {
            let across = (1.0 - z * z).sqrt();
            Unit::new_normalize(Vector3::new(across * longitude.cos(), across * longitude.sin(), z))
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2_000))]
        #[test]
        fn whatever_is_as_wide_as_the_margin_lies_wholly_in_a_view(
            middle in direction(),
            margin_deg in 0.0..25.0f64,
        ) {
            let margin = margin_deg.to_radians();
            let views = Partition::icosahedron().views(margin, PIXELS_PER_RADIAN).unwrap();
            let across = middle.cross(&Vector3::new(0.3, -0.5, 0.8)).normalize();
            let down = middle.cross(&across);
            let rim: Vec<Ray> = (0..36)
                .map(|k| {
                    let turn = f64::from(k) * std::f64::consts::TAU / 36.0;
                    let outwards = across * turn.cos() + down * turn.sin();
                    let (sin, cos) = (margin / 2.0).sin_cos();
                    Unit::new_normalize(middle.into_inner() * cos + outwards * sin)
                })
                .collect();
            prop_assert!(views.iter().any(|view| rim.iter().all(|ray| view.holds(ray, 0.0))));
        }
    }
}
