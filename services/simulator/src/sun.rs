//! A low sun on the bodies, with striped shadows.
//!
//! The sun has one direction, so one side of a body is much brighter than the other. A surface
//! towards the sun has the hall's full light, a surface in shade a share of it. A fence or a blind
//! casts striped shadows that are fixed in the world: their edges cross markers anywhere. Bodies
//! cast no shadows.

use flockeye_config::SimulatedSun;
use nalgebra::{Isometry3, Point3, Vector3};

/// Sunlight and its stripes in the frame of one body.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sunlight {
    towards_sun: Vector3<f64>,
    /// Normal of the stripes: the coordinate of a point is `across.dot(point) + offset`, in
    /// stripes.
    across: Vector3<f64>,
    offset: f64,
    has_stripes: bool,
    /// Share of a surface's full light that remains without the sun.
    pub(crate) shade: f64,
}

impl Sunlight {
    /// The sunlight on a body with this pose in the world.
    pub(crate) fn on(sun: &SimulatedSun, world_from_body: &Isometry3<f64>) -> Self {
        let (elevation, azimuth) = (sun.elevation_deg.to_radians(), sun.azimuth_deg.to_radians());
        let towards = Vector3::new(
            elevation.cos() * azimuth.cos(),
            elevation.cos() * azimuth.sin(),
            elevation.sin(),
        );
        // Oblique stripes: neither vertical nor horizontal edges are parallel to them.
        let level = Vector3::new(-azimuth.sin(), azimuth.cos(), 0.0);
        let across = (level + towards.cross(&level)).normalize();
        let body_from_world = world_from_body.rotation.inverse();
        let per_metre = if sun.stripes_m > 0.0 { 1.0 / sun.stripes_m } else { 0.0 };
        Self {
            towards_sun: body_from_world * towards,
            across: body_from_world * across * per_metre,
            offset: across.dot(&world_from_body.translation.vector) * per_metre,
            has_stripes: sun.stripes_m > 0.0,
            shade: 1.0 / sun.ratio,
        }
    }
}

/// Minimum width of stripes, metres: narrower ones cannot be resolved in pictures.
const MIN_STRIPES_M: f64 = 0.005;

/// The first error in a configured sun, as text.
pub(crate) fn problem(sun: &SimulatedSun) -> Option<String> {
    let SimulatedSun { ratio, elevation_deg, azimuth_deg, stripes_m } = *sun;
    let rules = [
        ("ratio", ratio, (1.0..=100.0).contains(&ratio), "1 to 100"),
        ("elevation_deg", elevation_deg, (-90.0..=90.0).contains(&elevation_deg), "-90 to 90"),
        ("azimuth_deg", azimuth_deg, (-360.0..=360.0).contains(&azimuth_deg), "-360 to 360"),
        (
            "stripes_m",
            stripes_m,
            stripes_m == 0.0 || (MIN_STRIPES_M..=100.0).contains(&stripes_m),
            "0, or 0.005 to 100",
        ),
    ];
    let broken = rules.iter().find(|(_, _, holds, _)| !holds);
    broken.map(|(name, value, _, allowed)| format!("sun.{name} {value}: must be {allowed}"))
}

impl Sunlight {
    /// Share of full light that the sun adds to a surface with this normal; 0 in shade.
    pub(crate) fn added(&self, normal: &Vector3<f64>) -> f64 {
        (1.0 - self.shade) * normal.dot(&self.towards_sun).max(0.0)
    }

    /// The sunlit parts of a convex polygon.
    pub(crate) fn reaches(&self, corners: &[Point3<f64>]) -> Vec<Vec<Point3<f64>>> {
        if !self.has_stripes {
            return vec![corners.to_vec()];
        }
        let place = |point: &Point3<f64>| self.across.dot(&point.coords) + self.offset;
        let (low, high) = corners
            .iter()
            .map(place)
            .fold((f64::MAX, f64::MIN), |(low, high), at| (low.min(at), high.max(at)));
        // Each stripe: sun in its first half, shadow in the second.
        (low.floor() as i64..=high.floor() as i64)
            .map(|stripe| {
                let (from, to) = (stripe as f64, stripe as f64 + 0.5);
                let begun = clipped(corners, |point| place(point) - from);
                clipped(&begun, |point| to - place(point))
            })
            .filter(|part| part.len() >= 3)
            .collect()
    }
}

