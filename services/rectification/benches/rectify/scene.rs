//! Cameras, a frame, and the views cut from it.

use flockeye_contract::FrameOrder;
use flockeye_geometry::camera::{Camera, CameraModel, Lens, LensCurve};
use flockeye_geometry::view::View;
use flockeye_imaging::sphere::{Cut, SphereImage};
use flockeye_rectification::rectifier::Rectifier;
use nalgebra::{Isometry3, Rotation3, Translation3, Unit, UnitQuaternion, Vector3};

/// A frame of a camera.
pub(crate) struct Scene {
    pub camera: Camera,
    pub pixels: Vec<u8>,
}

impl Scene {
    /// Texture at every scale, so that adjacent rows differ.
    pub(crate) fn of(camera: Camera) -> Self {
        let pixels = (0..camera.width() * camera.height()).map(|k| {
            let (x, y) = (k % camera.width(), k / camera.width());
            (x.wrapping_mul(y).wrapping_add((x / 7) ^ (y / 5)) >> 3) as u8
        });
        Self { pixels: pixels.collect(), camera }
    }

    pub(crate) fn sphere(&self) -> SphereImage<'_> {
        SphereImage::new(&self.pixels, self.camera.width() as usize, self.camera).unwrap()
    }

    pub(crate) fn key(&self, frame: u64) -> FrameOrder {
        (0, 0, frame)
    }

    pub(crate) fn cut(&self, rectifier: &mut dyn Rectifier, frame: u64, cut: &Cut, out: &mut [u8]) {
        rectifier.cut(self.key(frame), &self.sphere(), cut, out).unwrap();
    }
}

pub(crate) fn buffer(view: &View) -> Vec<u8> {
    vec![0; view.size_px.pow(2) as usize]
}

pub(crate) fn equirectangular() -> Camera {
    Camera::equirectangular(3840, 1920)
}

/// Two lenses of 195 degrees side by side, 16 mm apart, with a Kannala-Brandt curve each.
pub(crate) fn dual_fisheye() -> Camera {
    let lens = |ahead: f64, u: f64| {
        let axis = Vector3::x() * ahead;
        let right = axis.cross(&Vector3::z());
        let axes = Rotation3::from_basis_unchecked(&[right, axis.cross(&right), axis]);
        Lens {
            camera_from_lens: Isometry3::from_parts(
                Translation3::from(axis * 0.008),
                UnitQuaternion::from_rotation_matrix(&axes),
            ),
            centre_px: [u, 958.0].into(),
            circle_px: 950.0,
            field_rad: 195f64.to_radians(),
            focal_px: [560.0, 560.0].into(),
            curve: LensCurve::Equidistant([-0.02, 0.005, -0.003, 0.0004]),
        }
    };
    let lenses = [lens(1.0, 958.0), lens(-1.0, 2880.0)];
    Camera::new(3840, 1920, CameraModel::DualFisheye(lenses)).unwrap()
}

/// The paper's plane, 300 degrees across.
pub(crate) fn stereographic() -> Camera {
    let plane = CameraModel::Stereographic { field_rad: 300f64.to_radians() };
    Camera::new(1920, 1920, plane).unwrap()
}

pub(crate) fn look(direction: Vector3<f64>, field_deg: f64, size_px: u32) -> View {
    View::looking_at(&Unit::new_normalize(direction), field_deg.to_radians(), size_px)
}

/// A view of 20 degrees and 400 px near the axis of the first lens, which moves with each frame.
pub(crate) fn region(frame: u32) -> View {
    let azimuth = f64::from(frame % 100) * 0.01 - 0.5;
    look(Vector3::new(azimuth.cos(), azimuth.sin(), 0.2), 20.0, 400)
}

/// The vertices of an icosahedron: centres of the best cover of the sphere by twelve circles.
pub(crate) fn partition() -> Vec<View> {
    let golden = (1.0 + 5f64.sqrt()) / 2.0;
    let mut directions = Vec::new();
    for one in [-1.0, 1.0] {
        for long in [-golden, golden] {
            directions.push(Vector3::new(0.0, one, long));
            directions.push(Vector3::new(one, long, 0.0));
            directions.push(Vector3::new(long, 0.0, one));
        }
    }
    directions.into_iter().map(|direction| look(direction, 74.75, 936)).collect()
}
