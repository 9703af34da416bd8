//! Alignment against pictures that are rendered by sampling, blurred and encoded as by a camera.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod derivatives;
#[path = "../../tests/drawn_body/mod.rs"]
pub(super) mod drawn_body;
mod halves;
mod hidden;

use flockeye_geometry::body::{Body, squares};
use flockeye_geometry::pose::PoseEstimate;
use flockeye_geometry::view::View;
use nalgebra::{Isometry3, Matrix2, Point3, Translation3, UnitQuaternion, Vector2, Vector3};
use proptest::prelude::*;

use super::model::blurred::BlurredFacet;
use super::model::geometry::visible_facets;
use super::model::{Modelled, Scene, model};
use super::pinhole::Pinhole;
use super::*;
use crate::image::LumaImage;
use crate::light::{CodeRange, LinearLight, TransferCurve};
use drawn_body::{Drawing, draw, prints};

pub(super) fn body(first_id: u32) -> Body {
    squares("alpha", 0.0625, 0.05, first_id)
}

pub(super) fn print_of(body: &Body) -> BodyPrint {
    let prints = prints();
    BodyPrint::new(body, |id| prints.get(&id)).unwrap()
}

pub(super) fn srgb() -> LinearLight {
    LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap()
}

fn pose(range_m: f64, euler: [f64; 3]) -> Isometry3<f64> {
    let direction = Vector3::new(0.8, 0.5, 0.33).normalize();
    Isometry3::from_parts(
        Translation3::from(direction * range_m),
        UnitQuaternion::from_euler_angles(euler[0], euler[1], euler[2]),
    )
}

fn moved(pose: &Isometry3<f64>, shift: Vector3<f64>, turn: Vector3<f64>) -> Isometry3<f64> {
    Isometry3::from_parts(
        Translation3::from(pose.translation.vector + shift),
        UnitQuaternion::from_scaled_axis(turn) * pose.rotation,
    )
}

pub(super) const PIXELS_PER_RADIAN: f64 = 611.0;

fn run(
    drawing: &Drawing,
    print: &BodyPrint,
    start: &Isometry3<f64>,
) -> Result<Alignment, AlignError> {
    let light = srgb();
    let picture = Picture::still(drawing.image(), drawing.view, &light, PIXELS_PER_RADIAN);
    align(print, &picture, start, &AlignOptions::default())
}

#[test]
fn a_start_nearby_converges_to_the_truth() {
    let print = print_of(&body(0));
    for (range_m, tolerance_m, tolerance_rad) in
        [(0.6, 0.5e-3, 2e-3), (1.0, 1e-3, 3e-3), (2.0, 4e-3, 8e-3), (2.8, 10e-3, 0.02)]
    {
        let truth = pose(range_m, [0.3, -0.2, 0.9]);
        let drawing = draw(&body(0), &truth, PIXELS_PER_RADIAN, 0.9, 0.004);
        let sight = truth.translation.vector.normalize();
        let shift = sight * (0.01 * range_m) + Vector3::new(0.0, 0.0, 1e-3);
        let start = moved(&truth, shift, Vector3::new(0.01, -0.015, 0.01));
        let found = run(&drawing, &print, &start).expect("it is there");
        let error = found.camera_from_markers.translation.vector - truth.translation.vector;
        let turned = found.camera_from_markers.rotation.angle_to(&truth.rotation);
        println!(
            "{range_m} m: {:.3} mm, {:.4} rad, {:?}, sigma {:.3} mm",
            error.norm() * 1e3,
            turned,
            found.evidence,
            found.covariance.fixed_view::<3, 3>(0, 0).trace().sqrt() * 1e3
        );
        assert!(error.norm() < tolerance_m, "{} m at {range_m} m", error.norm());
        assert!(turned < tolerance_rad, "{turned} rad at {range_m} m");
        assert!(found.evidence.correlation > 0.7, "{:?}", found.evidence);
    }
}

