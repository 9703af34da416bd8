//! One fisheye lens with its image circle.

use std::f64::consts::PI;

use nalgebra::{Isometry3, Matrix2, Unit, Vector2, Vector3};

use super::error::{CameraError, check_offset};
use super::pixel::SpherePixel;
use crate::Ray;

/// A fisheye lens. Its own frame is x right and y down in the image, z along its axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lens {
    /// Position (metres) and rotation of the lens in the camera.
    pub camera_from_lens: Isometry3<f64>,
    /// Point where the axis meets the image, pixels: also the middle of the image circle.
    pub centre_px: Vector2<f64>,
    /// Radius of the image circle, pixels. The lens shows nothing beyond it.
    pub circle_px: f64,
    /// Angle across the used field, radians. Pixels beyond it are ignored.
    pub field_rad: f64,
    /// Focal lengths along the image's rows and columns, pixels.
    pub focal_px: Vector2<f64>,
    /// Growth of the distance from the image's centre with the angle from the axis.
    pub curve: LensCurve,
}

/// The distance from the centre, in focal lengths, of a direction theta radians off the axis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum LensCurve {
    /// theta + k1 theta^3 + k2 theta^5 + k3 theta^7 + k4 theta^9 (Kannala and Brandt: *A generic
    /// camera model and calibration method*, 2006; OpenCV's `fisheye`, Kalibr's `equidistant`).
    /// With four zeros, the equidistant lens.
    Equidistant([f64; 4]),
    /// sin / (alpha d + (1 - alpha)(xi + cos)), d^2 = sin^2 + (xi + cos)^2 (Usenko, Demmel and
    /// Cremers: *The Double Sphere Camera Model*, 2018; Kalibr's `ds`).
    DoubleSphere {
        /// Distance between the two spheres.
        xi: f64,
        /// Between the second sphere and the pinhole.
        alpha: f64,
    },
    /// sin / (xi + cos), then a pinhole's distortion (Mei and Rives: *Single View Point
    /// Omnidirectional Camera Calibration from Planar Grids*, 2007; Kalibr's `omni-radtan`,
    /// camodocal's `MEI`).
    Unified {
        /// Distance between the sphere's middle and the pinhole.
        xi: f64,
        /// OpenCV's k1, k2 (radial), p1 and p2 (tangential).
        distortion: [f64; 4],
    },
}

/// Number of angles at which a curve is checked to rise.
const CHECKS: u32 = 512;

impl Lens {
    /// An equidistant lens: `field_rad` fills the circle.
    pub fn equidistant(
        camera_from_lens: Isometry3<f64>,
        centre_px: Vector2<f64>,
        circle_px: f64,
        field_rad: f64,
    ) -> Self {
        let focal_px = Vector2::repeat(2.0 * circle_px / field_rad);
        let curve = LensCurve::Equidistant([0.0; 4]);
        Self { camera_from_lens, centre_px, circle_px, field_rad, focal_px, curve }
    }

    /// Whether `pixel` lies in the image circle.
    pub fn holds(&self, pixel: SpherePixel) -> bool {
        (pixel.0 - self.centre_px).norm() <= self.circle_px
    }

    /// Ray of `pixel`, in the lens' frame; `None` beyond the field or the end of the curve.
    pub fn ray(&self, pixel: SpherePixel) -> Option<Ray> {
        let mut plane = (pixel.0 - self.centre_px).component_div(&self.focal_px);
        if let LensCurve::Unified { distortion, .. } = &self.curve {
            plane = undistorted(plane, distortion)?;
        }
        let (angle_sin, angle_cos) = self.curve.undo(plane.norm(), self.field_rad / 2.0)?;
        let across = plane.try_normalize(0.0).unwrap_or_else(Vector2::x) * angle_sin;
        // A sine and a cosine make a unit vector, to rounding.
        Some(Unit::new_normalize(Vector3::new(across.x, across.y, angle_cos)))
    }

    /// Point that shows `direction` (in the lens' frame, of any length); `None` outside the field
    /// and the circle.
    pub fn project(&self, direction: &Vector3<f64>) -> Option<SpherePixel> {
        let across = direction.xy();
        let off_axis = across.norm();
        let angle = off_axis.atan2(direction.z);
        if angle > self.field_rad / 2.0 {
            return None;
        }
        let distance = self.curve.distance(angle);
        let scale = if off_axis > 0.0 { distance / off_axis } else { 0.0 };
        let mut plane = across * scale;
        if let LensCurve::Unified { distortion, .. } = &self.curve {
            plane = distorted(plane, distortion);
        }
        let pixel = SpherePixel(self.centre_px + plane.component_mul(&self.focal_px));
        self.holds(pixel).then_some(pixel)
    }

