//! Camera models: between pixels of the sphere image and rays.
//!
//! Every model is a [`Camera`], and whoever needs rays or pixels (rectification, masks, the search)
//! asks that one type. Rays are directions in the camera frame, from the camera's middle. Lenses
//! that sit beside the middle see a near thing elsewhere than a far one, so a camera with such
//! lenses is right for one distance at a time: [`Camera::at_distance`].

mod equirectangular;
mod error;
mod lens;
mod pair;
mod pixel;
mod stereographic;

use nalgebra::Vector3;

pub use self::equirectangular::Equirectangular;
use self::error::check_offset;
pub use self::error::{CameraError, MAX_OFFSET_M};
pub use self::lens::{Lens, LensCurve};
pub use self::pair::LensRay;
pub use self::pixel::SpherePixel;
pub use self::stereographic::Stereographic;
use crate::Ray;

/// A spherical camera: its model, the sides of its image, and the distance it is right for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    width: u32,
    height: u32,
    model: CameraModel,
    /// One over the distance that rays are right for, 1/m; 0: infinitely far.
    nearness: f64,
}

/// How an image shows the sphere.
#[derive(Debug, Clone, Copy, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "there is one camera, and it is copied seldom")]
pub enum CameraModel {
    /// Longitude along the rows, latitude along the columns. Stitched for things far away from two
    /// lenses that sit `lens_distance_m` apart on the camera's x axis, one looking ahead and one
    /// back; 0 for a camera with one centre.
    Equirectangular {
        /// Metres between the two lenses.
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

/// A distance is taken for at least this many times the lenses' offset from the middle.
const NEAREST_IN_OFFSETS: f64 = 2.0;

impl Camera {
    /// A camera that is right for things infinitely far away.
    ///
    /// # Errors
    /// Numbers that no camera has; see [`CameraError`].
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

    /// The equirectangular camera with one centre. Its sides are not looked at.
    pub const fn equirectangular(width: u32, height: u32) -> Self {
        let model = CameraModel::Equirectangular { lens_distance_m: 0.0 };
        Self { width, height, model, nearness: 0.0 }
    }

    /// Returns this camera, right for things `metres` away from its middle (infinity is allowed;
    /// less than twice the lenses' offset counts as that).
    pub fn at_distance(self, metres: f64) -> Self {
        let farthest = self.largest_offset_m();
        let least = NEAREST_IN_OFFSETS * farthest;
        // NaN is no distance, and keeps the one there was.
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

    /// One over the distance that rays are right for, 1/m.
    pub fn nearness(&self) -> f64 {
        self.nearness
    }

    /// The distance that rays are right for, metres; infinite where it does not matter.
    pub fn distance_m(&self) -> f64 {
        1.0 / self.nearness
    }

    /// The model if it is the equirectangular one with a single centre, or with its lenses' offset
    /// of no account.
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

    /// The ray that the point `pixel` sees; `None` outside the image circles. An equirectangular
    /// image goes round: any column has a ray.
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

    /// The point that sees `ray_in_camera`; `None` for rays that no image circle holds.
    ///
    /// Where both fisheye lenses see it, the one whose axis is nearer counts. Of the stitched
    /// camera with two lenses, neither sees the strip between them: there the point is the seam's.
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

    /// Pixels for each radian: along the equator of an equirectangular image, on the axis of a
    /// fisheye lens (the finer of two), in the middle of a stereographic plane.
    pub fn pixels_per_radian(&self) -> f64 {
        match &self.model {
            CameraModel::Equirectangular { .. } => self.sphere().pixels_per_radian(),
            CameraModel::DualFisheye([one, other]) => {
                one.pixels_per_radian().max(other.pixels_per_radian())
            }
            &CameraModel::Stereographic { field_rad } => self.plane(field_rad).radius_px,
        }
    }

    /// Farthest that a lens sits from the camera's middle, metres.
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

/// The direction from the camera's middle, at distance 1, of what a lens at `lens` (in units of
/// that distance) sees along `seen`: the intersection of that ray with the unit sphere.
fn from_middle(seen: &Ray, lens: &Vector3<f64>) -> Ray {
    let along = lens.dot(seen);
    let reach = (1.0 - lens.norm_squared() + along * along).sqrt() - along;
    Ray::new_normalize(lens + seen.into_inner() * reach)
}

#[cfg(test)]
mod tests;
