//! Pictures of all cameras. Printed edges land where the projections in `sheet` put them, or those
//! in `edges` for the plain sphere. Markers that no lens sees are not counted.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod edges;
mod sheet;

use std::f64::consts::{FRAC_PI_2, PI};

use flockeye_dictionary::Dictionary;
use flockeye_geometry::body::{Bodies, Body, Marker, squares};
use flockeye_geometry::camera::{Camera, SpherePixel};
use flockeye_simulator::{Attitude, FrameTruth, Moment, Placement, World, WorldParameters};
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

use crate::sheet::{
    Fisheye, Kind, Sheet, double_sphere, equidistant, kannala_brandt, plane, stitched,
    stitched_and_stretched,
};

impl Sheet {
    fn world(&self, count: u32) -> World {
        world_of(count, quiet(self.camera()))
    }

    fn render(&self, world: &mut World, placements: Vec<Placement>) -> (Vec<u8>, FrameTruth) {
        let mut luma = vec![0; (self.width * self.height) as usize];
        let moment = Moment { time_s: 0.0, camera: Attitude::level(0.4), placements };
        let truth = world.render_moment(0, &moment, &mut luma, self.width as usize).unwrap();
        (luma, truth)
    }
}

/// A still camera without noise.
fn quiet(camera: Camera) -> WorldParameters {
    WorldParameters {
        camera,
        iso: 0,
        observer_yaw_rate_deg_s: 0.0,
        airframes: false,
        ..Default::default()
    }
}

fn world_of(count: u32, parameters: WorldParameters) -> World {
    let bodies = Bodies::new("DICT_5X5_250".into(), (0..count).map(body).collect()).unwrap();
    World::new(parameters, &bodies, &Dictionary::of(&bodies).unwrap()).unwrap()
}

fn body(index: u32) -> Body {
    squares(["alpha", "bravo"][index as usize], 0.0625, 0.05, 17 * index)
}

fn still(camera_from_markers: Isometry3<f64>) -> Placement {
    Placement { camera_from_markers, velocity_in_camera: Vector3::zeros() }
}

/// Linear light of the pixels. Written from the sRGB standard, not taken from the renderer.
fn light_of(luma: &[u8]) -> Vec<f64> {
    let linear = |level: &u8| {
        let s = f64::from(*level) / 255.0;
        if s <= 0.04045 { s / 12.92 } else { ((s + 0.055) / 1.055).powf(2.4) }
    };
    luma.iter().map(linear).collect()
}

/// Linear light between the pixels.
struct Picture<'a> {
    sheet: &'a Sheet,
    light: Vec<f64>,
}

impl Picture<'_> {
    fn at(&self, [u, v]: [f64; 2]) -> f64 {
        let width = i64::from(self.sheet.width);
        let (column, row) = (u.floor() as i64, v.floor() as i64);
        let get = |column: i64, row: i64| {
            // Only the sphere goes round; the others' borders are never asked for.
            self.light[(row * width + column.rem_euclid(width)) as usize]
        };
        let (s, t) = (u - u.floor(), v - v.floor());
        (get(column, row) * (1.0 - s) + get(column + 1, row) * s) * (1.0 - t)
            + (get(column, row + 1) * (1.0 - s) + get(column + 1, row + 1) * s) * t
    }

    /// Distance by which the edge between corners `k` and `k + 1` appears outside of its true place
    /// for eye `eye`, pixels. `None` if the eye does not see all of it.
    fn edge_error(
        &self,
        eye: usize,
        pose: &Isometry3<f64>,
        marker: &Marker,
        k: usize,
    ) -> Option<f64> {
        let (from, to) = (marker.corners[k], marker.corners[(k + 1) % 4]);
        let outwards = marker.normal().cross(&(to - from)).normalize();
        let place = |share: f64, out_m: f64| {
            let point = pose * (from + (to - from) * share + outwards * out_m);
            self.sheet.project(eye, &point, 8.0)
        };
        let reach = 0.0028;
        let mut sum = 0.0;
        for i in 0..60 {
            let share = 0.15 + 0.7 * f64::from(i) / 59.0;
            let profile: Vec<f64> = (-40..=40)
                .map(|step| Some(self.at(place(share, reach * f64::from(step) / 40.0)?)))
                .collect::<Option<_>>()?;
            let middle = (profile[0] + profile[80]) / 2.0;
            let crossing = (0..80).find(|&at| profile[at + 1] > middle).expect("dark to light");
            let (below, above) = (profile[crossing], profile[crossing + 1]);
            let step = crossing as f64 - 40.0 + (middle - below) / (above - below);
            let ([u, v], [found_u, found_v]) =
                (place(share, 0.0)?, place(share, reach * step / 40.0)?);
            sum += (found_u - u).hypot(found_v - v).copysign(step);
        }
        Some(sum / 60.0)
    }
}

