//! Whether four corners are those of a square.
//!
//! The view gives the direction of each corner. A tilted square is narrower at its far side, by an
//! amount that follows from its apparent size. A shelf or a crack that reads as a marker may have
//! any shape.

use std::sync::LazyLock;

use flockeye_geometry::Ray;
use flockeye_geometry::filter::chi_square_quantile;
use flockeye_geometry::pose::squared_distance_from_square;

/// Gate for the squared distance from a square's corners: 99.9 % of all right corners stay below.
static MAX_SQUARED_DISTANCE: LazyLock<f64> = LazyLock::new(|| chi_square_quantile(2.0, 0.999));

/// Standard deviation of a marker's corners from those of a square along either axis, as a share of
/// its side. Paper bends, and the lens that took a photograph is not known.
/// docs/results/constants.md#shape-of-squares has the curve.
const UNEVEN_SHARE: f64 = 0.05;

/// Whether corners along these rays may belong to a square. Each ray has a standard deviation
/// across itself, radians.
pub(crate) fn is_square(rays: &[Ray; 4], deviations_rad: &[f64; 4]) -> bool {
    let side_rad = (0..4).map(|k| rays[k].angle(&rays[(k + 1) % 4])).sum::<f64>() / 4.0;
    let deviations_rad = deviations_rad.map(|deviation| deviation.hypot(UNEVEN_SHARE * side_rad));
    squared_distance_from_square(rays, &deviations_rad)
        .is_some_and(|squared| squared <= *MAX_SQUARED_DISTANCE)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use flockeye_geometry::view::{View, ViewPixel};
    use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
    use proptest::prelude::*;

    fn view() -> View {
        View::looking_at(&Vector3::x_axis(), 1.2, 900)
    }

    /// Whether corners at these pixels may be a square's, where each is known to so many pixels.
    fn is_square_in_view(corners: [[f64; 2]; 4], sigma_px: f64) -> bool {
        let rays = corners.map(|[x, y]| view().ray(ViewPixel::new(x, y)));
        is_square(&rays, &[sigma_px / view().focal_px; 4])
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..Default::default() })]

        #[test]
        fn a_square_seen_from_anywhere_is_one(
            range in 1.5..60.0f64,
            at in prop::array::uniform2(-0.3..0.3f64),
            tilt in 0.0..1.3f64,
            (around, turn) in (-3.2..3.2f64, -3.2..3.2f64),
            noise in prop::array::uniform8(-1.0..1.0f64),
        ) {
            // The square's z axis points at the camera before it is tilted.
            let facing = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), -std::f64::consts::FRAC_PI_2);
            let turned = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), turn);
            let axis = Vector3::new(0.0, around.cos(), around.sin()) * tilt;
            let rotation = UnitQuaternion::from_scaled_axis(axis) * facing * turned;
            let middle = Vector3::new(1.0, at[0], at[1]) * range;
            // Edge on, a square is a line.
            prop_assume!((rotation * Vector3::z()).dot(&middle.normalize()) < -0.2);
            let pose = Isometry3::from_parts(middle.into(), rotation);
            let corners = [[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]];
            let seen = corners.map(|[x, y]| Ray::new_normalize((pose * Point3::new(x, y, 0.0)).coords));
            let pixels: [[f64; 2]; 4] = std::array::from_fn(|k| {
                let pixel = view().project(&seen[k]).unwrap().0;
                [pixel.x + 0.1 * noise[2 * k], pixel.y + 0.1 * noise[2 * k + 1]]
            });
            prop_assert!(is_square_in_view(pixels, 0.1), "{pixels:?}");
        }
    }

    #[test]
    fn a_wide_rectangle_is_no_tilted_square() {
        // So large a square would be tilted by 70 degrees, and one side much longer than the other.
        let large = [[200.0, 380.0], [626.0, 380.0], [626.0, 530.0], [200.0, 530.0]];
        assert!(!is_square_in_view(large, 0.1));
        // Far away a tilted square is nearly a parallelogram.
        let small = [[400.0, 440.0], [428.0, 440.0], [428.0, 450.0], [400.0, 450.0]];
        assert!(is_square_in_view(small, 0.1));
    }

    #[test]
    fn a_small_quadrilateral_of_any_shape_is_no_square() {
        let kite = [[400.0, 400.0], [420.0, 398.0], [425.0, 425.0], [405.0, 410.0]];
        assert!(!is_square_in_view(kite, 0.1));
        // Where its corners may lie anywhere, they may be a square's.
        assert!(is_square_in_view(kite, 8.0));
    }

    #[test]
    fn corners_on_a_line_are_no_square() {
        let line = [[400.0, 400.0], [410.0, 400.0], [420.0, 400.0], [430.0, 400.0]];
        assert!(!is_square_in_view(line, 0.1));
    }
}
