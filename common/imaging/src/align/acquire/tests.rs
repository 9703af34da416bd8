//! Bodies in any attitude, found from a rough place.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use super::templates::directions;
use super::{Place, Templates};
use crate::align::tests::drawn_body::{Drawing, draw};
use crate::align::tests::{PIXELS_PER_RADIAN, body, exposed, print_of, srgb};
use crate::align::{AlignOptions, Picture, align, starts_at};

/// Attitudes that have nothing in common.
fn attitudes(count: usize) -> impl Iterator<Item = UnitQuaternion<f64>> {
    directions(count).enumerate().map(|(k, axis)| {
        UnitQuaternion::from_scaled_axis(axis * (0.3 + 2.8 * (k as f64 * 0.618).fract()))
    })
}

fn pose(range_m: f64, attitude: UnitQuaternion<f64>) -> Isometry3<f64> {
    let direction = Vector3::new(0.8, 0.5, 0.33).normalize();
    Isometry3::from_parts(Translation3::from(direction * range_m), attitude)
}

/// Whether the right pose is found from a place that is off by half a radius and a sixth of the
/// range.
fn is_found(drawing: &Drawing, templates: &Templates, truth: &Isometry3<f64>) -> bool {
    let print = print_of(&body(0));
    let light = srgb();
    let picture = Picture::still(drawing.image(), drawing.view, &light, PIXELS_PER_RADIAN);
    let position = truth.translation.vector;
    let off = Vector3::new(-0.5, 0.8, 0.0).normalize() * (0.5 * print.radius_m());
    let place = Place {
        direction_in_camera: (position + off).normalize(),
        range_m: position.norm() / 1.17,
    };
    let options = AlignOptions { coarse_first: true, ..AlignOptions::default() };
    let starts = starts_at(&print, templates, &picture, &place, &options);
    let found = starts.iter().filter_map(|start| align(&print, &picture, start, &options).ok());
    found.filter(|found| found.is_accepted()).any(|found| {
        let pose = &found.camera_from_markers;
        pose.rotation.angle_to(&truth.rotation) < 0.1
            && (pose.translation.vector - position).norm() < 0.05
    })
}

#[test]
fn a_body_far_away_is_found_in_any_attitude() {
    let templates = Templates::new(&print_of(&body(0)));
    let found = attitudes(12).zip([1.5, 2.2, 2.9, 3.4].into_iter().cycle()).filter(
        |(attitude, range_m)| {
            let truth = pose(*range_m, *attitude);
            let drawing = draw(&body(0), &truth, PIXELS_PER_RADIAN, 0.9, 0.004);
            let found = is_found(&drawing, &templates, &truth);
            println!("{range_m} m: {found}");
            found
        },
    );
    let count = found.count();
    assert!(count >= 11, "{count} of 12");
}

/// White has grown over the cells, and only templates of that show the body.
#[test]
fn an_overexposed_body_is_found() {
    let templates = Templates::new(&print_of(&body(0)));
    let plain = Templates { overexposed: Vec::new(), ..templates.clone() };
    let (mut with, mut without) = (0, 0);
    for attitude in attitudes(6) {
        let truth = pose(2.4, attitude);
        let drawing = draw(&body(0), &truth, PIXELS_PER_RADIAN, 0.9, 0.004);
        let drawing = exposed(&drawing, 2.5);
        with += u32::from(is_found(&drawing, &templates, &truth));
        without += u32::from(is_found(&drawing, &plain, &truth));
    }
    println!("{with} with, {without} without");
    assert!(with >= 5 && without < with, "{with} with, {without} without");
}

#[test]
fn a_body_without_markers_has_no_starts() {
    let mut bare = print_of(&body(0));
    bare.facets.iter_mut().for_each(|facet| facet.cells = None);
    let templates = Templates::new(&bare);
    let truth = pose(2.0, UnitQuaternion::identity());
    let drawing = draw(&body(0), &truth, PIXELS_PER_RADIAN, 0.9, 0.004);
    let light = srgb();
    let picture = Picture::still(drawing.image(), drawing.view, &light, PIXELS_PER_RADIAN);
    let place = Place { direction_in_camera: truth.translation.vector.normalize(), range_m: 2.0 };
    let options = AlignOptions::default();
    assert!(starts_at(&bare, &templates, &picture, &place, &options).is_empty());
    // Nor is there anything where the view does not look.
    let behind = Place { direction_in_camera: -place.direction_in_camera, ..place };
    let templates = Templates::new(&print_of(&body(0)));
    assert!(starts_at(&print_of(&body(0)), &templates, &picture, &behind, &options).is_empty());
}

#[test]
fn directions_cover_the_sphere() {
    let lattice: Vec<Vector3<f64>> = directions(240).collect();
    for probe in directions(1009) {
        let nearest = lattice.iter().map(|direction| direction.angle(&probe)).fold(9.0, f64::min);
        assert!(nearest < 0.2, "{nearest} rad from {probe:?}");
    }
}
