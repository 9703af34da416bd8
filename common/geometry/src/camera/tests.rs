#![allow(clippy::unwrap_used, clippy::expect_used)]
use std::f64::consts::{FRAC_PI_2, PI};

use nalgebra::{Isometry3, Rotation3, Translation3, Unit, UnitQuaternion};
use proptest::prelude::*;

use super::*;

/// Looks ahead (or back) with the image's up as the camera's.
fn mounted(direction: Vector3<f64>, position_m: Vector3<f64>) -> Isometry3<f64> {
    let right = direction.cross(&Vector3::z());
    let down = direction.cross(&right);
    let axes = Rotation3::from_basis_unchecked(&[right, down, direction]);
    Isometry3::from_parts(
        Translation3::from(position_m),
        UnitQuaternion::from_rotation_matrix(&axes),
    )
}

/// A Theta S as it comes out of its calibration, turned a little: double spheres.
fn double_spheres(offset_m: f64) -> Camera {
    let lens = |ahead: f64, centre: [f64; 2], focal: [f64; 2], xi: f64, alpha: f64| {
        let twist = UnitQuaternion::from_scaled_axis(Vector3::new(0.002, 0.006, -1.57));
        Lens {
            camera_from_lens: mounted(
                Vector3::x() * ahead,
                Vector3::new(ahead * offset_m, 0.002 * offset_m, 0.0),
            ) * twist,
            centre_px: centre.into(),
            circle_px: 310.0,
            field_rad: 190f64.to_radians(),
            focal_px: focal.into(),
            curve: LensCurve::DoubleSphere { xi, alpha },
        }
    };
    let lenses = [
        lens(1.0, [322.1, 317.7], [188.9, 187.4], 0.0024, 0.6605),
        lens(-1.0, [955.4, 320.4], [184.8, 183.5], -0.0207, 0.6521),
    ];
    Camera::new(1280, 640, CameraModel::DualFisheye(lenses)).unwrap()
}

/// Another Theta S, as Kalibr's `omni-radtan` has it.
fn unified() -> Camera {
    let lens = |ahead: f64, centre: [f64; 2], focal: [f64; 2], xi: f64, distortion| Lens {
        camera_from_lens: mounted(Vector3::x() * ahead, Vector3::new(0.006 * ahead, 0.001, 0.0)),
        centre_px: centre.into(),
        circle_px: 305.0,
        field_rad: 194f64.to_radians(),
        focal_px: focal.into(),
        curve: LensCurve::Unified { xi, distortion },
    };
    let lenses = [
        lens(1.0, [319.05, 319.69], [546.73, 541.61], 1.8437, [0.01627, -0.3103, 0.00096, 0.002]),
        lens(-1.0, [957.87, 313.51], [565.93, 561.73], 1.9747, [-0.0258, 0.1678, 0.0094, -0.00098]),
    ];
    Camera::new(1280, 640, CameraModel::DualFisheye(lenses)).unwrap()
}

/// Kannala and Brandt's curve, as OpenCV's `fisheye` calibrates it.
fn polynomials() -> Camera {
    let lens = |ahead: f64, u: f64| Lens {
        camera_from_lens: mounted(Vector3::x() * ahead, Vector3::x() * (0.008 * ahead)),
        centre_px: [u, 958.0].into(),
        circle_px: 940.0,
        field_rad: 200f64.to_radians(),
        focal_px: [560.0, 561.0].into(),
        curve: LensCurve::Equidistant([-0.02, 0.005, -0.003, 0.0004]),
    };
    let lenses = [lens(1.0, 950.0), lens(-1.0, 2880.0)];
    Camera::new(3840, 1920, CameraModel::DualFisheye(lenses)).unwrap()
}

fn cameras() -> Vec<Camera> {
    let lens_distance_m = 0.016;
    let plane = CameraModel::Stereographic { field_rad: 320f64.to_radians() };
    let stitched = CameraModel::Equirectangular { lens_distance_m };
    vec![
        Camera::equirectangular(3840, 1920),
        Camera::new(3840, 1920, stitched).unwrap().at_distance(1.2),
        double_spheres(0.0),
        double_spheres(0.0083).at_distance(0.7),
        polynomials(),
        polynomials().at_distance(2.0),
        unified(),
        unified().at_distance(0.6),
        Camera::new(1920, 1920, plane).unwrap(),
        Camera::new(1280, 800, plane).unwrap(),
    ]
}

