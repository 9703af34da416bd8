//! Viewpoints of a camera: its centre, or the positions of its lenses.

use std::f64::consts::{FRAC_PI_2, PI};

use flockeye_config::SimulatedStitch;
use flockeye_geometry::Ray;
use flockeye_geometry::camera::{Camera, CameraModel, Lens, SpherePixel};
use nalgebra::{Isometry3, Translation3, Unit, UnitQuaternion, Vector3};

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
    /// How a stitcher moves what the eye sees; `None`: not at all.
    moved: Option<Moved>,
}

/// What a stitcher does to the picture of one lens.
#[derive(Debug, Clone, Copy)]
struct Moved {
    /// 1 ahead, -1 behind.
    side: f64,
    /// Turn of the lens against the camera, about an axis that is not special.
    turn: UnitQuaternion<f64>,
    /// Position of the lens in units of the distance at which the halves fit.
    nearness: f64,
    /// Outward error of the lens's curve at the border, radians.
    rim_rad: f64,
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
    /// The eyes of a camera: one, or one per lens; of a stitched picture always two.
    pub(crate) fn all(camera: &Camera, stitch: Option<&SimulatedStitch>) -> Vec<Self> {
        // Directions of a lens alone are those of objects at infinity.
        let camera = camera.at_distance(f64::INFINITY);
        let eye = |position_m, picture, part| Self { position_m, picture, part, moved: None };
        match *camera.model() {
            CameraModel::Equirectangular { lens_distance_m }
                if lens_distance_m > 0.0 || stitch.is_some() =>
            {
                [(0.5, true), (-0.5, false)]
                    .map(|(side, is_ahead)| {
                        let position_m = Vector3::x() * (side * lens_distance_m);
                        let moved = stitch.map(|stitch| Moved::of(stitch, side, lens_distance_m));
                        Self { moved, ..eye(position_m, 0, ImagePart::Half { camera, is_ahead }) }
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

    /// Where the eye's picture shows a body with this pose relative to the eye.
    pub(crate) fn shown(&self, eye_from_markers: &Isometry3<f64>) -> Isometry3<f64> {
        self.moved.map_or(*eye_from_markers, |moved| moved.shown(eye_from_markers))
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

impl Moved {
    fn of(stitch: &SimulatedStitch, half: f64, lens_distance_m: f64) -> Self {
        let axis = Vector3::new(0.7, -0.5, 0.5).normalize();
        let nearness = match stitch.fits_at_m {
            0.0 => 0.0,
            metres => half * lens_distance_m / metres,
        };
        Self {
            side: half.signum(),
            turn: UnitQuaternion::from_scaled_axis(axis * (half * stitch.turn_deg.to_radians())),
            nearness,
            rim_rad: stitch.rim_deg.to_radians(),
        }
    }

    /// Angle from the lens's axis at which the picture shows what the lens sees at `angle`.
    fn angle(&self, angle: f64) -> f64 {
        // The stitcher takes each ray to end on a sphere round the camera's middle.
        let nearness = self.nearness * self.side;
        let along = nearness * angle.cos();
        let reach = (1.0 - nearness * nearness + along * along).sqrt() - along;
        let from_middle = (reach * angle.sin()).atan2(nearness + reach * angle.cos());
        // A body behind the lens is never drawn for it.
        let outwards = self.rim_rad * (angle / FRAC_PI_2).min(1.5).powi(3);
        (from_middle + outwards).clamp(0.0, PI)
    }

    /// Where the picture shows a body: turned about the eye, and as large as the picture makes it there.
    fn shown(&self, eye_from_markers: &Isometry3<f64>) -> Isometry3<f64> {
        let turned = self.turn * eye_from_markers;
        let place = turned.translation.vector;
        let axis = Vector3::x() * self.side;
        let across = axis.cross(&place);
        let Some(about) = Unit::try_new(across, 1e-9) else { return turned };
        let angle = across.norm().atan2(axis.dot(&place));
        let shown = self.angle(angle);
        let step = 1e-4;
        let along = (self.angle(angle + step) - self.angle(angle - step)) / (2.0 * step);
        let magnified = (along * shown.sin() / angle.sin()).max(0.01).sqrt();
        let turn = UnitQuaternion::from_axis_angle(&about, shown - angle);
        let nearer = turn * place * (1.0 / magnified - 1.0);
        Translation3::from(nearer) * (turn * turned)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use flockeye_geometry::camera::{Half, Stitch};
    use nalgebra::{Matrix5, Vector5};

    use super::*;

    /// Where both lenses of a stitched picture show bodies, against the model that flies.
    #[test]
    fn bodies_are_shown_where_a_stitched_camera_shows_them() {
        let model = CameraModel::Equirectangular { lens_distance_m: 0.016 };
        let camera = Camera::new(3840, 1920, model).unwrap();
        let stitch = SimulatedStitch { fits_at_m: 2.0, turn_deg: 0.1, ..Default::default() };
        let eyes = Eye::all(&camera, Some(&stitch));
        let turn = Vector3::new(0.7, -0.5, 0.5).normalize() * 0.05f64.to_radians();
        let known =
            Stitch::of(Vector5::new(0.008, 0.004, turn.x, turn.y, turn.z), Matrix5::zeros());
        for at in [[0.1, 0.9, 0.2], [1.2, -0.4, 0.3], [-0.1, 0.6, -0.4], [-1.5, 0.1, 0.2]] {
            let place = Vector3::from(at);
            let half = Half::of(&place);
            let eye = &eyes[usize::from(half == Half::Behind)];
            let seen = eye.shown(&Translation3::from(place - eye.position_m).into());
            let shown = known.unwrap().shown_from_camera(half, &place)
                * Isometry3::from(Translation3::from(place));
            let off = (seen.translation.vector - shown.translation.vector) / place.norm();
            assert!(off.norm() < 2e-4, "{at:?}: {off}");
        }
        let rim = SimulatedStitch { rim_deg: 0.1, ..Default::default() };
        let eyes = Eye::all(&camera, Some(&rim));
        let beside = eyes[0].shown(&Translation3::new(0.0, 1.0, 0.0).into()).translation.vector;
        assert!((beside.x + 0.1f64.to_radians()).abs() < 1e-5, "outwards: {beside}");
    }
}
