//! Printed edges land where an independent projection says, everywhere on the plain sphere.

use flockeye_geometry::Ray;
use flockeye_geometry::body::Marker;
use flockeye_geometry::camera::{Camera, Equirectangular};
use flockeye_simulator::{Attitude, Moment, Placement, World, WorldParameters};
use nalgebra::{Isometry3, Point3, Unit, Vector3};

use super::{body, light_of, placed, quiet, world_of};

const CAMERA: Equirectangular = Equirectangular { width: 1920, height: 960 };

/// Linear light between the pixels.
struct SpherePicture(Vec<f64>);

impl SpherePicture {
    fn at(&self, ray: &Ray) -> f64 {
        let pixel = CAMERA.project(ray).0;
        let (width, height) = (i64::from(CAMERA.width), i64::from(CAMERA.height));
        let (u, v) = (pixel.x.floor(), pixel.y.floor());
        let get = |column: i64, row: i64| {
            // Beyond a pole the picture goes on at the opposite meridian.
            let over = !(0..height).contains(&row);
            let row = if row < 0 { -1 - row } else { row.min(2 * height - 1 - row) };
            let column = (column + if over { width / 2 } else { 0 }).rem_euclid(width);
            self.0[(row * width + column) as usize]
        };
        let (s, t) = (pixel.x - u, pixel.y - v);
        let (column, row) = (u as i64, v as i64);
        (get(column, row) * (1.0 - s) + get(column + 1, row) * s) * (1.0 - t)
            + (get(column, row + 1) * (1.0 - s) + get(column + 1, row + 1) * s) * t
    }
}

/// Distance by which the edge between corners `k` and `k + 1` appears outside of its true place,
/// pixels.
fn edge_error(picture: &SpherePicture, pose: &Isometry3<f64>, marker: &Marker, k: usize) -> f64 {
    let (from, to) = (marker.corners[k], marker.corners[(k + 1) % 4]);
    let outwards = marker.normal().cross(&(to - from)).normalize();
    assert!(outwards.dot(&(from - marker.centre())) > 0.0);
    let ray = |share: f64, out_m: f64| {
        let point: Point3<f64> = pose * (from + (to - from) * share + outwards * out_m);
        Unit::new_normalize(point.coords)
    };
    let reach = 0.0028;
    let errors = (0..60).map(|i| {
        let share = 0.15 + 0.7 * f64::from(i) / 59.0;
        let profile = |step: i32| picture.at(&ray(share, reach * f64::from(step) / 40.0));
        let middle = (profile(-40) + profile(40)) / 2.0;
        let crossing = (-40..40).find(|&step| profile(step + 1) > middle).expect("dark to light");
        let (below, above) = (profile(crossing), profile(crossing + 1));
        let step = f64::from(crossing) + (middle - below) / (above - below);
        let angle = ray(share, 0.0).angle(&ray(share, reach * step / 40.0));
        (angle * CAMERA.pixels_per_radian()).copysign(step)
    });
    errors.sum::<f64>() / 60.0
}

/// Errors of all edges of all markers that are seen at less than 45 degrees.
fn edge_errors(world: &mut World, placement: Placement) -> Vec<f64> {
    let moment = Moment { time_s: 0.0, camera: Attitude::level(0.4), placements: vec![placement] };
    let mut luma = vec![0; (CAMERA.width * CAMERA.height) as usize];
    world.render_moment(0, &moment, &mut luma, CAMERA.width as usize).unwrap();
    let picture = SpherePicture(light_of(&luma));
    let pose = placement.camera_from_markers;
    let body = body(0);
    let facing = body.markers.iter().filter(|marker| {
        let towards_eye = -(pose * marker.centre()).coords;
        (pose.rotation * marker.normal()).angle(&towards_eye).to_degrees() < 45.0
    });
    facing
        .flat_map(|marker| {
            (0..4).map(|k| edge_error(&picture, &pose, marker, k)).collect::<Vec<_>>()
        })
        .collect()
}

/// Directions (azimuth, elevation) in degrees: ahead, aside, over the seam, both poles, around
/// them.
const DIRECTIONS: [[f64; 2]; 9] = [
    [0.0, 0.0],
    [77.0, 10.0],
    [180.0, 0.0],
    [-179.0, 35.0],
    [20.0, 90.0],
    [140.0, 84.0],
    [-60.0, 62.0],
    [0.0, -90.0],
    [-120.0, -55.0],
];

fn assert_exact(samples_per_px: f64, velocity_in_camera: Vector3<f64>) {
    let camera = Camera::equirectangular(CAMERA.width, CAMERA.height);
    let mut world = world_of(1, WorldParameters { samples_per_px, ..quiet(camera) });
    for (index, direction) in DIRECTIONS.into_iter().enumerate() {
        let turn = [0.3, -0.2, 0.7 * index as f64];
        let camera_from_markers = placed(direction, turn);
        let errors = edge_errors(&mut world, Placement { camera_from_markers, velocity_in_camera });
        assert!(errors.len() >= 4, "{} edges at {direction:?}", errors.len());
        let worst = errors.iter().fold(0.0f64, |worst, error| worst.max(error.abs()));
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        println!("{samples_per_px} {direction:?}: worst {worst:.4} mean {mean:.4}");
        assert!(worst < 0.05 && mean.abs() < 0.02, "{direction:?}: worst {worst}, mean {mean} px");
    }
}

#[test]
fn edges_are_exact_in_real_time() {
    assert_exact(2.0, Vector3::zeros());
}

#[test]
fn edges_are_exact_for_accuracy_work() {
    assert_exact(4.0, Vector3::zeros());
}

#[test]
fn a_moving_body_is_where_it_is_at_mid_exposure() {
    // Up to 1.5 pixels of motion blur.
    assert_exact(2.0, Vector3::new(0.12, -0.1, 0.11));
}
