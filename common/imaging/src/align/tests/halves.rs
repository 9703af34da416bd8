//! Bodies across the border of a stitched picture.

use drawn_body::draw_mixed;
use flockeye_geometry::camera::{Half, Stitch};
use nalgebra::{Matrix5, Vector5};

use super::*;

/// Lenses 16 mm apart, stitched for 3 m, one turned by a tenth of a degree.
fn stitched() -> Stitch {
    let constants = Vector5::new(0.008, 0.008 / 3.0, 0.0009, -0.0005, 0.0003);
    Stitch::of(constants, Matrix5::zeros()).expect("it is finite")
}

/// Half of the strip in which the halves are blended, radians.
const BLENDED_RAD: f64 = 0.026;

fn drawn(truth: &Isometry3<f64>) -> Drawing {
    let place = truth.translation.vector;
    let shown = Half::ALL.map(|half| stitched().shown_from_camera(half, &place) * truth);
    draw_mixed(&body(0), truth, PIXELS_PER_RADIAN, 0.9, 0.004, |ray| {
        let ahead = (0.5 + 0.5 * ray.x.asin() / BLENDED_RAD).clamp(0.0, 1.0);
        [(ahead, shown[0]), (1.0 - ahead, shown[1])]
    })
}

fn beside_the_border(x: f64, range_m: f64, turn: f64) -> Isometry3<f64> {
    let direction = Vector3::new(x, 0.9, 0.3).normalize();
    Isometry3::from_parts(
        Translation3::from(direction * range_m),
        UnitQuaternion::from_euler_angles(0.3, -0.2, turn),
    )
}

fn tried(
    drawing: &Drawing,
    start: &Isometry3<f64>,
    stitch: Option<Stitch>,
) -> Result<Alignment, AlignError> {
    let (print, light) = (print_of(&body(0)), srgb());
    let still = Picture::still(drawing.image(), drawing.view, &light, PIXELS_PER_RADIAN);
    let options = AlignOptions { coarse_first: true, ..AlignOptions::default() };
    align(&print, &Picture { stitch, ..still }, start, &options)
}

fn aligned(drawing: &Drawing, start: &Isometry3<f64>, stitch: Option<Stitch>) -> Alignment {
    tried(drawing, start, stitch).expect("it is there")
}

fn off_m(found: &Alignment, truth: &Isometry3<f64>) -> f64 {
    (found.camera_from_markers.translation.vector - truth.translation.vector).norm()
}

/// A body on the border shows the disparity of the halves, and its pose is right, whether the
/// camera is known or not.
#[test]
fn a_body_across_the_border_is_modelled_half_by_half() {
    let unknown = Stitch::new(0.0, [0.006, 0.003, 0.001]);
    for (range_m, x) in [(0.7, 0.0), (0.7, 0.04), (0.9, -0.03), (1.5, 0.01)] {
        for turn in [0.4, 2.0] {
            let truth = beside_the_border(x, range_m, turn);
            let drawing = drawn(&truth);
            let known = aligned(&drawing, &truth, Some(stitched()));
            // A track of a camera that nobody knows follows where the half of its middle shows it.
            let middle = truth.translation.vector;
            let start = stitched().shown_from_camera(Half::of(&middle), &middle) * truth;
            let learned = aligned(&drawing, &start, Some(unknown));
            if range_m > 1.2 {
                assert!(learned.stitch.is_none(), "its cells are too small to tell");
                continue;
            }
            let seen = learned.stitch.expect("both halves show it");
            let of_prior = unknown.covariance().try_inverse().expect("it is positive");
            let covariance = (seen.information + of_prior).try_inverse().expect("it is positive");
            let found = Stitch::of(covariance * seen.moment, covariance).expect("it is finite");
            let off = found.disparity(&middle) - stitched().disparity(&middle);
            assert!(off_m(&known, &truth) < 1.2e-3 * range_m, "{}", off_m(&known, &truth));
            assert!(off_m(&learned, &truth) < 2e-3 * range_m, "{}", off_m(&learned, &truth));
            assert!(off.norm() < 1e-3, "{off}");
            let ignored = tried(&drawing, &start, None);
            let is_off = |it: &Alignment| off_m(it, &truth) > 2.0 * off_m(&known, &truth);
            assert!(ignored.as_ref().map_or(true, is_off), "{ignored:?}");
        }
    }
}

/// Away from the border the pose is as far off as the lens that shows it.
#[test]
fn a_pose_from_one_half_is_where_its_lens_shows_it() {
    let truth = beside_the_border(0.5, 0.8, 1.0);
    let drawing = drawn(&truth);
    let known = aligned(&drawing, &truth, Some(stitched()));
    assert!(off_m(&known, &truth) < 1e-3 && known.stitch.is_none());
    let unknown = Stitch::new(0.0, [0.006, 0.003, 0.001]);
    let middle = truth.translation.vector;
    let shown = stitched().shown_from_camera(Half::Ahead, &middle) * truth;
    let wrong = aligned(&drawing, &shown, Some(unknown));
    assert!(off_m(&wrong, &truth) > 2e-3);
    let error = wrong.camera_from_markers.translation.vector - truth.translation.vector;
    let covariance = wrong.covariance + unknown.pose_covariance(&middle);
    let covariance = covariance.fixed_view::<3, 3>(0, 0).into_owned();
    let normalized = error.dot(&(covariance.try_inverse().expect("it is positive") * error));
    assert!((0.1..6.0).contains(&normalized), "{normalized}");
    let negligible = Stitch::new(1e-5, [1e-5; 3]);
    let [plain, negligible] = [None, Some(negligible)].map(|it| aligned(&drawing, &shown, it));
    assert_eq!(plain.camera_from_markers, negligible.camera_from_markers);
}
