//! Camera models: between pixels of the sphere image and rays.
//!
//! Every model is a [`Camera`]. Rectification, masks and the search get rays and pixels from this
//! one type. Rays are directions in the camera frame, from the camera's middle. A lens beside the
//! middle sees near and far objects in different directions. So a camera with such lenses is exact
//! for one distance at a time: [`Camera::at_distance`].

mod equirectangular;
mod error;
mod lens;
mod pair;
mod pixel;
mod stereographic;
mod stitch;

use nalgebra::Vector3;

pub use self::equirectangular::Equirectangular;
use self::error::check_offset;
pub use self::error::{CameraError, MAX_OFFSET_M};
pub use self::lens::{Lens, LensCurve};
pub use self::pair::LensRay;
pub use self::pixel::SpherePixel;
pub use self::stereographic::Stereographic;
pub use self::stitch::{Half, ShownBy, Stitch};
use crate::Ray;

/// A spherical camera: its model, the sides of its image, and the distance for which it is exact.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    width: u32,
    height: u32,
    model: CameraModel,
    /// Inverse of the distance for which rays are exact, 1/m; 0 is infinity.
    nearness: f64,
}

/// Projection of the sphere to an image.
#[derive(Debug, Clone, Copy, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "there is one camera, and it is copied seldom")]
pub enum CameraModel {
    /// Longitude along the rows, latitude along the columns. The image is stitched for distant
    /// objects from two lenses on the camera's x axis, `lens_distance_m` apart. One lens looks
    /// ahead, the other back. The distance is 0 for a camera with one centre.
    Equirectangular {
        /// Distance between the two lenses, metres.
        lens_distance_m: f64,
    },
    /// Two fisheye lenses, each with its image circle.
    DualFisheye([Lens; 2]),
    /// The paper's plane: stereographic about the camera's x axis.
    Stereographic {
        /// Angle across the image circle, which touches the image's nearer borders; radians, less
        /// than a full turn.
        field_rad: f64,
    },
}

/// Least distance of an object, in offsets of the lenses from the middle. Smaller values are raised
/// to this.
const NEAREST_IN_OFFSETS: f64 = 2.0;

impl Camera {
    /// Creates a camera that is exact for objects at infinity.
    ///
    /// # Errors
    /// Values that no camera has; see [`CameraError`].
    pub fn new(width: u32, height: u32, model: CameraModel) -> Result<Self, CameraError> {
        if width < 2 || height < 2 {
            return Err(CameraError::Sides { width, height });
        }
        match &model {
            CameraModel::Equirectangular { lens_distance_m } => {
                check_offset(lens_distance_m / 2.0)?;
            }
            CameraModel::DualFisheye(lenses) => lens::check_pair(lenses, width, height)?,
            &CameraModel::Stereographic { field_rad } => {
                if !(1.0..=350.0).contains(&field_rad.to_degrees()) {
                    return Err(CameraError::Field { field_rad });
                }
            }
        }
        Ok(Self { width, height, model, nearness: 0.0 })
    }

    /// Creates the equirectangular camera with one centre, without a check of its sides.
    pub const fn equirectangular(width: u32, height: u32) -> Self {
        let model = CameraModel::Equirectangular { lens_distance_m: 0.0 };
        Self { width, height, model, nearness: 0.0 }
    }

    /// Returns this camera, exact for objects `metres` away from its middle. Infinity is allowed.
    /// Less than twice the lenses' offset counts as twice the offset.
    pub fn at_distance(self, metres: f64) -> Self {
        let farthest = self.largest_offset_m();
        let least = NEAREST_IN_OFFSETS * farthest;
        // NaN is no distance, so the previous one stays.
        let nearness = match metres {
            _ if farthest == 0.0 => 0.0,
            metres if metres.is_nan() => self.nearness,
            metres => 1.0 / metres.max(least),
        };
        Self { nearness, ..self }
    }

    /// Columns of the image.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Rows of the image.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// The model.
    pub fn model(&self) -> &CameraModel {
        &self.model
    }

    /// Inverse of the distance for which rays are exact, 1/m.
    pub fn nearness(&self) -> f64 {
        self.nearness
    }

    /// Distance for which rays are exact, metres; infinite where the distance does not matter.
    pub fn distance_m(&self) -> f64 {
        1.0 / self.nearness
    }

    /// Returns the model if it is equirectangular and the offset of its lenses does not matter.
    pub fn as_equirectangular(&self) -> Option<Equirectangular> {
        let is_plain = match self.model {
            CameraModel::Equirectangular { lens_distance_m } => {
                lens_distance_m == 0.0 || self.nearness == 0.0
            }
            _ => false,
        };
        is_plain.then_some(self.sphere())
    }

