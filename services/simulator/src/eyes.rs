//! Where pictures are taken from: the camera's middle, or its lenses' own places.

use flockeye_geometry::Ray;
use flockeye_geometry::camera::{Camera, CameraModel, Lens, SpherePixel};
use nalgebra::Vector3;

/// A place from which the image, or a part of it, is taken.
///
/// Directions are seen from here, along the camera's axes: near things truly shift from one eye to
/// another.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Eye {
    /// Where it is in the camera frame, metres.
    pub(crate) position_m: Vector3<f64>,
    /// Which of the image's connected pictures it adds to: the halves of a stitched image make
    /// one, each image circle is one of its own.
    pub(crate) picture: usize,
    part: ImagePart,
}

/// The part of the image that an eye takes.
#[derive(Debug, Clone, Copy)]
enum ImagePart {
    Whole(Camera),
    /// Where a stitched camera looks ahead (x >= 0), or back.
    Half {
        camera: Camera,
        is_ahead: bool,
    },
    Circle(Lens),
}

impl Eye {
    /// The eyes of a camera: one, or one for each lens.
    pub(crate) fn all(camera: &Camera) -> Vec<Self> {
        // A lens' own directions are those of things infinitely far away.
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

    /// The direction that `pixel` sees; `None` where it is not this eye's.
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

    /// The point that sees `direction`; `None` where this eye does not look.
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