    /// Pixels for each radian on the axis.
    pub fn pixels_per_radian(&self) -> f64 {
        let focal = (self.focal_px.x + self.focal_px.y) / 2.0;
        match self.curve {
            LensCurve::Equidistant(_) => focal,
            LensCurve::DoubleSphere { xi, .. } | LensCurve::Unified { xi, .. } => {
                focal / (1.0 + xi)
            }
        }
    }

    /// Distance of the lens from the camera's middle, metres.
    pub fn offset_m(&self) -> f64 {
        self.camera_from_lens.translation.vector.norm()
    }

    fn check(&self, lens: usize) -> Result<(), CameraError> {
        let number = |what, value: f64, is_allowed: bool, must| {
            if is_allowed { Ok(()) } else { Err(CameraError::Lens { lens, what, value, must }) }
        };
        // Comparisons with NaN are false, so NaN is refused too.
        for focal in [self.focal_px.x, self.focal_px.y] {
            let is_allowed = (1.0..=1e5).contains(&focal);
            number("its focal length in pixels", focal, is_allowed, "between 1 and 100000")?;
        }
        let circle = self.circle_px;
        number("its circle's radius in pixels", circle, circle >= 1.0, "1 or more")?;
        let field_deg = self.field_rad.to_degrees();
        let is_field = (10.0..=300.0).contains(&field_deg);
        number("its field in degrees", field_deg, is_field, "between 10 and 300")?;
        if let LensCurve::DoubleSphere { xi, alpha } = self.curve {
            number("alpha", alpha, (0.0..=1.0).contains(&alpha), "between 0 and 1")?;
            number("xi", xi, (-0.99..=10.0).contains(&xi), "between -0.99 and 10")?;
        }
        if let LensCurve::Unified { xi, distortion } = self.curve {
            number("xi", xi, (0.0..=20.0).contains(&xi), "between 0 and 20")?;
            for k in distortion {
                number("its distortion", k, k.abs() <= 100.0, "between -100 and 100")?;
            }
        }
        check_offset(self.offset_m())?;
        self.curve.check(lens, self.field_rad)
    }
}

