//! Tests of frames and their truth through the public interface.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::f64::consts::{FRAC_PI_2, PI};

use flockeye_dictionary::Dictionary;
use flockeye_geometry::body::{Bodies, Body, squares};
use flockeye_geometry::camera::{Camera, Equirectangular};
use flockeye_simulator::{
    Attitude, FrameTruth, Moment, Placement, RenderError, World, WorldError, WorldParameters,
};
use nalgebra::{Isometry3, Point3, Unit, UnitQuaternion, Vector3};

const WIDTH: usize = 1024;
const HEIGHT: usize = 512;

fn body(index: u32) -> Body {
    squares(["alpha", "bravo", "charlie"][index as usize], 0.0625, 0.05, 17 * index)
}

fn world_with(count: u32, change: impl FnOnce(&mut WorldParameters)) -> Result<World, WorldError> {
    let camera = Camera::equirectangular(WIDTH as u32, HEIGHT as u32);
    let mut parameters = WorldParameters { camera, ..Default::default() };
    change(&mut parameters);
    let bodies = Bodies::new("DICT_5X5_250".into(), (0..count).map(body).collect()).unwrap();
    World::new(parameters, &bodies, &Dictionary::of(&bodies).unwrap())
}

fn render(world: &mut World, frame: u64) -> (Vec<u8>, FrameTruth) {
    let mut luma = vec![0; WIDTH * HEIGHT];
    let truth = world.render(frame, &mut luma, WIDTH).unwrap();
    (luma, truth)
}

fn render_poses(
    world: &mut World,
    observer_yaw: f64,
    poses: &[Isometry3<f64>],
) -> (Vec<u8>, FrameTruth) {
    let place = |pose: &Isometry3<f64>| Placement {
        camera_from_markers: *pose,
        velocity_in_camera: Vector3::zeros(),
    };
    let placements = poses.iter().map(place).collect();
    let moment = Moment { time_s: 0.0, camera: Attitude::level(observer_yaw), placements };
    let mut luma = vec![0; WIDTH * HEIGHT];
    let truth = world.render_moment(0, &moment, &mut luma, WIDTH).unwrap();
    (luma, truth)
}

fn at(x: f64, y: f64, z: f64) -> Isometry3<f64> {
    Isometry3::translation(x, y, z)
}

#[test]
fn the_same_seed_gives_the_same_bytes() {
    let (mut one, mut two) = (world_with(2, |_| ()).unwrap(), world_with(2, |_| ()).unwrap());
    // In another order too: nothing is left behind from frame to frame.
    render(&mut two, 900);
    for frame in [0, 7, 12_345] {
        let (first, second) = (render(&mut one, frame), render(&mut two, frame));
        assert!(first.0 == second.0, "frame {frame} differs");
        assert_eq!(first.1, second.1);
    }
    let mut other = world_with(2, |p| p.seed = 2).unwrap();
    assert_ne!(render(&mut one, 0).1.bodies, render(&mut other, 0).1.bodies);
    assert_ne!(render(&mut one, 3).0, render(&mut one, 4).0);
}

#[test]
fn every_pixel_is_written_and_nothing_between_rows() {
    let mut world = world_with(1, |_| ()).unwrap();
    let stride = WIDTH + 13;
    let (mut on_black, mut on_white) = (vec![0; stride * HEIGHT], vec![255; stride * HEIGHT]);
    world.render(5, &mut on_black, stride).unwrap();
    world.render(5, &mut on_white, stride).unwrap();
    for (black, white) in on_black.chunks(stride).zip(on_white.chunks(stride)) {
        assert_eq!(black[..WIDTH], white[..WIDTH]);
        assert!(black[WIDTH..].iter().all(|&x| x == 0) && white[WIDTH..].iter().all(|&x| x == 255));
    }
}

#[test]
fn a_body_over_the_seam_is_the_same_body_ahead() {
    let mut world = world_with(2, |p| (p.iso, p.airframes) = (0, false)).unwrap();
    let poses = [at(0.6, 0.05, 0.1), at(-0.2, 0.1, 0.9)];
    // The observer turns by half a round: the world stays, and the picture moves by half of it.
    let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), PI);
    let (ahead, _) = render_poses(&mut world, 0.0, &poses);
    let (behind, _) = render_poses(&mut world, -PI, &poses.map(|pose| turn * pose));
    for row in 0..HEIGHT {
        for column in 0..WIDTH {
            let here = ahead[row * WIDTH + column];
            let there = behind[row * WIDTH + (column + WIDTH / 2) % WIDTH];
            assert!(here.abs_diff(there) <= 1, "{column} {row}: {here} {there}");
        }
    }
}

