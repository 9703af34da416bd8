//! Textures full of squares and real panoramas, without markers, give no pose.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod shared;

use std::f64::consts::PI;

use flockeye_detection::{Detector, DetectorParameters, MarkerInView};
use flockeye_geometry::body::{Bodies, squares};
use flockeye_geometry::pose::{CornerRay, solve};
use flockeye_geometry::view::View;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use nalgebra::Vector3;
use shared::{Picture, data, partitions};

/// A detector, and two bodies that carry the first ids of its dictionary.
struct Observer {
    detector: Detector,
    bodies: Bodies,
    light: LinearLight,
}

impl Observer {
    fn new(dictionary: &str) -> Self {
        let list = vec![squares("alpha", 0.0625, 0.05, 0), squares("bravo", 0.0625, 0.05, 17)];
        let bodies = Bodies::new(dictionary.into(), list).unwrap();
        let detector = Detector::new(dictionary, DetectorParameters::default()).unwrap();
        let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
        Self { detector, bodies, light }
    }

    /// The decoded markers in a view that belong to the bodies.
    fn decoded(&mut self, picture: &Picture, view: &View) -> Vec<MarkerInView> {
        let found = self.detector.detect(&picture.image(), view, &self.light);
        found.into_iter().filter(|marker| self.bodies.owner(marker.id).is_some()).collect()
    }

    /// How many bodies have a pose that two markers agree on.
    fn poses(&self, decoded: &[MarkerInView]) -> usize {
        let has_pose = |index: usize| {
            let body = self.bodies.get(index).unwrap();
            let rays: Vec<CornerRay> = decoded
                .iter()
                .filter(|marker| self.bodies.owner(marker.id) == Some(index))
                .flat_map(|marker| {
                    (0..4).map(|corner| CornerRay {
                        marker_id: marker.id,
                        corner,
                        ray_in_camera: marker.rays_in_camera[corner],
                        deviation_rad: marker.deviations_rad[corner],
                    })
                })
                .collect();
            let solutions = solve(body, &rays).unwrap_or_default();
            solutions.iter().any(|solution| solution.inlier_markers.len() >= 2)
        };
        (0..self.bodies.len()).filter(|&index| has_pose(index)).count()
    }
}

/// The generator xorshift64*, which gives the same numbers on every machine.
struct Dice(u64);

impl Dice {
    fn uniform(&mut self, from: f64, to: f64) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        let bits = self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11;
        from + (to - from) * bits as f64 / (1u64 << 53) as f64
    }
}

const SIZE: usize = 600;

/// Squares of random cells on white, each rotated at random, like labels and codes.
fn labels(dice: &mut Dice, cells: usize) -> Vec<f64> {
    let mut light = vec![0.75; SIZE * SIZE];
    for _ in 0..60 {
        let side = dice.uniform(16.0, 70.0);
        let (x, y) = (dice.uniform(40.0, 560.0), dice.uniform(40.0, 560.0));
        let (sine, cosine) = dice.uniform(0.0, 2.0 * PI).sin_cos();
        let has_border = dice.uniform(0.0, 1.0) < 0.7;
        let white: Vec<bool> = (0..cells * cells).map(|_| dice.uniform(0.0, 1.0) < 0.5).collect();
        paint(&mut light, (x, y), 0.75 * side * 2f64.sqrt(), |dx, dy| {
            let (u, v) = (dx * cosine + dy * sine, dy * cosine - dx * sine);
            let (u, v) = (u / side + 0.5, v / side + 0.5);
            let is_inside = |at: f64, rim: f64| (-rim..1.0 + rim).contains(&at);
            if !(is_inside(u, 0.15) && is_inside(v, 0.15)) {
                return None;
            }
            if !(is_inside(u, 0.0) && is_inside(v, 0.0)) {
                return Some(0.75);
            }
            let (row, column) = ((v * cells as f64) as usize, (u * cells as f64) as usize);
            let is_border = [row, column].iter().any(|&k| k == 0 || k == cells - 1);
            let is_white = white[row * cells + column] && !(has_border && is_border);
            Some(if is_white { 0.75 } else { 0.04 })
        });
    }
    light
}

/// A checkerboard, rotated and scaled at random.
fn checkerboard(dice: &mut Dice) -> Vec<f64> {
    let side = dice.uniform(12.0, 60.0);
    let (sine, cosine) = dice.uniform(0.0, 2.0 * PI).sin_cos();
    let mut light = vec![0.5; SIZE * SIZE];
    paint(&mut light, (300.0, 300.0), 500.0, |dx, dy| {
        let (u, v) = ((dx * cosine + dy * sine) / side, (dy * cosine - dx * sine) / side);
        let is_white = (u.floor() + v.floor()).rem_euclid(2.0) < 1.0;
        Some(if is_white { 0.8 } else { 0.03 })
    });
    light
}

