//! A real Ricoh Theta S with its published calibration (`docs/cameras/theta_s.yaml`).
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::path::Path;

use flockeye_config::{Pipeline, Resolved};
use flockeye_geometry::camera::{Camera, CameraModel, Lens};
use flockeye_geometry::view::{View, ViewPixel};
use flockeye_imaging::sphere::{Cut, SphereImage, rectify_into};
use nalgebra::{Unit, Vector3};
use opencv::core::{self, Mat, Point2f, Size, TermCriteria, Vector};
use opencv::prelude::*;
use opencv::{calib3d, imgcodecs, imgproc};

/// Both lenses' pictures side by side, and the calibrated camera; `None`, with a word why, where
/// the pictures are not.
fn theta_s() -> Option<(Mat, Camera)> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../");
    let data = flockeye_require::recordings()?.join("real/theta_s");
    let mut parts = Vector::<Mat>::new();
    for name in ["front.jpg", "back.jpg"] {
        let path = data.join(name);
        parts.push(imgcodecs::imread(path.to_str().unwrap(), imgcodecs::IMREAD_GRAYSCALE).unwrap());
    }
    let mut frame = Mat::default();
    core::hconcat(&parts, &mut frame).unwrap();
    let pipeline = Pipeline::load(&root.join("docs/cameras/theta_s.yaml"), &[]).unwrap();
    Some((frame, Resolved::of(pipeline).unwrap().camera))
}

fn cut(frame: &Mat, camera: &Camera, cut: &Cut) -> Vec<u8> {
    let sphere = SphereImage::new(frame.data_bytes().unwrap(), 1280, *camera).unwrap();
    let size = cut.view.size_px as usize;
    let mut out = vec![0; size * size];
    rectify_into(&sphere, cut, &mut out, size).unwrap();
    out
}

fn look(x: f64, y: f64, z: f64, field_deg: f64, size_px: u32) -> View {
    View::looking_at(&Unit::new_normalize(Vector3::new(x, y, z)), field_deg.to_radians(), size_px)
}

/// Distance of the chessboard's corners from those of a plane (root mean square), pixels of the
/// lens' picture. At any place, a rectified picture shows the board as a homography.
fn unevenness_px(frame: &Mat, camera: &Camera, view: View) -> f64 {
    let greys = cut(frame, camera, &Cut::cubic(view));
    let image = Mat::new_rows_cols_with_data(500, 500, &greys).unwrap();
    let mut found = Vector::<Point2f>::new();
    let flags = calib3d::CALIB_CB_ADAPTIVE_THRESH | calib3d::CALIB_CB_NORMALIZE_IMAGE;
    let (columns, rows) = (8, 5);
    let size = Size::new(columns, rows);
    assert!(calib3d::find_chessboard_corners(&image, size, &mut found, flags).unwrap());
    let until = TermCriteria::new(3, 30, 0.01).unwrap();
    let (half_window, no_zone) = (Size::new(5, 5), Size::new(-1, -1));
    imgproc::corner_sub_pix(&image, &mut found, half_window, no_zone, until).unwrap();
    let board: Vector<Point2f> = (0..columns * rows)
        .map(|k| Point2f::new((k % columns) as f32, (k / columns) as f32))
        .collect();
    let mut mask = Mat::default();
    let homography = calib3d::find_homography(&board, &found, &mut mask, 0, 3.0).unwrap();
    let mut expected = Vector::<Point2f>::new();
    core::perspective_transform(&board, &mut expected, &homography).unwrap();
    let squares = expected
        .iter()
        .zip(&found)
        .map(|(a, b)| f64::from(a.x - b.x).powi(2) + f64::from(a.y - b.y).powi(2));
    let root_mean_square = (squares.sum::<f64>() / f64::from(columns * rows)).sqrt();
    root_mean_square / (view.focal_px / camera.pixels_per_radian())
}

