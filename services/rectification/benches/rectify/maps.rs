//! Good use of OpenCV: `cv::remap` with the map of a view in single precision. Plain loops over
//! rows fill the map, with all invariants hoisted.

use flockeye_geometry::camera::{Camera, CameraModel, LensCurve, Stereographic};
use flockeye_geometry::view::View;
use nalgebra::{Matrix3, Vector3};
use opencv::core::{self, CV_16SC2, CV_32FC1, Mat, Scalar};
use opencv::imgproc;
use opencv::prelude::*;

/// The map of a view: columns and rows of the camera's image.
pub(crate) struct Maps {
    pub columns: Mat,
    pub rows: Mat,
}

/// Maps in OpenCV's fixed-point form.
pub(crate) struct FixedMaps {
    whole: Mat,
    fraction: Mat,
}

/// Coordinate outside any image.
const OUTSIDE: (f32, f32) = (-1e4, -1e4);

impl Maps {
    pub(crate) fn new(size_px: u32) -> Self {
        let size = size_px as i32;
        let new =
            || Mat::new_rows_cols_with_default(size, size, CV_32FC1, Scalar::all(0.0)).unwrap();
        Self { columns: new(), rows: new() }
    }

    /// Fills the maps for a view.
    pub(crate) fn build(&mut self, camera: &Camera, view: &View) {
        let (width, height) = (camera.width() as f32, camera.height() as f32);
        match camera.model() {
            CameraModel::Equirectangular { .. } => {
                let columns_per_radian = width / std::f32::consts::TAU;
                let rows_per_radian = height / std::f32::consts::PI;
                let (u0, v0) = (width * 0.5 - 0.5, height * 0.5 - 0.5);
                self.fill(view, |d| {
                    let across = (d.x * d.x + d.y * d.y).sqrt();
                    (
                        u0 - d.y.atan2(d.x) * columns_per_radian,
                        v0 - d.z.atan2(across) * rows_per_radian,
                    )
                });
            }
            CameraModel::DualFisheye(lenses) => {
                // Without the lenses' offset: less work than in our back ends.
                let lenses = lenses.each_ref().map(|lens| {
                    let LensCurve::Equidistant(k) = lens.curve else {
                        panic!("the scene's lenses are polynomials")
                    };
                    let turn = lens.camera_from_lens.rotation.inverse().to_rotation_matrix();
                    let turn: Matrix3<f32> = turn.matrix().cast();
                    (turn, k.map(|k| k as f32), lens.centre_px.cast::<f32>())
                });
                let focal = 560.0f32;
                self.fill(view, |d| {
                    let first = usize::from(d.x < 0.0);
                    let (turn, [k1, k2, k3, k4], centre) = &lenses[first];
                    let seen = turn * d;
                    let across = (seen.x * seen.x + seen.y * seen.y).sqrt();
                    let angle = across.atan2(seen.z);
                    let square = angle * angle;
                    let distance =
                        angle * (1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4))));
                    let scale = if across > 0.0 { focal * distance / across } else { 0.0 };
                    (centre.x + seen.x * scale, centre.y + seen.y * scale)
                });
            }
            &CameraModel::Stereographic { field_rad } => {
                let plane = Stereographic::new(camera.width(), camera.height(), field_rad);
                let (twice, circle) = (2.0 * plane.radius_px as f32, plane.circle_px as f32);
                let centre = plane.centre_px.map(|side| side as f32);
                self.fill(view, |d| {
                    let scale = twice / (d.norm() + d.x);
                    let (u, v) = (-d.y * scale, -d.z * scale);
                    if u * u + v * v <= circle * circle {
                        (u + centre[0], v + centre[1])
                    } else {
                        OUTSIDE
                    }
                });
            }
        }
    }

    #[inline(always)]
    fn fill(&mut self, view: &View, point: impl Fn(Vector3<f32>) -> (f32, f32)) {
        let axes: Matrix3<f32> = view.camera_from_view.to_rotation_matrix().matrix().cast();
        let (right, down) = (axes.column(0).into_owned(), axes.column(1).into_owned());
        let ahead: Vector3<f32> = axes.column(2) * view.focal_px as f32;
        let middle = view.centre_px() as f32;
        let size = view.size_px as usize;
        let columns = self.columns.data_typed_mut::<f32>().unwrap();
        let rows = self.rows.data_typed_mut::<f32>().unwrap();
        for y in 0..size {
            let first = ahead + down * (y as f32 - middle);
            let line = y * size..(y + 1) * size;
            let places = columns[line.clone()].iter_mut().zip(&mut rows[line]);
            for (x, (column, row)) in places.enumerate() {
                (*column, *row) = point(first + right * (x as f32 - middle));
            }
        }
    }

    /// In OpenCV's fixed-point form.
    pub(crate) fn fixed(&self) -> FixedMaps {
        let (mut whole, mut fraction) = (Mat::default(), Mat::default());
        imgproc::convert_maps(
            &self.columns,
            &self.rows,
            &mut whole,
            &mut fraction,
            CV_16SC2,
            false,
        )
        .unwrap();
        FixedMaps { whole, fraction }
    }

    /// Cuts the view with these maps.
    pub(crate) fn remap(
        &self,
        sphere: &impl core::ToInputArray,
        out: &mut Mat,
        interpolation: i32,
    ) {
        remap(sphere, out, &self.columns, &self.rows, interpolation);
    }
}

impl FixedMaps {
    /// Cuts the view with these maps.
    pub(crate) fn remap(
        &self,
        sphere: &impl core::ToInputArray,
        out: &mut Mat,
        interpolation: i32,
    ) {
        remap(sphere, out, &self.whole, &self.fraction, interpolation);
    }
}

fn remap(
    sphere: &impl core::ToInputArray,
    out: &mut Mat,
    one: &Mat,
    other: &Mat,
    interpolation: i32,
) {
    let border = core::BORDER_WRAP;
    imgproc::remap(sphere, out, one, other, interpolation, border, Scalar::default()).unwrap();
}