/// What video coding does to a pose shows in no residual, and does not count for whether it is a
/// measurement.
#[test]
fn a_pose_in_video_is_less_certain_and_as_precise() {
    let print = print_of(&body(0));
    let truth = pose(2.0, [0.3, -0.2, 0.9]);
    let drawing = draw(&body(0), &truth, PIXELS_PER_RADIAN, 0.9, 0.004);
    let light = srgb();
    let picture = Picture::still(drawing.image(), drawing.view, &light, PIXELS_PER_RADIAN);
    let aligned = |coding_covariance_scale, covariance_scale| {
        let options =
            AlignOptions { coding_covariance_scale, covariance_scale, ..AlignOptions::default() };
        align(&print, &picture, &truth, &options).expect("it is there")
    };
    let [image, video] = [1.0, VIDEO_COVARIANCE_SCALE].map(|of_coding| aligned(of_coding, 1.0));
    assert_eq!(image.camera_from_markers, video.camera_from_markers);
    let ratio = video.covariance[(4, 4)] / image.covariance[(4, 4)];
    assert!((ratio - VIDEO_COVARIANCE_SCALE).abs() < 1e-9, "{ratio}");
    // With a scale by which the picture's own covariance is just precise.
    let is_precise_with = |scale: &f64| aligned(1.0, *scale).is_precise;
    let scales: Vec<f64> = (0..12).map(|power| 2f64.powi(power)).collect();
    let scale = *scales.iter().rfind(|scale| is_precise_with(scale)).expect("the first is small");
    assert!(!is_precise_with(scales.last().expect("there are twelve")));
    let video = aligned(VIDEO_COVARIANCE_SCALE, scale);
    assert!(video.is_precise && !is_precise(&video.covariance), "with a scale of {scale}");
}

/// A prediction with these deviations (m, rad) of each axis, off by as much as they say.
fn predicted_beside(truth: &Isometry3<f64>, position_m: f64, rotation_rad: f64) -> PoseEstimate {
    let shift = Vector3::new(0.7, -0.5, 0.5).normalize() * position_m * 3f64.sqrt();
    let turn = Vector3::new(-0.4, 0.8, 0.4).normalize() * rotation_rad * 3f64.sqrt();
    let [p, r] = [position_m.powi(2), rotation_rad.powi(2)];
    PoseEstimate {
        camera_from_markers: moved(truth, shift, turn),
        covariance: Matrix6::from_diagonal(&[p, p, p, r, r, r].into()),
    }
}

/// Alignment from a prediction, with it as a guide and without.
fn guided_and_free(
    drawing: &Drawing,
    print: &BodyPrint,
    predicted: PoseEstimate,
) -> [Option<Alignment>; 2] {
    let light = srgb();
    let picture = Picture::still(drawing.image(), drawing.view, &light, PIXELS_PER_RADIAN);
    [Some(predicted), None].map(|guide| {
        let options = AlignOptions { predicted: guide, ..AlignOptions::default() };
        align(print, &picture, &predicted.camera_from_markers, &options).ok()
    })
}

#[test]
fn a_prediction_has_no_part_in_what_a_clear_picture_measures() {
    let print = print_of(&body(0));
    let truth = pose(1.0, [0.3, -0.2, 0.9]);
    let drawing = draw(&body(0), &truth, PIXELS_PER_RADIAN, 0.9, 0.004);
    let predicted = predicted_beside(&truth, 2e-3, 0.01);
    let [guided, free] = guided_and_free(&drawing, &print, predicted).map(Option::unwrap);
    let apart =
        guided.camera_from_markers.translation.vector - free.camera_from_markers.translation.vector;
    assert!(apart.norm() < 3e-4, "{} mm apart", apart.norm() * 1e3);
    let turned = guided.camera_from_markers.rotation.angle_to(&free.camera_from_markers.rotation);
    assert!(turned < 1e-3, "{turned} rad");
}

#[test]
fn a_prediction_keeps_a_fit_to_a_blurred_picture_near() {
    let print = print_of(&body(0));
    let mut errors = [Vec::new(), Vec::new()];
    for k in 0..12 {
        let truth = pose(1.1, [0.3, -0.2, 0.5 * f64::from(k)]);
        let drawing = draw(&body(0), &truth, PIXELS_PER_RADIAN, 5.0, 0.01);
        let predicted = predicted_beside(&truth, 0.01, 0.05);
        for (k, found) in guided_and_free(&drawing, &print, predicted).into_iter().enumerate() {
            let turned_rad = found.map_or(f64::INFINITY, |found| {
                found.camera_from_markers.rotation.angle_to(&truth.rotation)
            });
            errors[k].push(turned_rad.min(0.5));
        }
    }
    let [guided, free] = errors.each_ref().map(|errors| errors.iter().sum::<f64>());
    assert!(guided < 0.8 * free, "radians, guided and free: {errors:.3?}");
}