fn placed([azimuth, elevation]: [f64; 2], turn: [f64; 3]) -> Isometry3<f64> {
    let (sin_az, cos_az) = azimuth.to_radians().sin_cos();
    let (sin_el, cos_el) = elevation.to_radians().sin_cos();
    let direction = Vector3::new(cos_el * cos_az, cos_el * sin_az, sin_el);
    Isometry3::from_parts(
        // Near enough that half a quiet zone is wider than the blur.
        Translation3::from(direction * 0.25),
        UnitQuaternion::from_euler_angles(turn[0], turn[1], turn[2]),
    )
}

/// Errors of all edges of markers that an eye has before it, as seen from there.
fn edge_errors(sheet: &Sheet, world: &mut World, placement: Placement) -> Vec<Vec<f64>> {
    let (luma, _) = sheet.render(world, vec![placement]);
    let picture = Picture { sheet, light: light_of(&luma) };
    let pose = placement.camera_from_markers;
    let eyes = sheet.eyes().into_iter().enumerate();
    eyes.map(|(index, eye)| {
        let facing = |marker: &&Marker| {
            let towards_eye = eye - pose * marker.centre();
            (pose.rotation * marker.normal()).angle(&towards_eye).to_degrees() < 45.0
        };
        let body = body(0);
        body.markers
            .iter()
            .filter(facing)
            .flat_map(|marker| (0..4).map(move |k| (marker, k)))
            .filter_map(|(marker, k)| picture.edge_error(index, &pose, marker, k))
            .collect()
    })
    .collect()
}

/// Directions (azimuth, elevation), degrees: straight ahead, off the axis, across the border of
/// the lenses on all sides of it, back.
const DIRECTIONS: [[f64; 2]; 11] = [
    [0.0, 0.0],
    [35.0, 20.0],
    [62.0, -30.0],
    [83.0, 5.0],
    [-85.0, -20.0],
    [90.0, 0.0],
    [100.0, 40.0],
    [10.0, 84.0],
    [-170.0, -82.0],
    [180.0, 0.0],
    [-140.0, 30.0],
];

fn assert_exact(sheet: Sheet, velocity_in_camera: Vector3<f64>) {
    let mut world = sheet.world(1);
    // Counts per eye: edges anywhere, and edges of bodies within 10 degrees of the lenses' border.
    let mut measured = vec![[0; 2]; sheet.eyes().len()];
    for (index, direction) in DIRECTIONS.into_iter().enumerate() {
        let camera_from_markers = placed(direction, [0.3, -0.2, 0.7 * index as f64]);
        let placement = Placement { camera_from_markers, velocity_in_camera };
        let by_eye = edge_errors(&sheet, &mut world, placement);
        let errors: Vec<f64> = by_eye.iter().flatten().copied().collect();
        if errors.is_empty() {
            continue;
        }
        let is_at_border =
            camera_from_markers.translation.x.abs() < 0.25 * 10f64.to_radians().sin();
        for (sums, errors) in measured.iter_mut().zip(&by_eye) {
            sums[0] += errors.len();
            sums[1] += if is_at_border { errors.len() } else { 0 };
        }
        let worst = errors.iter().fold(0.0f64, |worst, error| worst.max(error.abs()));
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        let counts: Vec<usize> = by_eye.iter().map(Vec::len).collect();
        println!("{direction:?}: {counts:?} edges, worst {worst:.4} mean {mean:.4}");
        assert!(worst < 0.05 && mean.abs() < 0.02, "{direction:?}: worst {worst}, mean {mean} px");
    }
    assert!(measured.iter().all(|sums| sums[0] >= 12 && sums[1] >= 1), "{measured:?} edges");
}

#[test]
fn equidistant_lenses_see_edges_where_they_are() {
    assert_exact(equidistant(), Vector3::zeros());
}

#[test]
fn kannala_brandt_lenses_apart_see_edges_where_they_are() {
    assert_exact(kannala_brandt(), Vector3::zeros());
}

#[test]
fn double_sphere_lenses_apart_see_edges_where_they_are() {
    assert_exact(double_sphere(), Vector3::zeros());
}