fn direction() -> impl Strategy<Value = Ray> {
    (-1.0..1.0f64, 0.0..std::f64::consts::TAU).prop_map(|(z, longitude)| {
        let across = (1.0 - z * z).sqrt();
        Unit::new_normalize(Vector3::new(across * longitude.cos(), across * longitude.sin(), z))
    })
}

/// `angle` of nalgebra loses half the digits of small angles; the chord does not.
fn between(one: &Ray, other: &Ray) -> f64 {
    (one.into_inner() - other.into_inner()).norm()
}

/// How far a thing at `metres` along `ray` lies from where its pixel's ray points.
fn parallax_rad(camera: &Camera, ray: &Ray, metres: f64) -> f64 {
    let pixel = camera.at_distance(metres).project(ray).expect("it is seen");
    let assumed = camera.ray(pixel).expect("it was projected there");
    2.0 * (0.5 * between(&assumed, ray)).asin()
}

proptest! {
    /// From its lens, a thing lies where that lens sees it, whatever distance the camera's rays are
    /// right for.
    #[test]
    fn each_lens_sees_a_thing_from_its_own_place(ray in direction(), metres in 0.3..3.0f64) {
        for camera in cameras() {
            let Some(positions) = camera.lens_positions() else { continue };
            let Some(pixel) = camera.at_distance(metres).project(&ray) else { continue };
            let Some(assumed) = camera.ray(pixel) else { continue };
            let seen = camera.lens_ray(&assumed).expect("a lens shows it");
            let lens = positions[seen.lens];
            let wanted = Unit::new_normalize(ray.into_inner() * metres - lens);
            // Next to the seam the stitched camera's own pixel is shown, and a fisheye may leave it
            // to the other.
            let strip = lens.norm() * (1.0 / metres + camera.nearness()) + 1e-9;
            if seen.from_seam_rad > 2.0 * strip {
                prop_assert!(between(&seen.ray, &wanted) < 1e-7, "{camera:?} {ray:?} {metres}");
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    #[test]
    fn rays_come_back(ray in direction()) {
        for camera in cameras() {
            let Some(pixel) = camera.project(&ray) else {
                let is_plane = matches!(camera.model(), CameraModel::Stereographic { .. });
                prop_assert!(is_plane, "{camera:?} {ray:?}");
                continue;
            };
            let back = camera.ray(pixel).expect("it was projected there");
            // The strip between the lenses of a stitched camera is seen by neither.
            let strip = match camera.model() {
                CameraModel::Equirectangular { lens_distance_m } =>
                    0.5 * lens_distance_m * camera.nearness(),
                _ => 0.0,
            };
            if ray.x.abs() > strip {
                prop_assert!(between(&ray, &back) < 1e-9, "{camera:?} {ray:?} {back:?}");
            } else {
                prop_assert!(between(&ray, &back) < 2.0 * strip, "{camera:?} {ray:?} {back:?}");
            }
        }
    }

    #[test]
    fn pixels_come_back(u in 0.0..1.0f64, v in 0.0..1.0f64) {
        for camera in cameras() {
            let size = [camera.width(), camera.height()].map(f64::from);
            let pixel = SpherePixel::new(u * size[0] - 0.5, v * size[1] - 0.5);
            let Some(ray) = camera.ray(pixel) else { continue };
            let Some(back) = camera.project(&ray) else {
                // A lens' circle may hold more than its field.
                let is_pair = matches!(camera.model(), CameraModel::DualFisheye(_));
                prop_assert!(is_pair, "{camera:?} {pixel:?}");
                continue;
            };
            match camera.model() {
                // What both lenses see comes back in the one whose axis is nearer.
                CameraModel::DualFisheye(_) if (back.0 - pixel.0).norm() > 1.0 => {
                    prop_assert!(camera.ray(back).is_some_and(|other| between(&ray, &other) < 1e-9));
                }
                // Columns run together at the poles.
                CameraModel::Equirectangular { .. } if ray.z.abs() > 0.999 => {}
                _ => prop_assert!((back.0 - pixel.0).norm() < 1e-6, "{camera:?} {pixel:?} {back:?}"),
            }
        }
    }

    /// The definition itself: a point at the distance that the camera is right for is seen where
    /// the lens, at its own place, sees it.
    #[test]
    fn lenses_beside_the_middle_see_from_where_they_sit(ray in direction(), metres in 0.3..5.0f64) {
        let camera = double_spheres(0.0083).at_distance(metres);
        let CameraModel::DualFisheye(lenses) = *camera.model() else { unreachable!() };
        let pixel = camera.project(&ray).expect("the lenses see everything");
        let lens = lenses.iter().find(|lens| lens.holds(pixel)).expect("in a circle");
        let point = nalgebra::Point3::from(ray.into_inner() * metres);
        let seen = lens.camera_from_lens.inverse_transform_point(&point).coords;
        let found = lens.ray(pixel).expect("in the field");
        prop_assert!((found.into_inner() - seen.normalize()).norm() < 1e-9);
    }

    #[test]
    fn parallax_is_what_geometry_says(ray in direction(), metres in 0.4..5.0f64) {
        let camera = Camera::new(
            3840,
            1920,
            CameraModel::Equirectangular { lens_distance_m: 0.016 },
        ).unwrap();
        let far = parallax_rad(&camera, &ray, metres);
        let lens = Vector3::x() * (0.008 / metres * ray.x.signum());
        let expected = (ray.into_inner() - lens).angle(&ray); // within 1e-7
        if ray.x.abs() > 0.05 {
            prop_assert!((far - expected).abs() < 1e-6, "{far} {expected}");
            prop_assert!(parallax_rad(&camera.at_distance(metres), &ray, metres) < 1e-9);
        }
    }
}

#[test]
fn near_the_seam_one_centre_is_wrong_by_what_was_measured() {
    let stitched = CameraModel::Equirectangular { lens_distance_m: 0.016 };
    let camera = Camera::new(3840, 1920, stitched).unwrap();
    let aside = Unit::new_normalize(Vector3::new(0.1, 1.0, 0.0));
    let parallax = parallax_rad(&camera, &aside, 1.0).to_degrees();
    assert!((parallax - 0.456).abs() < 0.01, "{parallax}");
}

#[test]
fn the_stereographic_plane_is_the_papers() {
    let plane = Stereographic::new(1920, 1080, 240f64.to_radians());
    for (u, v) in [(1000.0, 500.0), (700.0, 900.0), (959.5, 539.5), (1300.0, 200.0)] {
        // The paper's x is to the right and y up; its latitude and longitude, in words of atan2.
        let (x, y) = (u - 959.5, 539.5 - v);
        let rho = f64::hypot(x, y);
        let c = 2.0 * (rho / (2.0 * plane.radius_px)).atan();
        let longitude = (x * c.sin()).atan2(rho * c.cos());
        let latitude = if rho > 0.0 { (y * c.sin() / rho).asin() } else { 0.0 };
        let ray = plane.ray(SpherePixel::new(u, v)).unwrap();
        assert!((ray.z.asin() - latitude).abs() < 1e-12);
        assert!((-ray.y.atan2(ray.x) - longitude).abs() < 1e-12);
    }
}

#[test]
fn outside_the_circles_there_is_no_ray() {
    for camera in [double_spheres(0.008), polynomials()] {
        assert_eq!(camera.ray(SpherePixel::new(2.0, 2.0)), None);
        assert_eq!(camera.ray(SpherePixel::new(f64::NAN, 2.0)), None);
    }
    let field_rad = 200f64.to_radians();
    let plane = Camera::new(800, 800, CameraModel::Stereographic { field_rad }).unwrap();
    assert_eq!(plane.ray(SpherePixel::new(3.0, 3.0)), None);
    assert_eq!(plane.project(&-Vector3::x_axis()), None);
    let at = |angle: f64| Unit::new_normalize(Vector3::new(angle.cos(), angle.sin(), 0.0));
    assert!(plane.project(&at(0.5 * field_rad - 1e-6)).is_some());
    assert_eq!(plane.project(&at(0.5 * field_rad + 1e-6)), None);
}

#[test]
fn poles_and_seam_are_defined() {
    let camera = Camera::equirectangular(3840, 1920);
    for pole in [Vector3::z_axis(), -Vector3::z_axis()] {
        let pixel = camera.project(&pole).unwrap();
        assert!(between(&camera.ray(pixel).unwrap(), &pole) < 1e-9);
    }
    let behind = camera.project(&-Vector3::x_axis()).unwrap();
    assert!((behind.0.x + 0.5).abs() < 1e-9, "{behind:?}");
    let almost = Unit::new_normalize(Vector3::new(-1.0, -1e-12, 0.0));
    assert!((-0.5..3839.5).contains(&camera.project(&almost).unwrap().0.x));
    // The axis of a lens, and of the plane.
    for camera in [double_spheres(0.0), polynomials(), unified()] {
        let CameraModel::DualFisheye(lenses) = *camera.model() else { unreachable!() };
        for lens in lenses {
            let axis = lens.camera_from_lens.rotation * Vector3::z_axis();
            let pixel = camera.project(&axis).unwrap();
            assert!((pixel.0 - lens.centre_px).norm() < 1e-5, "{pixel:?}");
            let centre = camera.ray(SpherePixel(lens.centre_px)).unwrap();
            assert!(between(&centre, &axis) < 1e-9);
        }
    }
}

#[test]
fn an_equidistant_lens_is_what_its_name_says() {
    let field_rad = 190f64.to_radians();
    let lens = Lens::equidistant(Isometry3::identity(), [500.0, 400.0].into(), 380.0, field_rad);
    for share in [0.1, 0.5, 0.999] {
        let angle: f64 = share * field_rad / 2.0;
        let seen = lens.project(&Vector3::new(angle.sin(), 0.0, angle.cos())).unwrap();
        assert!((seen.0.x - 500.0 - 380.0 * share).abs() < 1e-9);
    }
    assert!((lens.pixels_per_radian() - 380.0 / (field_rad / 2.0)).abs() < 1e-9);
}

#[test]
fn cameras_that_cannot_be_are_refused() {
    let field_rad = 190f64.to_radians();
    let good =
        |u: f64| Lens::equidistant(Isometry3::identity(), [u, 319.5].into(), 300.0, field_rad);
    let new = |one, other| Camera::new(1280, 640, CameraModel::DualFisheye([one, other]));
    assert!(new(good(319.5), good(959.5)).is_ok());
    let moved = Lens { centre_px: [290.0, 319.5].into(), ..good(319.5) };
    assert!(matches!(new(moved, good(959.5)), Err(CameraError::CircleOutside { lens: 0, .. })));
    assert!(matches!(new(good(319.5), good(900.0)), Err(CameraError::CirclesOverlap { .. })));
    let bent = Lens { curve: LensCurve::Equidistant([-0.3, 0.0, 0.0, 0.0]), ..good(959.5) };
    let error = new(good(319.5), bent).unwrap_err();
    assert!(
        matches!(error, CameraError::Curve { lens: 1, angle_deg, .. } if angle_deg > 50.0 && angle_deg < 70.0),
        "{error}"
    );
    for lens in [
        Lens { circle_px: f64::NAN, ..good(959.5) },
        Lens { field_rad: 0.0, ..good(959.5) },
        Lens { focal_px: [f64::INFINITY, 10.0].into(), ..good(959.5) },
        Lens { curve: LensCurve::DoubleSphere { xi: 0.1, alpha: 1.5 }, ..good(959.5) },
        Lens { camera_from_lens: Isometry3::translation(0.0, f64::NAN, 0.0), ..good(959.5) },
        Lens { centre_px: [f64::NAN, 0.0].into(), ..good(959.5) },
    ] {
        assert!(new(good(319.5), lens).is_err(), "{lens:?}");
    }
    for field_rad in [0.0, 2.0 * PI, f64::NAN] {
        assert!(Camera::new(640, 640, CameraModel::Stereographic { field_rad }).is_err());
    }
    for lens_distance_m in [-0.1, 2.0, f64::NAN] {
        let stitched = CameraModel::Equirectangular { lens_distance_m };
        assert!(Camera::new(640, 320, stitched).is_err());
    }
}

#[test]
fn impossible_distances_are_brought_into_reach() {
    let camera = double_spheres(0.0083);
    for metres in [0.0, -1.0, 1e-9] {
        let near = camera.at_distance(metres);
        let ray = Unit::new_normalize(Vector3::new(1.0, FRAC_PI_2, -0.2));
        let pixel = near.project(&ray).unwrap();
        assert!(between(&near.ray(pixel).unwrap(), &ray) < 1e-9);
    }
    assert_eq!(camera.at_distance(f64::NAN), camera);
    assert_eq!(camera.at_distance(f64::INFINITY), camera);
}