#[test]
fn a_chessboard_is_plane_in_the_rectified_view() {
    let Some((frame, camera)) = theta_s() else { return };
    let CameraModel::DualFisheye(lenses) = *camera.model() else { panic!("two lenses") };
    let wrong = lenses.map(|lens| {
        let field_rad = 0.6 * lens.field_rad;
        Lens::equidistant(lens.camera_from_lens, lens.centre_px, lens.circle_px, field_rad)
    });
    let wrong = Camera::new(1280, 640, CameraModel::DualFisheye(wrong)).unwrap();
    let view = look(0.35, 0.12, -0.62, 40.0, 500);
    let calibrated = unevenness_px(&frame, &camera, view);
    // The same part of the picture: what the lens shows 50 degrees off its axis.
    let there = wrong.ray(camera.project(&view.direction_in_camera()).unwrap()).unwrap();
    let view = View::looking_at(&there, 25f64.to_radians(), 500);
    let uncalibrated = unevenness_px(&frame, &wrong, view);
    println!(
        "off a plane by {calibrated:.2} px calibrated, {uncalibrated:.2} px with a wrong lens"
    );
    // Corners of a soft JPEG are found within about a quarter of a pixel.
    assert!(calibrated < 0.4, "{calibrated} px");
    assert!(calibrated < 0.7 * uncalibrated, "{calibrated} px against {uncalibrated} px");
}

/// Correlation of the greys of a strip round the border between the lenses, 1 at best. Each lens
/// sees the strip, and the camera is set to `distance_m`.
fn agreement(frame: &Mat, camera: &Camera, towards: [f64; 3], distance_m: f64) -> f64 {
    let CameraModel::DualFisheye(lenses) = *camera.model() else { panic!("two lenses") };
    let [x, y, z] = towards;
    let view = View { focal_px: 400.0, ..look(x, y, z, 10.0, 120) };
    let strips = [0, 1].map(|k| {
        // The other lens sees a spot round its axis, and leaves the border to this one.
        let mut alone = lenses;
        alone[1 - k] = Lens { field_rad: 0.2, ..alone[1 - k] };
        let alone = Camera::new(1280, 640, CameraModel::DualFisheye(alone)).unwrap();
        let greys = cut(frame, &alone, &Cut { distance_m, ..Cut::cubic(view) });
        let near_border = (0..120 * 120).filter(|k| {
            let at = ViewPixel::new(f64::from(k % 120), f64::from(k / 120));
            view.ray(at).x.abs() < 0.045
        });
        let strip: Vec<f64> = near_border.map(|k| f64::from(greys[k as usize])).collect();
        let mean = strip.iter().sum::<f64>() / strip.len() as f64;
        strip.into_iter().map(|grey| grey - mean).collect::<Vec<_>>()
    });
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let [front, back] = &strips;
    dot(front, back) / (dot(front, front) * dot(back, back)).sqrt()
}

/// The table is half a metre away: only with the lenses where they are do both see it alike.
#[test]
fn across_the_border_near_things_need_the_lens_offset() {
    let Some((frame, camera)) = theta_s() else { return };
    let table = [0.0, 0.87, -0.5];
    let with_offset = agreement(&frame, &camera, table, 0.5);
    let without = agreement(&frame, &camera, table, f64::INFINITY);
    println!("the lenses agree by {with_offset:.2} with their offset, {without:.2} without");
    assert!(with_offset > 0.9 && with_offset > without + 0.1, "{with_offset} {without}");
}

#[test]
fn no_view_has_a_hole() {
    let Some((frame, camera)) = theta_s() else { return };
    // A white frame: what is black then is seen by no lens.
    let white = Mat::ones(frame.rows(), frame.cols(), core::CV_8UC1).unwrap();
    let white = (white * 255.0).into_result().unwrap().to_mat().unwrap();
    for direction in
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.1], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.1, 0.0, -1.0]]
    {
        let [x, y, z] = direction;
        for distance_m in [0.4, f64::INFINITY] {
            let view = Cut { distance_m, ..Cut::bilinear(look(x, y, z, 75.0, 300)) };
            assert!(!cut(&white, &camera, &view).contains(&0), "{direction:?} {distance_m}");
        }
    }
}