#[test]
fn the_stereographic_plane_shows_edges_where_they_are() {
    assert_exact(plane(), Vector3::zeros());
}

#[test]
fn a_stitched_sphere_shows_edges_where_each_lens_sees_them() {
    assert_exact(stitched(), Vector3::zeros());
}

#[test]
fn an_image_of_any_sides_shows_edges_where_they_are() {
    assert_exact(stitched_and_stretched(), Vector3::zeros());
}

#[test]
fn a_moving_body_is_where_it_is_at_mid_exposure() {
    // Up to 1.5 pixels of motion blur.
    for sheet in [kannala_brandt(), plane(), stitched()] {
        assert_exact(sheet, Vector3::new(0.12, -0.1, 0.11));
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes_with_every_camera() {
    for sheet in [kannala_brandt(), double_sphere(), plane(), stitched(), stitched_and_stretched()]
    {
        let sheet = sheet.quartered();
        let world = |seed| {
            let parameters = WorldParameters { seed, camera: sheet.camera(), ..Default::default() };
            world_of(2, parameters)
        };
        let stride = sheet.width as usize + 13;
        let render = |world: &mut World, frame: u64, filler: u8| {
            let mut luma = vec![filler; stride * sheet.height as usize];
            let truth = world.render(frame, &mut luma, stride).unwrap();
            (luma, truth)
        };
        let (mut one, mut two) = (world(1), world(1));
        // In another order too: nothing is left behind from frame to frame.
        render(&mut two, 900, 0);
        for frame in [0, 77] {
            let (first, second) = (render(&mut one, frame, 0), render(&mut two, frame, 255));
            assert_eq!(first.1, second.1);
            for (black, white) in first.0.chunks(stride).zip(second.0.chunks(stride)) {
                let (black, white) = (black.split_at(stride - 13), white.split_at(stride - 13));
                assert!(black.0 == white.0, "frame {frame} differs");
                assert!(black.1.iter().all(|&x| x == 0) && white.1.iter().all(|&x| x == 255));
            }
        }
        assert_ne!(render(&mut one, 3, 0).0, render(&mut one, 4, 0).0);
        assert_ne!(render(&mut one, 3, 0).0, render(&mut world(2), 3, 0).0);
    }
}

#[test]
fn outside_the_circles_it_is_black() {
    for sheet in [kannala_brandt(), plane()].map(Sheet::quartered) {
        let (luma, _) =
            sheet.render(&mut sheet.world(1), vec![still(placed([60.0, 10.0], [0.0; 3]))]);
        let camera = sheet.camera();
        let mut black = 0;
        for (index, level) in luma.into_iter().enumerate() {
            let at = [index % sheet.width as usize, index / sheet.width as usize];
            let [u, v] = at.map(|side| side as f64);
            let is_seen = camera.ray(SpherePixel::new(u, v)).is_some();
            assert_eq!(level > 0, is_seen, "{at:?}");
            black += usize::from(!is_seen);
        }
        assert!(black > 6_000, "{black}");
    }
}

/// Visible markers, at least half and at least nine tenths of each. What is visible does not
/// depend on the image's size.
fn counted(sheet: &Sheet, poses: &[Isometry3<f64>]) -> Vec<[u32; 2]> {
    let sheet = sheet.quartered();
    let mut world = sheet.world(poses.len() as u32);
    let (_, truth) = sheet.render(&mut world, poses.iter().copied().map(still).collect());
    truth.bodies.iter().map(|body| [body.markers_visible_50, body.markers_visible_90]).collect()
}

#[test]
fn visibility_is_counted_as_each_camera_sees() {
    let at = |x: f64, y: f64, z: f64| Isometry3::translation(x, y, z);
    let narrow = |field_deg: f64, sheet: Sheet| {
        let Kind::Fisheyes(lenses) = sheet.kind else { unreachable!() };
        let lenses = lenses.map(|lens| Fisheye { field_deg, ..lens });
        Sheet { kind: Kind::Fisheyes(lenses), ..sheet }
    };
    for sheet in [equidistant(), kannala_brandt(), double_sphere(), plane(), stitched()] {
        // The same counts as for the plain sphere, in `frames.rs`.
        assert_eq!(counted(&sheet, &[at(1.0, 0.0, 0.0)]), [[5, 5]]);
        // One body right behind another is hidden, and the nearer one is not.
        assert_eq!(counted(&sheet, &[at(1.8, 0.0, 0.0), at(0.6, 0.0, 0.0)]), [[0, 0], [5, 5]]);
    }
    for sheet in [equidistant(), kannala_brandt(), double_sphere()] {
        // Both lenses see it: it is counted once.
        assert_eq!(counted(&sheet, &[at(0.0, 3.0, 0.0)]), [[5, 5]]);
        // Between the fields of narrow lenses nobody sees it; ahead, one does.
        let sheet = narrow(150.0, sheet);
        assert_eq!(counted(&sheet, &[at(0.0, 1.0, 0.0)]), [[0, 0]]);
        assert_eq!(counted(&sheet, &[at(1.0, 0.0, 0.0)]), [[5, 5]]);
    }
    // 240 degrees do not reach straight back, nor 28 degrees from there.
    assert_eq!(counted(&plane(), &[at(-1.0, 0.0, 0.0)]), [[0, 0]]);
    assert_eq!(counted(&plane(), &[at(-1.0, 0.5, 0.0)]), [[0, 0]]);
    // Over the circle's rim at 120 degrees only some of its markers are left.
    let azimuth = 120f64.to_radians();
    let [[half, whole]] = counted(&plane(), &[at(azimuth.cos(), azimuth.sin(), 0.0)])[..] else {
        unreachable!()
    };
    assert!((1..5).contains(&half) && whole < 5, "{half} {whole}");
    // The strip between the lenses of a stitched camera takes the markers in the middle.
    let [[half, whole]] = counted(&stitched(), &[at(0.0, 1.0, 0.0)])[..] else { unreachable!() };
    assert!(half < 5 && whole <= 2, "{half} {whole}");
}

#[test]
fn what_hides_from_the_middle_may_not_hide_from_a_lens() {
    let behind =
        |gap: f64| [Isometry3::translation(0.0, 1.2, gap), Isometry3::translation(0.0, 0.5, 0.0)];
    let sheet = |aside_m: f64| {
        let lens = |ahead: f64, u: f64| Fisheye::new(ahead, aside_m, [u, 479.5], 479.0, 286.0);
        let kind = Kind::Fisheyes([lens(1.0, 479.5), lens(-1.0, 1439.5)]);
        Sheet { width: 1920, height: 960, kind }
    };
    assert_eq!(counted(&sheet(0.0), &behind(0.0))[0], [0, 0]);
    // From 0.2 m aside the two lie 13 degrees apart.
    let [half, _] = counted(&sheet(0.2), &behind(0.0))[0];
    assert!(half > 0, "{half}");
}

#[test]
fn sizes_and_blur_are_in_pixels_of_the_image() {
    let azimuth: f64 = 70f64.to_radians();
    let towards = Vector3::new(azimuth.cos(), azimuth.sin(), 0.0);
    let pose = Isometry3::from_parts(
        Translation3::from(towards),
        UnitQuaternion::from_axis_angle(&Vector3::z_axis(), azimuth + PI),
    );
    let velocity_in_camera = Vector3::new(-towards.y, towards.x, 0.0) + towards;
    for sheet in [equidistant(), plane()] {
        let placement = Placement { camera_from_markers: pose, velocity_in_camera };
        let (_, truth) = sheet.render(&mut sheet.world(1), vec![placement]);
        let body_truth = &truth.bodies[0];
        let pixel = |point: &Point3<f64>| sheet.project(0, point, 0.0).unwrap();
        let distance = |[a, b]: [f64; 2], [c, d]: [f64; 2]| (c - a).hypot(d - b);
        let largest = body(0)
            .markers
            .iter()
            .filter(|marker| (pose.rotation * marker.normal()).dot(&towards) < -0.2)
            .map(|marker| {
                let corners = marker.corners.map(|corner| pixel(&(pose * corner)));
                (0..4).map(|k| distance(corners[k], corners[(k + 1) % 4])).sum::<f64>() / 4.0
            })
            .fold(0.0, f64::max);
        assert!((body_truth.best_side_px / largest - 1.0).abs() < 1e-6);
        let half = velocity_in_camera * (truth.exposure_s / 2.0);
        let ends = [-half, half].map(|way| pixel(&Point3::from(towards + way)));
        let blur = distance(ends[0], ends[1]);
        // The density is that of the nearest tile.
        assert!((body_truth.blur_px / blur - 1.0).abs() < 0.03, "{} {blur}", body_truth.blur_px);
        assert!(azimuth < FRAC_PI_2 && blur > 1.0);
    }
}