    /// The equirectangular image of these sides.
    pub(crate) fn sphere(&self) -> Equirectangular {
        Equirectangular { width: self.width, height: self.height }
    }

    /// The stereographic plane of this image with this field.
    pub(crate) fn plane(&self, field_rad: f64) -> Stereographic {
        Stereographic::new(self.width, self.height, field_rad)
    }

    /// Returns the ray of the point `pixel`; `None` outside the image circles. An equirectangular
    /// image wraps around, so any column has a ray.
    pub fn ray(&self, pixel: SpherePixel) -> Option<Ray> {
        match &self.model {
            &CameraModel::Equirectangular { lens_distance_m } => {
                let seen = self.sphere().ray(pixel);
                let side = if seen.x >= 0.0 { 0.5 } else { -0.5 };
                let lens = Vector3::x() * (side * lens_distance_m * self.nearness);
                Some(from_middle(&seen, &lens))
            }
            CameraModel::DualFisheye(lenses) => {
                let lens = lenses.iter().find(|lens| lens.holds(pixel))?;
                let seen = lens.camera_from_lens.rotation * lens.ray(pixel)?;
                let position = lens.camera_from_lens.translation.vector;
                Some(from_middle(&seen, &(position * self.nearness)))
            }
            &CameraModel::Stereographic { field_rad } => self.plane(field_rad).ray(pixel),
        }
    }

    /// Returns the point that shows `ray_in_camera`; `None` for rays outside every image circle.
    ///
    /// Where both fisheye lenses see the ray, the lens with the nearer axis counts. In the stitched
    /// camera with two lenses, neither lens sees the strip between them. The point is on the seam
    /// there.
    pub fn project(&self, ray_in_camera: &Ray) -> Option<SpherePixel> {
        match &self.model {
            &CameraModel::Equirectangular { lens_distance_m } => {
                let sphere = self.sphere();
                let offset = 0.5 * lens_distance_m * self.nearness;
                if offset == 0.0 {
                    return Some(sphere.project(ray_in_camera));
                }
                let mut seen = ray_in_camera.into_inner();
                seen.x = match seen.x {
                    x if x >= 0.0 => (x - offset).max(0.0),
                    // The value stays below 0, which is the front lens' side of the seam.
                    x => (x + offset).min(-f64::MIN_POSITIVE),
                };
                Some(sphere.project(&Ray::new_normalize(seen)))
            }
            CameraModel::DualFisheye(lenses) => {
                let seen = lenses.each_ref().map(|lens| {
                    let position = lens.camera_from_lens.translation.vector;
                    let direction = ray_in_camera.into_inner() - position * self.nearness;
                    lens.camera_from_lens.rotation.inverse() * direction
                });
                let nearness_to_axis = |k: usize| seen[k].z / seen[k].norm();
                let first = usize::from(nearness_to_axis(1) > nearness_to_axis(0));
                let project = |k: usize| lenses[k].project(&seen[k]);
                project(first).or_else(|| project(1 - first))
            }
            &CameraModel::Stereographic { field_rad } => {
                self.plane(field_rad).project(ray_in_camera)
            }
        }
    }

    /// Pixels per radian: along the equator of an equirectangular image, on the axis of a fisheye
    /// lens (the finer of two), in the middle of a stereographic plane.
    pub fn pixels_per_radian(&self) -> f64 {
        match &self.model {
            CameraModel::Equirectangular { .. } => self.sphere().pixels_per_radian(),
            CameraModel::DualFisheye([one, other]) => {
                one.pixels_per_radian().max(other.pixels_per_radian())
            }
            &CameraModel::Stereographic { field_rad } => self.plane(field_rad).radius_px,
        }
    }

    /// Largest distance of a lens from the camera's middle, metres.
    fn largest_offset_m(&self) -> f64 {
        match &self.model {
            CameraModel::Equirectangular { lens_distance_m } => lens_distance_m / 2.0,
            CameraModel::DualFisheye(lenses) => {
                lenses.iter().map(Lens::offset_m).fold(0.0, f64::max)
            }
            CameraModel::Stereographic { .. } => 0.0,
        }
    }
}

/// Direction from the camera's middle to an object at distance 1 that the lens at `lens` sees along
/// `seen`. It is the intersection of that ray with the unit sphere. `lens` is in units of that
/// distance.
fn from_middle(seen: &Ray, lens: &Vector3<f64>) -> Ray {
    let along = lens.dot(seen);
    let reach = (1.0 - lens.norm_squared() + along * along).sqrt() - along;
    Ray::new_normalize(lens + seen.into_inner() * reach)
}

#[cfg(test)]
mod tests;
