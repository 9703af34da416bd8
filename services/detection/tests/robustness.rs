//! Odd views without markers give no marker and no panic; wrong parameters are refused.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use flockeye_detection::{DarkerBy, DetectError, Detector, DetectorParameters, Threshold};
use flockeye_geometry::camera::Camera;
use flockeye_geometry::mask::Mask;
use flockeye_geometry::view::View;
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::Vector3;
use opencv::aruco::{self, PREDEFINED_DICTIONARY_NAME};
use opencv::prelude::*;
use proptest::prelude::*;

fn markers_in(pixels: &[u8], width: usize, height: usize, stride: usize) -> usize {
    let image = LumaImage::new(pixels, width, height, stride).unwrap();
    let view = View::looking_at(&Vector3::x_axis(), 1.0, width as u32);
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
    let mut detector = Detector::new("DICT_5X5_250", DetectorParameters::default()).unwrap();
    detector.detect(&image, &view, &light).len()
}

#[test]
fn uniform_views_give_no_marker() {
    for side in [1, 2, 15, 16, 17, 400] {
        for code in [0, 128, 255] {
            assert_eq!(markers_in(&vec![code; side * side], side, side, side), 0);
        }
    }
    assert_eq!(markers_in(&[7; 500], 1, 500, 1), 0);
    assert_eq!(markers_in(&[7; 500], 500, 1, 500), 0);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..Default::default() })]

    #[test]
    fn noise_gives_no_marker(
        width in 1usize..160,
        height in 1usize..160,
        gap in 0usize..9,
        block in 1usize..12,
        seed in any::<u64>(),
    ) {
        let stride = width + gap;
        // Blocks of one code value, so that there are squares among them.
        let pixels: Vec<u8> = (0..stride * height)
            .map(|k| {
                let (x, y) = (k % stride / block, k / stride / block);
                let mixed = (seed ^ (x as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15))
                    .wrapping_add((y as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f));
                ((mixed ^ (mixed >> 29)).wrapping_mul(0xbf58_476d_1ce4_e5b9) >> 56) as u8
            })
            .collect();
        prop_assert_eq!(markers_in(&pixels, width, height, stride), 0);
    }
}

#[test]
fn a_marker_on_the_own_airframe_is_left_out() {
    let (size, side, left, top) = (400usize, 120usize, 60usize, 140usize);
    let dictionary = aruco::get_predefined_dictionary(PREDEFINED_DICTIONARY_NAME::DICT_5X5_250);
    let mut marker = Mat::default();
    aruco::draw_marker(&dictionary.unwrap(), 7, side as i32, &mut marker, 1).unwrap();
    let mut pixels = vec![230u8; size * size];
    for (y, row) in marker.data_bytes().unwrap().chunks(side).enumerate() {
        let first = (top + y) * size + left;
        for (pixel, &ink) in pixels[first..first + side].iter_mut().zip(row) {
            *pixel = 20 + ink / 255 * 210;
        }
    }
    let image = LumaImage::new(&pixels, size, size, size).unwrap();
    let view = View::looking_at(&Vector3::x_axis(), 1.0, size as u32);
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
    let ids_beside = |hides: fn(usize) -> bool| -> Vec<u32> {
        // The left half of the view is in the left half of the sphere's image.
        let seen = (0..256 * 128).map(|k| !hides(k % 256)).collect();
        let mask = Mask::new(Camera::equirectangular(256, 128), [256, 128], seen).unwrap();
        let parameters = DetectorParameters::default();
        let mut detector = Detector::new("DICT_5X5_250", parameters).unwrap().with_mask(mask);
        let found = detector.detect(&image, &view, &light);
        found.iter().map(|marker| marker.id).collect()
    };
    assert_eq!(ids_beside(|column| column >= 128), [7]);
    assert!(ids_beside(|column| column < 128).is_empty());
}

fn refused(name: &str, parameters: DetectorParameters) -> DetectError {
    match Detector::new(name, parameters) {
        Ok(_) => panic!("'{name}' was taken"),
        Err(error) => error,
    }
}

#[test]
fn an_unknown_dictionary_is_refused_with_the_known_ones() {
    let error = refused("DICT_5X5_251", DetectorParameters::default()).to_string();
    assert!(error.contains("'DICT_5X5_251'") && error.contains("DICT_5X5_250"), "{error}");
}

#[test]
fn parameters_outside_their_range_are_refused() {
    let even_window = Threshold { window_px: 10, darker_by: DarkerBy::Codes(3) };
    let every_pixel = Threshold { window_px: 11, darker_by: DarkerBy::Codes(0) };
    for parameters in [
        DetectorParameters { thresholds: Vec::new(), ..Default::default() },
        DetectorParameters { thresholds: vec![even_window], ..Default::default() },
        DetectorParameters { thresholds: vec![every_pixel], ..Default::default() },
        DetectorParameters { min_side_px: f64::NAN, ..Default::default() },
        DetectorParameters { corner_accuracy_px: -1.5, ..Default::default() },
    ] {
        let error = refused("DICT_5X5_250", parameters);
        assert!(matches!(error, DetectError::Parameter { .. }), "{error}");
    }
}
