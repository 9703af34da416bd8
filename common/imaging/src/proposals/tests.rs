#![allow(clippy::unwrap_used, clippy::expect_used)]

use flockeye_geometry::camera::Camera;
use nalgebra::{Unit, Vector3};
use proptest::prelude::*;

use super::*;

const WIDTH: usize = 3840;
const HEIGHT: usize = 1920;

const SIZES: MarkerSizes = MarkerSizes { least_rad: 0.018, most_rad: 0.125, radius_in_sides: 1.64 };

/// A thorough look finds markers of which the quick one has some pixels.
#[test]
fn a_small_body_is_found_by_a_thorough_look() {
    let direction = Unit::new_normalize(Vector3::new(1.0, 0.3, 0.1));
    let side_rad = 9.0 / 611.0;
    let pixels = body_at(&direction, side_rad);
    let image = SphereImage::new(&pixels, WIDTH, Camera::equirectangular(3840, 1920)).unwrap();
    let sizes = MarkerSizes { least_rad: 7.0 / 611.0, ..SIZES };
    let found = Proposer::default().propose(&image, &sizes, Detail::Thorough, 24);
    let first = found.first().expect("it is there");
    assert!(first.direction_in_camera.angle(&direction) < 1.64 * side_rad);
    assert!((0.6..1.6).contains(&(first.side_rad / side_rad)), "{}", first.side_rad);
}

fn propose(pixels: &[u8]) -> Vec<Proposal> {
    let image = SphereImage::new(pixels, WIDTH, Camera::equirectangular(3840, 1920)).unwrap();
    Proposer::default().propose(&image, &SIZES, Detail::Quick, 24)
}

/// A white disc with four marker-like squares of `side_rad`, in a grey picture.
fn body_at(direction: &Unit<Vector3<f64>>, side_rad: f64) -> Vec<u8> {
    let camera = Camera::equirectangular(3840, 1920);
    let mut pixels = vec![110; WIDTH * HEIGHT];
    let right = direction.cross(&Vector3::new(0.1, 0.2, 1.0)).normalize();
    let up = right.cross(direction);
    for (k, pixel) in pixels.iter_mut().enumerate() {
        let at =
            flockeye_geometry::camera::SpherePixel::new((k % WIDTH) as f64, (k / WIDTH) as f64);
        let ray = camera.ray(at).unwrap();
        let depth = ray.dot(direction);
        if depth < 0.9 {
            continue;
        }
        // In facets, which are a quarter wider than their markers.
        let [x, y] = [right, up].map(|axis| ray.dot(&axis) / depth / (1.25 * side_rad));
        if x.abs() > 1.0 || y.abs() > 1.0 {
            continue;
        }
        // In cells from the middle of the facet.
        let [x, y] = [x, y].map(|x| (x.rem_euclid(1.0) - 0.5) * 1.25 * 7.0);
        let ring = x.abs().max(y.abs());
        let is_cell_white = ((x + 10.0).round() + (y + 10.0).round()) as i64 % 2 == 0;
        *pixel = match ring {
            ring if ring > 3.5 => 220,
            ring if ring > 2.5 => 30,
            _ if is_cell_white => 200,
            _ => 35,
        };
    }
    pixels
}

#[test]
fn a_body_is_the_first_proposal_wherever_it_is() {
    let places = [
        Vector3::new(1.0, 0.3, 0.1),
        // Across the seam.
        Vector3::new(-1.0, 0.001, -0.2),
        // Where rows are stretched.
        Vector3::new(0.4, 0.2, 0.9),
        Vector3::new(0.1, -0.2, -0.8),
        Vector3::new(0.2, 0.1, 1.0),
    ];
    for place in places {
        for side_rad in [0.024, 0.05] {
            let direction = Unit::new_normalize(place);
            let found = propose(&body_at(&direction, side_rad));
            let first = found.first().unwrap_or_else(|| panic!("{place:?} {side_rad}"));
            let off_sides = first.direction_in_camera.angle(&direction) / side_rad;
            assert!(off_sides < 1.64, "{place:?}, {side_rad}: off by {off_sides} sides");
            assert!((0.6..1.6).contains(&(first.side_rad / side_rad)), "{}", first.side_rad);
        }
    }
}

#[test]
fn even_pictures_have_no_proposals() {
    for code in [0, 17, 128, 255] {
        assert_eq!(propose(&vec![code; WIDTH * HEIGHT]), []);
    }
}

#[test]
fn other_cameras_have_no_proposals() {
    let plane = CameraModel::Stereographic { field_rad: 200f64.to_radians() };
    let camera = Camera::new(640, 640, plane).unwrap();
    let pixels = vec![0; 640 * 640];
    let image = SphereImage::new(&pixels, 640, camera).unwrap();
    assert_eq!(Proposer::default().propose(&image, &SIZES, Detail::Quick, 24), []);
}

#[test]
fn the_same_picture_has_the_same_proposals_whatever_came_before() {
    let pixels = body_at(&Unit::new_normalize(Vector3::new(1.0, 0.3, 0.1)), 0.03);
    let camera = Camera::equirectangular(3840, 1920);
    let image = SphereImage::new(&pixels, WIDTH, camera).unwrap();
    let mut used = Proposer::default();
    let noise: Vec<u8> = (0..WIDTH * HEIGHT).map(|k| ((k * 2_654_435_761) >> 7) as u8).collect();
    used.propose(&SphereImage::new(&noise, WIDTH, camera).unwrap(), &SIZES, Detail::Quick, 24);
    assert_eq!(used.propose(&image, &SIZES, Detail::Quick, 24), propose(&pixels));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Images of any size and content: proposals are finite, in order, no more than asked for, and
    /// of sizes that were asked for.
    #[test]
    fn any_picture_has_orderly_proposals(
        half_width in 1u32..200,
        height in 2u32..200,
        seed in 1u64..u64::MAX,
        coarse in 1usize..12,
    ) {
        let (width, height) = (2 * half_width as usize, height as usize);
        let mut state = seed;
        let mut random = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            (state >> 56) as u8
        };
        let blocks: Vec<u8> = (0..=width * height).map(|_| random()).collect();
        let pixels: Vec<u8> = (0..width * height)
            .map(|k| blocks[k / width / coarse * width + k % width / coarse])
            .collect();
        let camera = Camera::equirectangular(width as u32, height as u32);
        let image = SphereImage::new(&pixels, width, camera).unwrap();
        let sizes = MarkerSizes { least_rad: 0.05, most_rad: 1.0, radius_in_sides: 1.64 };
        let found = Proposer::default().propose(&image, &sizes, Detail::Quick, 7);
        prop_assert!(found.len() <= 7);
        prop_assert!(found.windows(2).all(|pair| pair[0].score >= pair[1].score));
        for proposal in found {
            prop_assert!(proposal.score.is_finite());
            prop_assert!(proposal.direction_in_camera.iter().all(|x| x.is_finite()));
            prop_assert!((0.02..=1.5).contains(&proposal.side_rad));
        }
    }
}
