//! Cameras by their numbers, and where they see things: written from the models' own papers, not
//! taken from the code under test.

use std::f64::consts::{PI, TAU};

use flockeye_geometry::camera::{Camera, CameraModel, Lens, LensCurve};
use nalgebra::{Isometry3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// A camera by its numbers alone.
#[derive(Clone, Copy)]
pub(crate) struct Sheet {
    pub width: u32,
    pub height: u32,
    pub kind: Kind,
}

#[derive(Clone, Copy)]
#[expect(clippy::large_enum_variant, reason = "a test has a few of them")]
pub(crate) enum Kind {
    Sphere { lens_distance_m: f64 },
    Fisheyes([Fisheye; 2]),
    Plane { field_deg: f64 },
}

#[derive(Clone, Copy)]
pub(crate) struct Fisheye {
    /// Right, down and ahead in the camera frame.
    pub axes: [Vector3<f64>; 3],
    pub position_m: Vector3<f64>,
    pub centre: [f64; 2],
    pub circle: f64,
    pub field_deg: f64,
    pub focal: [f64; 2],
    pub curve: Curve,
}

#[derive(Clone, Copy)]
pub(crate) enum Curve {
    KannalaBrandt([f64; 4]),
    DoubleSphere { xi: f64, alpha: f64 },
}

impl Fisheye {
    /// Looks ahead or back, turned a little, `aside_m` from the middle.
    pub(crate) fn new(ahead: f64, aside_m: f64, centre: [f64; 2], circle: f64, focal: f64) -> Self {
        let turn = Rotation3::from_euler_angles(0.02, -0.03, 0.04 * ahead);
        let axes = [-Vector3::y() * ahead, -Vector3::z(), Vector3::x() * ahead];
        Self {
            axes: axes.map(|axis| turn * axis),
            position_m: Vector3::new(aside_m * ahead, 0.1 * aside_m, -0.2 * aside_m),
            centre,
            circle,
            field_deg: 190.0,
            focal: [focal, focal * 1.01],
            curve: Curve::KannalaBrandt([0.0; 4]),
        }
    }

    pub(crate) fn lens(&self) -> Lens {
        let axes = Rotation3::from_basis_unchecked(&self.axes);
        Lens {
            camera_from_lens: Isometry3::from_parts(
                Translation3::from(self.position_m),
                UnitQuaternion::from_rotation_matrix(&axes),
            ),
            centre_px: self.centre.into(),
            circle_px: self.circle,
            field_rad: self.field_deg.to_radians(),
            focal_px: self.focal.into(),
            curve: match self.curve {
                Curve::KannalaBrandt(k) => LensCurve::Equidistant(k),
                Curve::DoubleSphere { xi, alpha } => LensCurve::DoubleSphere { xi, alpha },
            },
        }
    }

    /// Pixel of a point in the camera frame; `None` within `margin` pixels of the border.
    pub(crate) fn project(&self, point: &Point3<f64>, margin: f64) -> Option<[f64; 2]> {
        let seen = point.coords - self.position_m;
        let [x, y, z] = self.axes.map(|axis| axis.dot(&seen));
        let across = x.hypot(y);
        let angle = across.atan2(z);
        let plane = match self.curve {
            Curve::KannalaBrandt([k1, k2, k3, k4]) => {
                let distance = angle
                    + k1 * angle.powi(3)
                    + k2 * angle.powi(5)
                    + k3 * angle.powi(7)
                    + k4 * angle.powi(9);
                [distance * x / across, distance * y / across]
            }
            Curve::DoubleSphere { xi, alpha } => {
                let first = seen.norm();
                let second = (x * x + y * y + (xi * first + z).powi(2)).sqrt();
                let depth = alpha * second + (1.0 - alpha) * (xi * first + z);
                [x / depth, y / depth]
            }
        };
        let [u, v] = [0, 1].map(|k| self.focal[k] * plane[k]);
        let in_field = angle < (self.field_deg / 2.0).to_radians() - margin / self.focal[0];
        (in_field && u.hypot(v) < self.circle - margin)
            .then_some([self.centre[0] + u, self.centre[1] + v])
    }
}

impl Sheet {
    pub(crate) fn camera(&self) -> Camera {
        let model = match self.kind {
            Kind::Sphere { lens_distance_m } => CameraModel::Equirectangular { lens_distance_m },
            Kind::Fisheyes(lenses) => {
                CameraModel::DualFisheye(lenses.map(|fisheye| fisheye.lens()))
            }
            Kind::Plane { field_deg } => {
                CameraModel::Stereographic { field_rad: field_deg.to_radians() }
            }
        };
        Camera::new(self.width, self.height, model).unwrap()
    }

    /// The same camera with a quarter of the pixels along each side.
    pub(crate) fn quartered(self) -> Self {
        let quartered = |lens: Fisheye| Fisheye {
            centre: lens.centre.map(|middle| (middle + 0.5) / 4.0 - 0.5),
            circle: lens.circle / 4.0,
            focal: lens.focal.map(|focal| focal / 4.0),
            ..lens
        };
        let kind = match self.kind {
            Kind::Fisheyes(lenses) => Kind::Fisheyes(lenses.map(quartered)),
            other => other,
        };
        Self { width: self.width / 4, height: self.height / 4, kind }
    }

    /// Positions of the camera's eyes.
    pub(crate) fn eyes(&self) -> Vec<Point3<f64>> {
        match self.kind {
            Kind::Sphere { lens_distance_m } if lens_distance_m > 0.0 => {
                [0.5, -0.5].map(|side| Point3::new(side * lens_distance_m, 0.0, 0.0)).into()
            }
            Kind::Fisheyes(lenses) => lenses.map(|lens| lens.position_m.into()).into(),
            _ => vec![Point3::origin()],
        }
    }

    /// Pixel of a point in the camera frame for eye `k`. `None` within `margin` pixels of its
    /// picture's border.
    pub(crate) fn project(&self, k: usize, point: &Point3<f64>, margin: f64) -> Option<[f64; 2]> {
        let (width, height) = (f64::from(self.width), f64::from(self.height));
        match self.kind {
            Kind::Sphere { .. } => {
                let seen = point - self.eyes()[k];
                let longitude = seen.y.atan2(seen.x);
                let latitude = (seen.z / seen.norm()).asin();
                let from_seam = (if k == 0 { seen.x } else { -seen.x }) / seen.norm();
                let is_mine = self.eyes().len() == 1 || from_seam > margin * TAU / width;
                let u = (0.5 - longitude / TAU) * width - 0.5;
                let v = (0.5 - latitude / PI) * height - 0.5;
                is_mine.then_some([u, v])
            }
            Kind::Fisheyes(lenses) => lenses[k].project(point, margin),
            Kind::Plane { field_deg } => {
                // The paper's plane, by latitude and by longitude to the right.
                let seen = point.coords.normalize();
                let (latitude, longitude) = (seen.z.asin(), (-seen.y).atan2(seen.x));
                let circle = width.min(height) / 2.0;
                let radius = circle / (2.0 * (field_deg.to_radians() / 4.0).tan());
                let scale = 2.0 * radius / (1.0 + latitude.cos() * longitude.cos());
                let x = scale * latitude.cos() * longitude.sin();
                let y = scale * latitude.sin();
                (x.hypot(y) < circle - margin)
                    .then_some([(width - 1.0) / 2.0 + x, (height - 1.0) / 2.0 - y])
            }
        }
    }
}

/// Lenses far enough apart that their parallax is dozens of pixels.
const LENS_DISTANCE_M: f64 = 0.06;

pub(crate) fn kannala_brandt() -> Sheet {
    let lens = |ahead: f64, u: f64| Fisheye {
        curve: Curve::KannalaBrandt([-0.02, 0.005, -0.003, 0.0004]),
        ..Fisheye::new(ahead, LENS_DISTANCE_M / 2.0, [u, 478.7], 470.0, 285.0)
    };
    Sheet { width: 1920, height: 960, kind: Kind::Fisheyes([lens(1.0, 478.2), lens(-1.0, 1441.9)]) }
}

pub(crate) fn double_sphere() -> Sheet {
    let lens = |ahead: f64, u: f64, xi: f64, alpha: f64| Fisheye {
        curve: Curve::DoubleSphere { xi, alpha },
        ..Fisheye::new(ahead, LENS_DISTANCE_M / 2.0, [u, 478.7], 470.0, 284.0)
    };
    let lenses = [lens(1.0, 481.3, 0.0024, 0.6605), lens(-1.0, 1438.1, -0.0207, 0.6521)];
    Sheet { width: 1920, height: 960, kind: Kind::Fisheyes(lenses) }
}

pub(crate) fn equidistant() -> Sheet {
    let lens = |ahead: f64, u: f64| Fisheye::new(ahead, 0.0, [u, 479.5], 479.0, 286.0);
    Sheet { width: 1920, height: 960, kind: Kind::Fisheyes([lens(1.0, 479.5), lens(-1.0, 1439.5)]) }
}

pub(crate) fn plane() -> Sheet {
    Sheet { width: 1600, height: 1500, kind: Kind::Plane { field_deg: 240.0 } }
}

pub(crate) fn stitched() -> Sheet {
    let kind = Kind::Sphere { lens_distance_m: LENS_DISTANCE_M };
    Sheet { width: 1920, height: 960, kind }
}

/// Not twice as wide as high: drawn by the same means as the fisheyes.
pub(crate) fn stitched_and_stretched() -> Sheet {
    Sheet { width: 1900, ..stitched() }
}