/// The part of a convex polygon where the linear function `inside` is not negative.
fn clipped(corners: &[Point3<f64>], inside: impl Fn(&Point3<f64>) -> f64) -> Vec<Point3<f64>> {
    let mut kept = Vec::with_capacity(corners.len() + 1);
    for (k, corner) in corners.iter().enumerate() {
        let next = &corners[(k + 1) % corners.len()];
        let (here, there) = (inside(corner), inside(next));
        if here >= 0.0 {
            kept.push(*corner);
        }
        if (here >= 0.0) != (there >= 0.0) {
            kept.push(corner + (next - corner) * (here / (here - there)));
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use proptest::prelude::*;

    const SUN: SimulatedSun =
        SimulatedSun { ratio: 4.0, elevation_deg: 15.0, azimuth_deg: 40.0, stripes_m: 0.03 };

    fn area(polygon: &[Point3<f64>]) -> f64 {
        let twice = (1..polygon.len() - 1)
            .map(|k| (polygon[k] - polygon[0]).cross(&(polygon[k + 1] - polygon[0])));
        twice.sum::<Vector3<f64>>().norm() / 2.0
    }

    fn square(side: f64) -> Vec<Point3<f64>> {
        let half = side / 2.0;
        [(-half, -half), (half, -half), (half, half), (-half, half)]
            .map(|(x, y)| Point3::new(0.3, x, y))
            .to_vec()
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]

        #[test]
        fn stripes_cover_half_of_what_is_much_wider_than_they_are(
            turn in prop::array::uniform3(-3.0..3.0f64),
            at in prop::array::uniform3(-2.0..2.0f64),
        ) {
            let pose = Isometry3::new(Vector3::from(at), Vector3::from(turn));
            let light = Sunlight::on(&SUN, &pose);
            let whole = square(2.0);
            let lit: f64 = light.reaches(&whole).iter().map(|part| area(part)).sum();
            // Unless it is seen along the stripes.
            let width = Vector3::new(0.0, light.across.y, light.across.z).norm();
            prop_assume!(width > 10.0);
            prop_assert!((lit / area(&whole) - 0.5).abs() < 0.06, "{lit}");
        }

        #[test]
        fn a_point_is_in_the_sun_wherever_the_body_is(
            turn in prop::array::uniform3(-3.0..3.0f64),
            at in prop::array::uniform3(-2.0..2.0f64),
        ) {
            // One square metre of the world, as part of bodies with different poses.
            let world = Sunlight::on(&SUN, &Isometry3::identity()).reaches(&square(0.2));
            let pose = Isometry3::new(Vector3::from(at), Vector3::from(turn));
            let there: Vec<_> =
                square(0.2).iter().map(|point| pose.inverse_transform_point(point)).collect();
            let parts = Sunlight::on(&SUN, &pose).reaches(&there);
            prop_assert_eq!(world.len(), parts.len());
            for (one, other) in world.iter().zip(&parts) {
                prop_assert!((area(one) - area(other)).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn a_side_that_faces_the_sun_has_the_ratio_of_one_that_does_not() {
        let light = Sunlight::on(&SUN, &Isometry3::identity());
        let towards = light.towards_sun;
        assert!((light.shade + light.added(&towards) - 1.0).abs() < 1e-12);
        assert!(light.added(&-towards) == 0.0 && (light.shade - 0.25).abs() < 1e-12);
    }

    #[test]
    fn suns_without_sense_are_refused() {
        assert_eq!(problem(&SUN), None);
        for sun in [
            SimulatedSun { ratio: 0.5, ..SUN },
            SimulatedSun { stripes_m: 1e-9, ..SUN },
            SimulatedSun { azimuth_deg: f64::NAN, ..SUN },
        ] {
            assert!(problem(&sun).unwrap().starts_with("sun."));
        }
    }
}
