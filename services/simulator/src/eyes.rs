//! Viewpoints of a camera: its centre, or the positions of its lenses.

use flockeye_geometry::Ray;
use flockeye_geometry::camera::{Camera, CameraModel, Lens, SpherePixel};
use nalgebra::Vector3;

/// A viewpoint of the image or of a part of it.
///
/// Directions start at the viewpoint and are along the camera's axes. So near objects have parallax
/// between eyes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Eye {
    /// Position in the camera frame, metres.
    pub(crate) position_m: Vector3<f64>,
    /// Index of the connected picture that it contributes to. The halves of a stitched image form
    /// one picture; each image circle is one.
    pub(crate) picture: usize,
    part: ImagePart,
}

/// The part of the image that belongs to an eye.
#[derive(Debug, Clone, Copy)]
enum ImagePart {
    Whole(Camera),
    /// The front half (x >= 0) or the rear half of a stitched image.
    Half {
        camera: Camera,
        is_ahead: bool,
    },
    Circle(Lens),
}

impl Eye {
    /// The eyes of a camera: one, or one per lens.
    pub(crate) fn all(camera: &Camera) -> Vec<Self> {
        // Directions of a lens alone are those of objects at infinity.
        let camera = camera.at_distance(f64::INFINITY);
        let eye = |position_m, picture, part| Self { position_m, picture, part };
        match *camera.model() {
            CameraModel::Equirectangular { lens_distance_m } if lens_distance_m > 0.0 => {
                [(0.5, true), (-0.5, false)]
                    .map(|(side, is_ahead)| {
                        let position_m = Vector3::x() * (side * lens_distance_m);
                        eye(position_m, 0, ImagePart::Half { camera, is_ahead })
                    })
                    .into()
            }
            CameraModel::DualFisheye(lenses) => (0..)
                .zip(lenses)
                .map(|(k, lens)| {
                    eye(lens.camera_from_lens.translation.vector, k, ImagePart::Circle(lens))
                })
                .collect(),
            CameraModel::Equirectangular { .. } | CameraModel::Stereographic { .. } => {
                vec![eye(Vector3::zeros(), 0, ImagePart::Whole(camera))]
            }
        }
    }

    /// The direction of `pixel`; `None` for a pixel of another eye.
    pub(crate) fn ray(&self, pixel: SpherePixel) -> Option<Ray> {
        match &self.part {
            ImagePart::Whole(camera) => camera.ray(pixel),
            ImagePart::Half { camera, is_ahead } => {
                camera.ray(pixel).filter(|ray| (ray.x >= 0.0) == *is_ahead)
            }
            ImagePart::Circle(lens) if lens.holds(pixel) => {
                lens.ray(pixel).map(|ray| lens.camera_from_lens.rotation * ray)
            }
            ImagePart::Circle(_) => None,
        }
    }

    /// The pixel of `direction`; `None` for a direction outside this eye's part.
    pub(crate) fn project(&self, direction: &Vector3<f64>) -> Option<SpherePixel> {
        match &self.part {
            ImagePart::Whole(camera) => camera.project(&Ray::new_normalize(*direction)),
            ImagePart::Half { camera, is_ahead } if (direction.x >= 0.0) == *is_ahead => {
                camera.project(&Ray::new_normalize(*direction))
            }
            ImagePart::Half { .. } => None,
            ImagePart::Circle(lens) => {
                lens.project(&lens.camera_from_lens.inverse_transform_vector(direction))
            }
        }
    }
}