#[test]
fn a_body_overhead_is_the_same_body_turned() {
    // Black and white are the print's, so what the light does cancels in cells' order of levels.
    let mut world = world_with(1, |p| (p.iso, p.airframes) = (0, false)).unwrap();
    let camera = Equirectangular { width: WIDTH as u32, height: HEIGHT as u32 };
    let ahead = at(0.3, 0.0, 0.0) * UnitQuaternion::from_euler_angles(0.1, 0.15, 0.2);
    let up = UnitQuaternion::from_axis_angle(&Vector3::y_axis(), -FRAC_PI_2);
    let overhead = up * ahead;
    for pose in [ahead, overhead] {
        let (luma, truth) = render_poses(&mut world, 0.0, &[pose]);
        assert!(truth.bodies[0].markers_visible_90 >= 5);
        let dictionary = Dictionary::load("DICT_5X5_250").unwrap();
        for marker in &body(0).markers {
            let towards_eye = -(pose * marker.centre()).coords;
            if (pose.rotation * marker.normal()).angle(&towards_eye) > 0.8 {
                continue;
            }
            let [origin, right, _, down] = marker.corners;
            let level = |row: i32, column: i32| {
                let (s, t) = ((f64::from(column) + 1.5) / 7.0, (f64::from(row) + 1.5) / 7.0);
                let point: Point3<f64> =
                    pose * (origin + (right - origin) * s + (down - origin) * t);
                let pixel = camera.project(&Unit::new_normalize(point.coords)).0;
                let (u, v) = (pixel.x.round().max(0.0) as usize, pixel.y.round().max(0.0) as usize);
                luma[v.min(HEIGHT - 1) * WIDTH + u.min(WIDTH - 1)]
            };
            let print = dictionary.print(marker.id).unwrap();
            let border = (-1..6).map(|k| level(-1, k).max(level(5, k))).max().unwrap();
            for row in 0..5 {
                for column in 0..5 {
                    let is_white = print.is_white(row + 1, column + 1);
                    let seen = level(row as i32, column as i32);
                    assert_eq!(
                        seen > border.saturating_add(10).max(85),
                        is_white,
                        "marker {} cell {row} {column}: {seen}, border {border}",
                        marker.id
                    );
                }
            }
        }
    }
}

#[test]
fn visibility_is_counted_as_it_is() {
    let mut bare = world_with(1, |p| p.airframes = false).unwrap();
    let count = |world: &mut World, poses: &[Isometry3<f64>]| {
        let truth = render_poses(world, 0.0, poses).1;
        truth
            .bodies
            .into_iter()
            .map(|b| (b.markers_visible_50, b.markers_visible_90))
            .collect::<Vec<_>>()
    };
    // From afar along a belt facet: that one, two beside it, one above and one below it. All other
    // facets show their edge or back.
    assert_eq!(count(&mut bare, &[at(1.0, 0.0, 0.0)]), [(5, 5)]);
    // From below, where the bottom has no marker: the lower ring.
    assert_eq!(count(&mut bare, &[at(0.0, 0.0, 1.0)]), [(4, 4)]);

    // With its airframe, straight from below, nothing whole is left.
    let mut flying = world_with(1, |_| ()).unwrap();
    let (_, truth) = render_poses(&mut flying, 0.0, &[at(0.01, 0.0, 1.0)]);
    assert!(truth.bodies[0].markers_visible_90 < 4, "{:?}", truth.bodies[0]);
    // Behind the observer's own deck there is nothing to see.
    let (_, truth) = render_poses(&mut flying, 0.0, &[at(0.02, 0.0, -0.8)]);
    let hidden = &truth.bodies[0];
    assert_eq!((hidden.markers_visible_50, hidden.localisable), (0, false));
    assert_eq!(hidden.best_side_px, 0.0);

    // One body right behind another is hidden, and the nearer one is not.
    let mut two = world_with(2, |p| p.airframes = false).unwrap();
    assert_eq!(count(&mut two, &[at(1.8, 0.0, 0.0), at(0.6, 0.0, 0.0)]), [(0, 0), (5, 5)]);
}