/// Black and white blocks, with blocks of a quarter of the size over a quarter of the area.
fn blocks(dice: &mut Dice) -> Vec<f64> {
    let mut light = vec![0.6; SIZE * SIZE];
    for divisor in [1.0, 4.0] {
        let side = dice.uniform(24.0, 60.0) / divisor;
        let count = (SIZE as f64 / side) as usize + 1;
        let shades: Vec<Option<f64>> = (0..count * count)
            .map(|_| {
                let is_left = divisor > 1.0 && dice.uniform(0.0, 1.0) < 0.75;
                let shade = if dice.uniform(0.0, 1.0) < 0.5 { 0.04 } else { 0.7 };
                (!is_left).then_some(shade)
            })
            .collect();
        for y in 0..SIZE {
            for x in 0..SIZE {
                let place = |at: usize| (at as f64 / side) as usize;
                if let Some(shade) = shades[place(y) * count + place(x)] {
                    light[y * SIZE + x] = shade;
                }
            }
        }
    }
    light
}

fn paint(
    light: &mut [f64],
    (x, y): (f64, f64),
    reach: f64,
    shade: impl Fn(f64, f64) -> Option<f64>,
) {
    let span = |at: f64| {
        let first = (at - reach).floor().max(0.0) as usize;
        first..((at + reach).ceil() as usize).min(SIZE)
    };
    for row in span(y) {
        for column in span(x) {
            if let Some(shade) = shade(column as f64 - x, row as f64 - y) {
                light[row * SIZE + column] = shade;
            }
        }
    }
}

/// The radiance as an image: blurred by about a pixel, with noise, in sRGB.
fn picture(light: &[f64], dice: &mut Dice) -> Picture {
    let mut blurred = light.to_vec();
    for step in [1, SIZE] {
        let before = blurred.clone();
        for k in 2 * step..blurred.len() - 2 * step {
            let weights = [(0, 0.4), (step, 0.24), (2 * step, 0.06)];
            blurred[k] = weights.iter().map(|(by, w)| w * (before[k - by] + before[k + by])).sum();
            blurred[k] -= 0.4 * before[k];
        }
    }
    let pixels = blurred
        .iter()
        .map(|light| {
            let noisy = (light + dice.uniform(-0.01, 0.01)).max(0.0);
            (255.0 * (1.055 * noisy.powf(1.0 / 2.4) - 0.055)).clamp(0.0, 255.0) as u8
        })
        .collect();
    Picture { pixels, width: SIZE, height: SIZE }
}

#[test]
fn textures_full_of_squares_give_no_pose() {
    for (dictionary, cells) in [("DICT_5X5_250", 7), ("DICT_4X4_50", 6), ("DICT_ARUCO_ORIGINAL", 7)]
    {
        let mut observer = Observer::new(dictionary);
        let view = View::looking_at(&Vector3::x_axis(), 1.0, SIZE as u32);
        let mut dice = Dice(4711);
        let (mut decoded, mut poses) = (0, 0);
        for round in 0..24 {
            let light = match round % 4 {
                0 => checkerboard(&mut dice),
                1 => blocks(&mut dice),
                _ => labels(&mut dice, cells),
            };
            let found = observer.decoded(&picture(&light, &mut dice), &view);
            decoded += found.len();
            poses += observer.poses(&found);
        }
        println!("{dictionary}: {decoded} markers in 24 textures, {poses} poses");
        assert_eq!(poses, 0, "{dictionary}");
    }
}

#[test]
fn real_panoramas_give_no_pose() {
    let Some(data) = data() else { return };
    for dictionary in ["DICT_4X4_50", "DICT_ARUCO_ORIGINAL", "DICT_5X5_250"] {
        let mut observer = Observer::new(dictionary);
        for file in [
            "real/theta_s/eqrect_example.png",
            "real/theta_s/eqrect_example_good.png",
            "real/panorama/examplepano.jpg",
        ] {
            let sphere = Picture::read(&data.join(file));
            let views = partitions(sphere.width as f64 / (2.0 * PI));
            let found: Vec<MarkerInView> =
                views.iter().flat_map(|view| observer.decoded(&sphere.cut(view), view)).collect();
            println!("{dictionary} in {file}: {} markers", found.len());
            assert_eq!(observer.poses(&found), 0, "{dictionary} in {file}: {found:#?}");
        }
    }
}