impl LensCurve {
    /// Distance from the centre, in focal lengths, `angle` radians off the axis; before the
    /// distortion of the unified model.
    #[inline]
    pub fn distance(&self, angle: f64) -> f64 {
        match *self {
            Self::Equidistant([k1, k2, k3, k4]) => {
                let square = angle * angle;
                angle * (1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
            }
            Self::DoubleSphere { xi, alpha } => {
                let (sin, cos) = angle.sin_cos();
                sin / (alpha * sin.hypot(xi + cos) + (1.0 - alpha) * (xi + cos))
            }
            Self::Unified { xi, .. } => {
                let (sin, cos) = angle.sin_cos();
                sin / (xi + cos)
            }
        }
    }

    /// Sine and cosine of the angle off the axis, at most `half_field` radians, whose distance
    /// from the centre is `distance` focal lengths.
    fn undo(&self, distance: f64, half_field: f64) -> Option<(f64, f64)> {
        // The last angle of the field must be found in spite of rounding.
        let farthest = half_field * (1.0 + 1e-12);
        match *self {
            Self::Equidistant(_) => {
                let angle = self.newton(distance, farthest)?;
                Some(angle.sin_cos())
            }
            Self::DoubleSphere { xi, alpha } => {
                let square = distance * distance;
                let root = (1.0 - (2.0 * alpha - 1.0) * square).sqrt();
                let ahead = (1.0 - alpha * alpha * square) / (alpha * root + 1.0 - alpha);
                let factor = (ahead * xi + (ahead * ahead + (1.0 - xi * xi) * square).sqrt())
                    / (ahead * ahead + square);
                let (sin, cos) = (factor * distance, factor * ahead - xi);
                // A NaN lies beyond the curve's end.
                (sin.atan2(cos) <= farthest).then_some((sin, cos))
            }
            Self::Unified { xi, .. } => {
                let square = distance * distance;
                let ahead = (xi + (1.0 + (1.0 - xi * xi) * square).sqrt()) / (1.0 + square);
                let (sin, cos) = (ahead * distance, ahead - xi);
                (sin.atan2(cos) <= farthest).then_some((sin, cos))
            }
        }
    }

    /// The angle from 0 to `farthest` at `distance`, by Newton's method kept between bounds.
    fn newton(&self, distance: f64, farthest: f64) -> Option<f64> {
        if distance > self.distance(farthest) {
            return None;
        }
        let (mut low, mut high) = (0.0, farthest);
        let mut angle = distance.min(farthest);
        for _ in 0..100 {
            let excess = self.distance(angle) - distance;
            if excess > 0.0 {
                high = angle
            } else {
                low = angle
            }
            let step = angle - excess / self.slope(angle);
            let next = if (low..=high).contains(&step) { step } else { (low + high) / 2.0 };
            if (next - angle).abs() <= 1e-15 * (1.0 + angle) {
                return Some(next);
            }
            angle = next;
        }
        Some(angle)
    }

    /// Growth of the distance per radian.
    fn slope(&self, angle: f64) -> f64 {
        match *self {
            Self::Equidistant([k1, k2, k3, k4]) => {
                let square = angle * angle;
                1.0 + square
                    * (3.0 * k1 + square * (5.0 * k2 + square * (7.0 * k3 + square * 9.0 * k4)))
            }
            Self::DoubleSphere { .. } | Self::Unified { .. } => {
                let step = 1e-6;
                let far = |angle| match self {
                    Self::Unified { distortion: [k1, k2, ..], .. } => {
                        let plain = self.distance(angle);
                        let square = plain * plain;
                        plain * (1.0 + square * (k1 + square * k2))
                    }
                    _ => self.distance(angle),
                };
                (far(angle + step) - far(angle - step)) / (2.0 * step)
            }
        }
    }

    /// Refuses a curve that does not rise all over the field.
    fn check(&self, lens: usize, field_rad: f64) -> Result<(), CameraError> {
        let angle = |k: u32| field_rad / 2.0 * f64::from(k) / f64::from(CHECKS);
        let is_sound = |angle: f64| {
            let (slope, distance) = (self.slope(angle), self.distance(angle));
            slope > 1e-6 && slope.is_finite() && (0.0..1e3).contains(&distance)
        };
        match (0..=CHECKS).map(angle).find(|&angle| !is_sound(angle)) {
            None => Ok(()),
            Some(angle) => Err(CameraError::Curve {
                lens,
                angle_deg: angle * 180.0 / PI,
                field_deg: field_rad * 180.0 / PI,
            }),
        }
    }
}

/// A pinhole's point with OpenCV's radial and tangential distortion.
fn distorted(plane: Vector2<f64>, [k1, k2, p1, p2]: &[f64; 4]) -> Vector2<f64> {
    let (x, y) = (plane.x, plane.y);
    let square = x * x + y * y;
    let radial = 1.0 + square * (k1 + square * k2);
    Vector2::new(
        x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
        y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
    )
}

/// Point that [`distorted`] maps to `plane`, by Newton's method; `None` where there is none.
fn undistorted(plane: Vector2<f64>, distortion: &[f64; 4]) -> Option<Vector2<f64>> {
    let [k1, k2, p1, p2] = distortion;
    let mut point = plane;
    for _ in 0..50 {
        let (x, y) = (point.x, point.y);
        let square = x * x + y * y;
        let radial = 1.0 + square * (k1 + square * k2);
        // Derivative of the radial factor by the square.
        let growth = k1 + 2.0 * k2 * square;
        let across = 2.0 * x * y * growth + 2.0 * p1 * x + 2.0 * p2 * y;
        let jacobian = Matrix2::new(
            radial + 2.0 * x * x * growth + 2.0 * p1 * y + 6.0 * p2 * x,
            across,
            across,
            radial + 2.0 * y * y * growth + 6.0 * p1 * y + 2.0 * p2 * x,
        );
        let step = jacobian.try_inverse()? * (distorted(point, distortion) - plane);
        point -= step;
        if step.norm() <= 1e-15 * (1.0 + point.norm()) {
            return Some(point);
        }
    }
    ((distorted(point, distortion) - plane).norm() < 1e-12).then_some(point)
}

/// Refuses lenses with impossible values, and circles that leave the image or overlap.
pub(super) fn check_pair(lenses: &[Lens; 2], width: u32, height: u32) -> Result<(), CameraError> {
    for (index, lens) in lenses.iter().enumerate() {
        lens.check(index)?;
        let reaches = |centre: f64, side: u32| {
            // The outermost pixels extend half a pixel beyond their centres on either side.
            let (low, high) = (-0.5, f64::from(side) - 0.5);
            centre - lens.circle_px >= low && centre + lens.circle_px <= high
        };
        if !reaches(lens.centre_px.x, width) || !reaches(lens.centre_px.y, height) {
            return Err(CameraError::CircleOutside {
                lens: index,
                radius_px: lens.circle_px,
                u: lens.centre_px.x,
                v: lens.centre_px.y,
                width,
                height,
            });
        }
    }
    let [one, other] = lenses;
    let apart = (one.centre_px - other.centre_px).norm();
    let overlap_px = one.circle_px + other.circle_px - apart;
    if overlap_px > 0.0 {
        return Err(CameraError::CirclesOverlap { overlap_px });
    }
    Ok(())
}