#[test]
fn a_body_whose_markers_face_away_counts_none() {
    let plate = Body::new("plate", body(0).markers[5..6].to_vec());
    let bodies = Bodies::new("DICT_5X5_250".into(), vec![plate]).unwrap();
    let camera = Camera::equirectangular(1024, 512);
    let parameters = WorldParameters { camera, ..Default::default() };
    let mut world = World::new(parameters, &bodies, &Dictionary::of(&bodies).unwrap()).unwrap();
    // The belt's first marker looks along the body's +x.
    let (_, away) = render_poses(&mut world, 0.0, &[at(1.0, 0.0, 0.0)]);
    let (_, towards) = render_poses(&mut world, 0.0, &[at(-1.0, 0.0, 0.0)]);
    let seen =
        |truth: &FrameTruth| (truth.bodies[0].markers_visible_50, truth.bodies[0].localisable);
    assert_eq!((seen(&away), seen(&towards)), ((0, false), (1, true)));
    // 5 cm seen from 1 m, less the body's own depth, in pixels of the sphere.
    let side = towards.bodies[0].best_side_px;
    let expected = (0.05f64 / (1.0 - 0.075_444)).atan() * 1024.0 / (2.0 * PI);
    assert!((side - expected).abs() < 0.01, "{side} {expected}");
}

#[test]
fn truth_says_where_and_when() {
    let mut world = world_with(1, |p| p.observer_yaw_rate_deg_s = -30.0).unwrap();
    let (_, truth) = render(&mut world, 45);
    assert!((truth.time_s - 1.5).abs() < 1e-12);
    assert!((truth.camera.yaw().to_degrees() + 45.0).abs() < 1e-9);
    let body = &truth.bodies[0];
    // The blur is the way of the centre across the picture while the shutter is open.
    let half = truth.exposure_s / 2.0;
    let [before, after] =
        [1.5 - half, 1.5 + half].map(|t| world.moment(t).placements[0].position());
    let blur = before.angle(&after) * WIDTH as f64 / (2.0 * PI);
    assert!((blur - body.blur_px).abs() < 1e-4, "{blur} {}", body.blur_px);
}

#[test]
fn worlds_that_cannot_be_are_refused_with_reasons() {
    let why = |count, change: fn(&mut WorldParameters)| {
        world_with(count, change).unwrap_err().to_string()
    };
    assert!(why(1, |p| p.frames_per_second = 0.0).contains("frames_per_second 0"));
    assert!(why(1, |p| p.camera = Camera::equirectangular(20_000, 500)).contains("20000x500"));
    assert!(why(1, |p| p.distance_m = [0.1, 2.0]).contains("raise distance_m"));
    assert!(why(3, |p| p.distance_m = [0.3, 0.31]).contains("3 bodies cannot keep apart"));
    let bodies = Bodies::new("DICT_4X4_50".into(), vec![body(0)]).unwrap();
    let dictionary = Dictionary::load("DICT_5X5_250").unwrap();
    let other = World::new(WorldParameters::default(), &bodies, &dictionary);
    assert!(other.unwrap_err().to_string().contains("DICT_4X4_50"));
}

#[test]
fn frames_that_cannot_be_are_refused_with_reasons() {
    let mut world = world_with(1, |_| ()).unwrap();
    let mut luma = vec![0; WIDTH * HEIGHT];
    let needed = WIDTH * HEIGHT;
    assert_eq!(
        world.render(0, &mut luma[1..], WIDTH).unwrap_err(),
        RenderError::Memory { needed, given: needed - 1 }
    );
    assert_eq!(
        world.render(0, &mut luma, WIDTH - 1).unwrap_err(),
        RenderError::Stride { stride: WIDTH - 1, width: WIDTH }
    );
    let mut moment = world.moment(0.0);
    moment.placements[0].camera_from_markers = at(0.05, 0.0, 0.0);
    let error = world.render_moment(0, &moment, &mut luma, WIDTH).unwrap_err();
    assert!(error.to_string().contains("'alpha' is at 0.05 m"), "{error}");
    moment.placements.clear();
    let error = world.render_moment(0, &moment, &mut luma, WIDTH).unwrap_err();
    assert_eq!(error, RenderError::Placements { placed: 0, bodies: 1 });
}