/// At the true pose the model is the picture, but for noise; beside it, it is not.
#[test]
fn a_depiction_is_the_picture_at_the_true_pose() {
    let print = print_of(&body(0));
    let truth = pose(0.8, [0.3, -0.2, 0.9]);
    let drawing = draw(&body(0), &truth, PIXELS_PER_RADIAN, 0.9, 0.004);
    let light = srgb();
    let picture = Picture::still(drawing.image(), drawing.view, &light, PIXELS_PER_RADIAN);
    let rms = |pose: &Isometry3<f64>| {
        let shown = depict(&print, &picture, pose, &AlignOptions::default()).expect("it is there");
        assert_eq!(shown.picture.len(), shown.width * shown.height);
        // Elsewhere the model is the picture itself.
        let body = (0..shown.picture.len()).filter(|&k| shown.picture[k] != shown.model[k]);
        let squares = body.map(|k| (shown.picture[k] - shown.model[k]).powi(2));
        let squares: Vec<f32> = squares.collect();
        assert!(squares.len() > 500, "{} pixels of the body", squares.len());
        let rms = (squares.iter().sum::<f32>() / squares.len() as f32).sqrt();
        (rms, shown.evidence)
    };
    let (right, evidence) = rms(&truth);
    let across = Vector3::new(-0.5, 0.8, 0.0).normalize() * 0.008;
    let (wrong, doubts) = rms(&moved(&truth, across, Vector3::zeros()));
    println!("{right} {wrong} {evidence:?} {doubts:?}");
    assert!(right < 0.03, "{right} of white at the true pose");
    assert!(wrong > 4.0 * right, "{wrong} of white beside it, {right} at the true pose");
    assert!(evidence.correlation > 0.9 && evidence.correlation > doubts.correlation + 0.1);
    let behind = moved(&truth, -2.0 * truth.translation.vector, Vector3::zeros());
    assert!(depict(&print, &picture, &behind, &AlignOptions::default()).is_err());
}

/// The drawing as a camera takes it that exposes it longer by so many stops: clipped after it was
/// blurred.
pub(super) fn exposed(drawing: &Drawing, stops: f64) -> Drawing {
    let light = srgb();
    let code = |code: u8| {
        let radiance = f64::from(light.of(code)) * stops.exp2();
        (0..=255).rev().find(|brighter| f64::from(light.of(*brighter)) <= radiance).unwrap_or(0)
    };
    let codes: Vec<u8> = (0..=255).map(code).collect();
    let pixels = drawing.pixels.iter().map(|code| codes[usize::from(*code)]).collect();
    Drawing { pixels, view: drawing.view }
}

/// White is saturated from a stop on, and its blur has grown over black cells.
#[test]
fn pictures_that_are_too_bright_or_too_dark_give_the_pose_too() {
    let print = print_of(&body(0));
    for (range_m, most_m) in [(0.8, 2e-3), (1.6, 6e-3), (2.4, 20e-3)] {
        let truth = pose(range_m, [0.3, -0.2, 0.9]);
        let drawing = draw(&body(0), &truth, PIXELS_PER_RADIAN, 0.9, 0.002);
        let start = moved(&truth, truth.translation.vector * 0.005, Vector3::repeat(0.01));
        for stops in [-4.0, -2.0, 1.0, 2.0, 3.0] {
            let found = run(&exposed(&drawing, stops), &print, &start).expect("it is there");
            let error = found.camera_from_markers.translation.vector - truth.translation.vector;
            let is_found = found.is_accepted_with_track_prior(0.0);
            assert!(is_found, "{range_m} m, {stops} stops: {found:?}");
            assert!(error.norm() < most_m, "{range_m} m, {stops} stops: {} m", error.norm());
        }
    }
}

