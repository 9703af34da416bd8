//! Pixel density of an image: pixels per radian near a direction.

use nalgebra::{Matrix2x3, Rotation3, Vector3};

use crate::moment::Placement;

/// Pixels per small change of direction, near one direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Density {
    /// Isotropic density, pixels per radian.
    Even(f64),
    /// Jacobian of columns and rows by a unit vector in the camera frame.
    Local(Matrix2x3<f64>),
}

/// A body in the image part of one eye.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct BodySight {
    /// Placement of the body relative to the eye.
    pub placement: Placement,
    /// Pixel density of the image there.
    pub density: Density,
}

/// Upper triangular matrix from two perpendicular small angles to pixels. An offset of (x, y)
/// radians is (x `along` + y `shear`, y `across`) pixels. The rows of that image are along the
/// first axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Stretch {
    /// Pixels per radian along the first axis.
    pub along: f64,
    /// Pixels along the row per radian along the second axis.
    pub shear: f64,
    /// Pixels across the row per radian along the second axis.
    pub across: f64,
}

impl Density {
    /// The stretch for two perpendicular unit tangents at the direction of the density.
    pub(crate) fn stretch(&self, axes: [Vector3<f64>; 2]) -> Stretch {
        match self {
            &Self::Even(focal) => Stretch { along: focal, shear: 0.0, across: focal },
            Self::Local(pixels) => {
                let [first, second] = axes.map(|axis| pixels * axis);
                let along = first.norm();
                Stretch {
                    along,
                    shear: first.dot(&second) / along,
                    // The sign is dropped: a mirrored image has the same blur.
                    across: first.perp(&second).abs() / along,
                }
            }
        }
    }

    /// The density near `direction`: the density near `measured`, rotated to it.
    pub(crate) fn moved(&self, direction: &Vector3<f64>, measured: &Vector3<f64>) -> Self {
        match self {
            Self::Even(focal) => Self::Even(*focal),
            Self::Local(pixels) => {
                let turn = Rotation3::rotation_between(direction, measured);
                Self::Local(pixels * turn.unwrap_or_else(Rotation3::identity))
            }
        }
    }

    /// Length of a body's motion during the exposure, pixels.
    pub(crate) fn motion_px(&self, placement: &Placement, exposure_s: f64) -> f64 {
        match self {
            Self::Even(focal) => placement.angular_speed() * exposure_s * focal,
            Self::Local(pixels) => {
                let at = placement.position();
                let velocity = placement.velocity_in_camera;
                let sideways = velocity - at * (at.dot(&velocity) / at.norm_squared());
                (pixels * sideways).norm() / at.norm() * exposure_s
            }
        }
    }

    /// Pixels per radian: square root of the pixels per steradian.
    pub(crate) fn pixels_per_radian(&self) -> f64 {
        match self {
            Self::Even(focal) => *focal,
            Self::Local(pixels) => {
                let [columns, rows] = [0, 1].map(|row| pixels.row(row).transpose());
                columns.cross(&rows).norm().sqrt()
            }
        }
    }
}

impl Stretch {
    /// The stretch multiplied by `scale`.
    pub(crate) fn scaled(&self, scale: f64) -> Self {
        Self { along: self.along * scale, shear: self.shear * scale, across: self.across * scale }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use super::*;

    #[test]
    fn lengths_and_areas_are_kept_by_any_axes() {
        // Tangents at +z.
        let pixels = Matrix2x3::new(300.0, 40.0, 0.0, -20.0, -500.0, 0.0);
        let density = Density::Local(pixels);
        let area = 300.0 * 500.0 - 40.0 * 20.0;
        assert!((density.pixels_per_radian().powi(2) - area).abs() < 1e-6);
        for turn in [0.0, 0.4, 1.9, -2.6] {
            let rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), turn);
            let axes = [rotation * Vector3::x(), rotation * Vector3::y()];
            let Stretch { along, shear, across } = density.stretch(axes);
            assert!((along * across - area).abs() < 1e-6);
            for (x, y) in [(0.3, 0.1), (-0.2, 0.5)] {
                let length = (pixels * (axes[0] * x + axes[1] * y)).norm();
                assert!(((x * along + y * shear).hypot(y * across) - length).abs() < 1e-9);
            }
        }
    }
}
