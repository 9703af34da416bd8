//! Views: square pinhole images cut from the sphere.

use nalgebra::{Rotation3, Unit, UnitQuaternion, Vector2, Vector3};

use crate::Ray;

/// A point of a view, pixels; (0, 0) is the *centre* of the first pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewPixel(pub Vector2<f64>);

impl ViewPixel {
    /// The point at column `u`, row `v`.
    pub fn new(u: f64, v: f64) -> Self {
        Self(Vector2::new(u, v))
    }
}

/// A square pinhole image: x right, y down, z forward, the principal point in the middle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// Rotation from the view's frame to the camera's.
    pub camera_from_view: UnitQuaternion<f64>,
    /// Focal length, pixels.
    pub focal_px: f64,
    /// Pixels along a side.
    pub size_px: u32,
}

impl View {
    /// A view along `direction_in_camera` whose sides span `field_rad`, upright: its x axis is
    /// level (at the zenith and the nadir, where no direction is up, it is the camera's -y).
    pub fn looking_at(direction_in_camera: &Ray, field_rad: f64, size_px: u32) -> Self {
        Self {
            camera_from_view: upright(direction_in_camera),
            focal_px: f64::from(size_px) / (2.0 * (field_rad / 2.0).tan()),
            size_px,
        }
    }

    /// Direction of the view's middle, in the camera frame.
    pub fn direction_in_camera(&self) -> Ray {
        self.camera_from_view * Vector3::z_axis()
    }

    /// Angle that the view's sides span, radians.
    pub fn field_rad(&self) -> f64 {
        2.0 * (f64::from(self.size_px) / (2.0 * self.focal_px)).atan()
    }

    /// The principal point's column (and row).
    pub fn centre_px(&self) -> f64 {
        (f64::from(self.size_px) - 1.0) / 2.0
    }

    /// Ray of `pixel`, in the camera frame.
    pub fn ray(&self, pixel: ViewPixel) -> Ray {
        let (x, y) = (pixel.0.x - self.centre_px(), pixel.0.y - self.centre_px());
        self.camera_from_view * Unit::new_normalize(Vector3::new(x, y, self.focal_px))
    }

    /// Point that shows `ray_in_camera`; `None` for rays behind the view. The point may lie outside
    /// the image.
    pub fn project(&self, ray_in_camera: &Ray) -> Option<ViewPixel> {
        let ray = self.camera_from_view.inverse() * ray_in_camera.into_inner();
        (ray.z > 1e-9).then(|| {
            let scale = self.focal_px / ray.z;
            ViewPixel::new(ray.x * scale + self.centre_px(), ray.y * scale + self.centre_px())
        })
    }

    /// Whether the image contains `ray_in_camera` at least `margin_px` inside its border.
    pub fn holds(&self, ray_in_camera: &Ray, margin_px: f64) -> bool {
        let last = f64::from(self.size_px) - 1.0 - margin_px;
        self.project(ray_in_camera).is_some_and(|ViewPixel(p)| {
            p.x >= margin_px && p.y >= margin_px && p.x <= last && p.y <= last
        })
    }
}

/// The rotation of an upright view along `direction_in_camera`.
fn upright(direction_in_camera: &Ray) -> UnitQuaternion<f64> {
    let axes = Rotation3::from_basis_unchecked(&upright_axes(direction_in_camera));
    UnitQuaternion::from_rotation_matrix(&axes)
}

/// The axes x, y and z of an upright view along `forward`, in the camera frame.
pub(crate) fn upright_axes(forward: &Vector3<f64>) -> [Vector3<f64>; 3] {
    let level = forward.cross(&Vector3::z());
    let right = if level.norm() > 1e-6 { level.normalize() } else { -Vector3::y() };
    [right, forward.cross(&right), *forward]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn an_upright_view_has_left_on_its_left() {
        let view = View::looking_at(&Vector3::x_axis(), 1.0, 101);
        let left = view.project(&Unit::new_normalize(Vector3::new(1.0, 0.1, 0.0))).expect("ahead");
        assert!(left.0.x < view.centre_px() && (left.0.y - view.centre_px()).abs() < 1e-9);
        let up = view.project(&Unit::new_normalize(Vector3::new(1.0, 0.0, 0.1))).expect("ahead");
        assert!(up.0.y < view.centre_px() && (up.0.x - view.centre_px()).abs() < 1e-9);
    }

    fn direction() -> impl Strategy<Value = Ray> {
        (-1.0..1.0f64, -1.0..1.0f64, -1.0..1.0f64)
            .prop_filter("too short", |(x, y, z)| x * x + y * y + z * z > 1e-2)
            .prop_map(|(x, y, z)| Unit::new_normalize(Vector3::new(x, y, z)))
    }

    proptest! {
        #[test]
        fn pixels_come_back(at in direction(), field in 0.05..2.0f64, u in 0.0..500.0f64, v in 0.0..500.0f64) {
            let view = View::looking_at(&at, field, 501);
            let back = view.project(&view.ray(ViewPixel::new(u, v))).expect("ahead");
            prop_assert!((back.0 - Vector2::new(u, v)).norm() < 1e-6);
            prop_assert!((view.field_rad() - field).abs() < 1e-9);
        }

        #[test]
        fn the_middle_looks_where_it_was_told(at in direction()) {
            let view = View::looking_at(&at, 1.0, 64);
            prop_assert!(view.direction_in_camera().angle(&at) < 1e-7);
        }
    }
}