#[test]
fn another_body_does_not_correlate() {
    let wrong = print_of(&body(17));
    for range_m in [0.8, 1.5, 2.5] {
        let truth = pose(range_m, [0.3, -0.2, 0.9]);
        let drawing = draw(&body(0), &truth, PIXELS_PER_RADIAN, 0.9, 0.004);
        if let Ok(found) = run(&drawing, &wrong, &truth) {
            assert!(found.evidence.correlation < 0.35, "{range_m} m: {:?}", found.evidence);
        }
    }
}

/// The drawing with code values smoothed along both axes, with a variance of a quarter of a pixel
/// squared.
fn smoothed(drawing: &Drawing) -> Drawing {
    let side = drawing.view.size_px as usize;
    let line = |pixels: &[f64], step: usize| -> Vec<f64> {
        let smooth = |k: usize| match (pixels.get(k.wrapping_sub(step)), pixels.get(k + step)) {
            (Some(before), Some(after)) => (before + after + 6.0 * pixels[k]) / 8.0,
            _ => pixels[k],
        };
        (0..pixels.len()).map(smooth).collect()
    };
    let pixels: Vec<f64> = drawing.pixels.iter().map(|&code| f64::from(code)).collect();
    let pixels = line(&line(&pixels, 1), side).iter().map(|code| code.round() as u8).collect();
    Drawing { pixels, view: drawing.view }
}

#[test]
fn smoothed_code_values_do_not_bias_the_range() {
    let print = print_of(&body(0));
    let (mut sum_m, mut count) = (0.0, 0.0);
    for turn in 0..8 {
        let truth = pose(1.9, [0.3, -0.2, 0.8 * f64::from(turn)]);
        let drawing = smoothed(&draw(&body(0), &truth, PIXELS_PER_RADIAN, 0.9, 0.002));
        let found = run(&drawing, &print, &truth).expect("it is there");
        let range_m = |pose: &Isometry3<f64>| pose.translation.vector.norm();
        sum_m += range_m(&found.camera_from_markers) - range_m(&truth);
        count += 1.0;
    }
    let bias_m: f64 = sum_m / count;
    println!("bias {:.3} mm", bias_m * 1e3);
    assert!(bias_m.abs() < 0.4e-3, "{:.2} mm", bias_m * 1e3);
}

#[test]
fn a_linear_camera_that_is_taken_for_srgb_is_seen() {
    let print = print_of(&body(0));
    let linear = LinearLight::new(TransferCurve::Linear, CodeRange::Full).unwrap();
    for turn in 0..4 {
        let truth = pose(1.2, [0.3, -0.2, 1.6 * f64::from(turn)]);
        let srgb_drawing = draw(&body(0), &truth, PIXELS_PER_RADIAN, 0.9, 0.002);
        let code = |code: &u8| linear.code_of(srgb().of(*code).into()).round() as u8;
        let pixels = srgb_drawing.pixels.iter().map(code).collect();
        let drawing = Drawing { pixels, view: srgb_drawing.view };
        let side = drawing.view.size_px as usize;
        let gamma = |drawing: &Drawing, light: &LinearLight| {
            let image = LumaImage::new(&drawing.pixels, side, side, side).unwrap();
            let picture = Picture {
                response_sigma: 0.6,
                ..Picture::still(image, drawing.view, light, PIXELS_PER_RADIAN)
            };
            let found = align(&print, &picture, &truth, &AlignOptions::default()).unwrap();
            found.response.expect("its print shows it").gamma
        };
        let [right, wrong] = [&linear, &srgb()].map(|light| gamma(&drawing, light));
        assert!((right - 1.0).abs() < 0.15, "{right}");
        assert!((0.6..1.6).contains(&wrong), "{wrong}");
        let of_srgb = gamma(&srgb_drawing, &srgb());
        assert!((of_srgb - 2.2).abs() < 0.3, "{of_srgb}");
    }
}

