//! Composition of a frame's layers to pixels: row by row for an equirectangular image, tile by tile
//! for others.

use std::f64::consts::FRAC_PI_2;

use flockeye_geometry::camera::CameraModel;

use crate::density::Density;
use crate::eyes::Eye;
use crate::moment::Placement;
use crate::parameters::WorldParameters;
use crate::scene::FrameScene;
use crate::sensor::ImageSensor;
use crate::sphere_picture::SpherePicture;
use crate::tiled_picture::TiledPicture;

/// The image of a camera, with all data that is equal in all frames.
#[derive(Debug)]
pub(crate) enum CameraPicture {
    /// Equirectangular image with aspect 2:1: rows are shifted and copied.
    Sphere(SpherePicture),
    /// Image of any camera: pixels are looked up.
    Tiled(TiledPicture),
}

impl CameraPicture {
    pub(crate) fn new(parameters: &WorldParameters, eyes: &[Eye], sensor: &ImageSensor) -> Self {
        let camera = &parameters.camera;
        let is_sphere = matches!(camera.model(), CameraModel::Equirectangular { .. })
            && camera.width() == 2 * camera.height();
        if is_sphere {
            Self::Sphere(SpherePicture::new(parameters, eyes, sensor))
        } else {
            Self::Tiled(TiledPicture::new(parameters, eyes, sensor))
        }
    }

    /// Writes the levels of a frame, rows `stride` bytes apart.
    pub(crate) fn expose(
        &mut self,
        scene: FrameScene<'_>,
        sensor: &ImageSensor,
        luma: &mut [u8],
        stride: usize,
    ) {
        match self {
            Self::Sphere(picture) => picture.expose(scene, sensor, luma, stride),
            Self::Tiled(picture) => picture.expose(scene, sensor, luma, stride),
        }
    }

    /// The image's density at a body of `radius` metres, for the eye of this index. `None` if
    /// neither the body nor its blur is in the eye's part.
    pub(crate) fn density_at(
        &self,
        eye: usize,
        seen: &Placement,
        radius: f64,
        parameters: &WorldParameters,
    ) -> Option<Density> {
        let at = seen.position();
        let direction = at.normalize();
        let (density, apart) = match self {
            Self::Sphere(picture) => picture.nearest(eye, &direction),
            Self::Tiled(picture) => picture.nearest(eye, &direction)?,
        };
        // As in a drawing's margins: twice the reach of its blur.
        let blur = 8.0 * parameters.lens_blur_px / density.pixels_per_radian();
        let motion = seen.angular_speed() * parameters.exposure_s;
        let reach = (radius / at.norm()).min(1.0).asin() + blur + motion;
        (apart <= reach.min(FRAC_PI_2)).then_some(density)
    }
}