/// The drawing lit from one side: 30 % darker than in the middle at one rim of the body, 30 %
/// brighter at the opposite one.
fn lit_from_a_side(drawing: &Drawing, range_m: f64, [across, down]: [f64; 2]) -> Drawing {
    let side = drawing.view.size_px as usize;
    let radius_px = 0.08 / range_m * PIXELS_PER_RADIAN;
    let mut pixels = drawing.pixels.clone();
    for (k, code) in pixels.iter_mut().enumerate() {
        let middle = (side as f64 - 1.0) / 2.0;
        let (x, y) = ((k % side) as f64 - middle, (k / side) as f64 - middle);
        let share = 1.0 + 0.3 * (x * across + y * down) / radius_px;
        *code = coded(f64::from(srgb().of(*code)) * share.max(0.0));
    }
    Drawing { pixels, view: drawing.view }
}

/// The sRGB code of a radiance.
fn coded(radiance: f64) -> u8 {
    (255.0 * (1.055 * radiance.max(0.0031).powf(1.0 / 2.4) - 0.055)).round() as u8
}

#[test]
fn an_even_blur_is_the_mean_along_its_path() {
    let print = print_of(&body(0));
    let facet = print.facets.iter().find(|facet| facet.cells.is_some()).expect("a marker");
    // Lens of 2 mm; paths of up to two and a half cells of 7 mm.
    let lens = Matrix2::identity() * 0.002f64.powi(2);
    let sharp = BlurredFacet::new(facet, &lens, &Vector2::zeros(), 1);
    for path in [[0.006, 0.0], [0.0, 0.012], [0.008, 0.008], [0.0145, -0.01]] {
        let path = Vector2::from(path);
        let gaussian = |share: f64| lens + path * path.transpose() * share;
        let moving = BlurredFacet::new(facet, &gaussian(1.0 / 192.0), &path, 4);
        let alike = BlurredFacet::new(facet, &gaussian(1.0 / 12.0), &Vector2::zeros(), 1);
        let (mut off, mut off_alike) = (0.0f64, 0.0f64);
        for place in 0..121 {
            let at = Vector2::new(f64::from(place % 11) - 5.0, f64::from(place / 11) - 5.0) * 0.005;
            let mean = |of: &dyn Fn(Vector2<f64>) -> f32| {
                let steps = (0..101).map(|k| (f64::from(k) - 50.0) / 101.0);
                steps.map(|share| f64::from(of(at + path * share))).sum::<f64>() / 101.0
            };
            let black = mean(&|at| sharp.black(at).value);
            let coverage = mean(&|at| sharp.coverage(at).value);
            for (facet, off) in [(&moving, &mut off), (&alike, &mut off_alike)] {
                let by_black = (black - f64::from(facet.black(at).value)).abs();
                let by_coverage = (coverage - f64::from(facet.coverage(at).value)).abs();
                *off = off.max(by_black).max(by_coverage);
            }
        }
        assert!(off < 0.015 && off < 0.2 * off_alike, "{path:?}: {off} {off_alike}");
    }
}

#[test]
fn radiance_gradients_are_the_last_unknowns() {
    let print = print_of(&body(0));
    let pinhole = Pinhole { focal_px: 611.0, centre_px: Vector2::new(50.0, 50.0) };
    let ahead = Isometry3::from_parts(
        Translation3::new(0.0, 0.0, 1.0),
        UnitQuaternion::from_euler_angles(0.3, -0.2, 0.9),
    );
    let state = State::new(&print, ahead, &Prior::new(1.0, Vector2::zeros(), None, 1.0));
    let scene = Scene::of(&print, &state, &pinhole, 0.0, 0.5);
    let layout = solve::layout(&scene, &[]);
    let gradients = layout.facets().filter_map(|(facet, _)| layout.gradient(facet));
    let indices: Vec<usize> = gradients.flat_map(|at| [at, at + 1]).collect();
    assert!(indices.len() > 10);
    assert_eq!(indices, (layout.uniform_count..layout.count).collect::<Vec<_>>());
    let away = scene.halves[0].visible.iter().position(Option::is_none).expect("one faces away");
    assert_eq!(layout.gradient(away), None);
}

#[test]
fn light_from_one_side_does_not_move_it() {
    let print = print_of(&body(0));
    let (mut sum_m, mut count) = (0.0, 0.0);
    for turn in 0..8 {
        let truth = pose(1.5, [0.3, -0.2, 0.8 * f64::from(turn)]);
        let even = draw(&body(0), &truth, PIXELS_PER_RADIAN, 0.9, 0.004);
        for from in [[1.0, 0.0], [0.0, 1.0], [-0.7, 0.7]] {
            let drawing = lit_from_a_side(&even, 1.5, from);
            let found = run(&drawing, &print, &truth).expect("it is there");
            let error = found.camera_from_markers.translation.vector - truth.translation.vector;
            sum_m += error.norm();
            count += 1.0;
        }
    }
    // Measured: 0.3 mm; 0.55 mm without radiance gradients.
    let mean_m: f64 = sum_m / count;
    println!("mean error {:.2} mm", mean_m * 1e3);
    assert!(mean_m < 0.45e-3, "{:.2} mm", mean_m * 1e3);
}

#[test]
fn values_that_are_not_finite_and_wrong_views_are_refused() {
    let print = print_of(&body(0));
    let truth = pose(1.0, [0.3, -0.2, 0.9]);
    let drawing = draw(&body(0), &truth, PIXELS_PER_RADIAN, 0.9, 0.004);
    let nowhere = Isometry3::translation(f64::NAN, 0.0, 0.0);
    assert_eq!(run(&drawing, &print, &nowhere), Err(AlignError::NotInView));
    let behind = Isometry3::translation(-1.0, -0.6, -0.4);
    assert_eq!(run(&drawing, &print, &behind), Err(AlignError::NotInView));
    let inside = Isometry3::translation(0.01, 0.0, 0.0);
    assert_eq!(run(&drawing, &print, &inside), Err(AlignError::NotInView));
    for focal_px in [f64::NAN, 0.0, -700.0, f64::INFINITY] {
        let wrong =
            Drawing { view: View { focal_px, ..drawing.view }, pixels: drawing.pixels.clone() };
        assert_eq!(run(&wrong, &print, &truth), Err(AlignError::NotInView));
    }
    // With a wrong focal length or a wrong rotation, the cells do not correlate.
    for (focal, turn) in [(1.5, 0.0), (0.6, 0.0), (1.0, 0.6)] {
        let view = View {
            focal_px: drawing.view.focal_px * focal,
            camera_from_view: drawing.view.camera_from_view
                * UnitQuaternion::from_euler_angles(0.0, 0.0, turn),
            ..drawing.view
        };
        let wrong = Drawing { view, pixels: drawing.pixels.clone() };
        if let Ok(found) = run(&wrong, &print, &truth) {
            assert!(found.evidence.correlation < 0.4, "{focal} {turn}: {:?}", found.evidence);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    /// From far away, the mirrored pose shows a facet's corners in the same places, with the facet
    /// tilted the other way.
    #[test]
    fn mirrored_poses_look_the_same_from_far_away(
        euler in prop::array::uniform3(-3.0..3.0f64),
        facet in 0u32..17,
    ) {
        let (body, pose) = (body(0), pose(40.0, euler));
        let print = print_of(&body);
        let mirrored = print.mirrored(facet, &pose).unwrap();
        let printed = &print.facets[facet as usize];
        let middle = Point3::from(printed.markers_from_facet.translation.vector);
        prop_assert!((pose * middle - mirrored * middle).norm() < 1e-9);
        for corner in printed.corners_in_markers() {
            let [ray, other] = [pose * corner, mirrored * corner].map(|at| at.coords);
            // A corner lies 45 mm from the middle, so it is nearer or farther by at most as much.
            prop_assert!(ray.angle(&other) < 2.0 * (0.045f64 / 40.0).powi(2));
        }
        let normal = |pose: &Isometry3<f64>| pose * (printed.markers_from_facet * Vector3::z());
        let sight = (pose * middle).coords.normalize();
        prop_assert!((normal(&pose).dot(&sight) - normal(&mirrored).dot(&sight)).abs() < 1e-9);
        let twice = print.mirrored(facet, &mirrored).unwrap();
        prop_assert!(twice.rotation.angle_to(&pose.rotation) < 1e-6);
        prop_assert!(print.mirrored(99, &pose).is_none());
    }
}
