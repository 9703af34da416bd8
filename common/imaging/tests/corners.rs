//! Corners of markers that were drawn exactly: blurred in linear light, encoded, with noise.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use flockeye_geometry::view::ViewPixel;
use flockeye_imaging::edges::{MarkerPrint, RefinedCorners, refine_corners};
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::{CodeRange, LinearLight, TransferCurve};
use flockeye_imaging::square::{SquareInView, mean_side_px};
use nalgebra::{Matrix3, Rotation3, Unit, Vector2, Vector3};

const CELLS: usize = 7;
/// Points drawn for each pixel, along either axis.
const FINE: usize = 8;

/// xorshift64*: the same numbers on every machine.
struct Dice(u64);

impl Dice {
    fn uniform(&mut self, from: f64, to: f64) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        let bits = self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11;
        from + (to - from) * bits as f64 / (1u64 << 53) as f64
    }

    /// Mean 0, variance 1.
    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform(0.0, 1.0)).sum::<f64>() - 6.0
    }
}

/// One marker before a camera.
struct Scene {
    size: usize,
    corners: [ViewPixel; 4],
    cells: [[bool; CELLS]; CELLS],
    blur: f64,
    noise: f64,
    white: f64,
    black: f64,
    /// Light beyond the quiet zone, on each side.
    around: [f64; 4],
    /// Share of the middle of the first side that something grey hides.
    hidden: f64,
}

impl Scene {
    /// A marker whose sides, seen frontally, would have `side` pixels, tilted by `tilt`.
    fn new(dice: &mut Dice, side: f64, tilt: f64, blur: f64, noise: f64) -> Self {
        let size = (1.7 * side) as usize + 16;
        let axis = dice.uniform(0.0, 6.3);
        let axis = Unit::new_normalize(Vector3::new(axis.cos(), axis.sin(), 0.0));
        let turn = Rotation3::from_axis_angle(&axis, tilt)
            * Rotation3::from_axis_angle(&Vector3::z_axis(), dice.uniform(0.0, 6.3));
        let distance = dice.uniform(6.0, 20.0);
        let middle = size as f64 / 2.0 + dice.uniform(-1.0, 1.0);
        let corners = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)].map(|(x, y)| {
            let at = turn * Vector3::new(x, y, 0.0);
            let scale = side * distance / (distance + at.z);
            ViewPixel::new(middle + at.x * scale, middle + at.y * scale)
        });
        let mut cells = [[false; CELLS]; CELLS];
        for row in &mut cells[1..CELLS - 1] {
            for cell in &mut row[1..CELLS - 1] {
                *cell = dice.uniform(0.0, 1.0) < 0.5;
            }
        }
        let around = std::array::from_fn(|_| dice.uniform(0.1, 0.9));
        Self {
            size,
            corners,
            cells,
            blur,
            noise,
            white: dice.uniform(0.4, 0.85),
            black: dice.uniform(0.01, 0.05),
            around,
            hidden: 0.0,
        }
    }

    /// Light of the printed plane; the black square is [0, 1] x [0, 1].
    fn light(&self, u: f64, v: f64) -> f64 {
        // 0.875 cells of quiet zone: facets of 62.5 mm with markers of 50 mm.
        let quiet = 0.875 / CELLS as f64;
        if self.hidden > 0.0 && (u - 0.5).abs() < self.hidden / 2.0 && v < 0.3 {
            return 0.3;
        }
        let beyond =
            [-quiet - v, u - 1.0 - quiet, v - 1.0 - quiet, -quiet - u].into_iter().enumerate();
        let (side, outside) = beyond.max_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
        if outside > 0.0 {
            return self.around[side];
        }
        if !(0.0..1.0).contains(&u) || !(0.0..1.0).contains(&v) {
            return self.white;
        }
        let cell = |at: f64| (at * CELLS as f64) as usize;
        if self.cells[cell(v)][cell(u)] { self.white } else { self.black }
    }

    fn print(&self) -> MarkerPrint {
        let inner = self.cells[1..CELLS - 1].iter().flat_map(|row| row[1..CELLS - 1].iter());
        MarkerPrint::of_bits(&inner.copied().collect::<Vec<bool>>()).unwrap()
    }

    fn render(&self, dice: &mut Dice) -> Vec<u8> {
        let fine = self.size * FINE;
        let square_from_view = homography(&self.corners).try_inverse().unwrap();
        let at = |k: usize| (k as f64 + 0.5) / FINE as f64 - 0.5;
        let mut light: Vec<f64> = Vec::with_capacity(fine * fine);
        for y in 0..fine {
            for x in 0..fine {
                let p = square_from_view * Vector3::new(at(x), at(y), 1.0);
                light.push(self.light(p.x / p.z, p.y / p.z));
            }
        }
        // The lens blurs, the pixel takes the mean over its area: one kernel, along either axis.
        let kernel = kernel(self.blur * FINE as f64);
        let rows = reduce(&light, fine, self.size, &kernel);
        let columns = reduce(&rows, fine, self.size, &kernel);
        columns
            .iter()
            .map(|&light| {
                let noisy = light + self.noise * (0.1 + light).sqrt() * dice.normal();
                let code = if noisy <= 0.003_130_8 {
                    12.92 * noisy
                } else {
                    1.055 * noisy.powf(1.0 / 2.4) - 0.055
                };
                (255.0 * code).round().clamp(0.0, 255.0) as u8
            })
            .collect()
    }

    fn refine(&self, dice: &mut Dice, guess: &[ViewPixel; 4]) -> Option<RefinedCorners> {
        let pixels = self.render(dice);
        let image = LumaImage::new(&pixels, self.size, self.size, self.size).unwrap();
        let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
        refine_corners(&image, &light, guess, &self.print())
    }

    /// A guess as OpenCV makes them: inside, and on whole pixels.
    fn guess(&self, dice: &mut Dice) -> [ViewPixel; 4] {
        let middle = self.middle();
        self.corners.map(|corner| {
            let inwards = (middle - corner.0).normalize() * dice.uniform(0.2, 1.2);
            ViewPixel((corner.0 + inwards).map(|x| (x + dice.uniform(-0.3, 0.3)).round()))
        })
    }

    fn middle(&self) -> Vector2<f64> {
        self.corners.iter().map(|corner| corner.0).sum::<Vector2<f64>>() / 4.0
    }
}

fn homography(corners: &[ViewPixel; 4]) -> Matrix3<f64> {
    // From four points of the map that the library makes of the corners: exact up to a factor.
    let square = SquareInView::new(corners).unwrap();
    let columns = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)].map(|(u, v)| square.at(u, v).0.push(1.0));
    let fourth = square.at(1.0, 1.0).0.push(1.0);
    let base = Matrix3::from_columns(&columns);
    // (u, v) is (1 - u - v, u, v) of the three, up to their scales; (1, 1) is (-1, 1, 1) of them.
    let scale = base.try_inverse().unwrap() * fourth;
    let scaled = base * Matrix3::from_diagonal(&Vector3::new(-scale.x, scale.y, scale.z));
    let unit = Matrix3::new(-1.0, -1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0);
    scaled * unit
}

/// Gaussian, then a box of one pixel, in fine steps.
fn kernel(sigma: f64) -> Vec<f64> {
    let half = (4.0 * sigma).ceil() as i32 + FINE as i32;
    let gauss = |x: f64| (-0.5 * (x / sigma).powi(2)).exp();
    let weights: Vec<f64> = (-half..half)
        .map(|k| {
            (0..FINE).map(|b| gauss(f64::from(k) + 0.5 - b as f64 + FINE as f64 / 2.0 - 0.5)).sum()
        })
        .collect();
    let total: f64 = weights.iter().sum();
    weights.iter().map(|weight| weight / total).collect()
}

/// Convolves the rows, keeps one value for each pixel, and turns the image by its diagonal.
fn reduce(light: &[f64], fine: usize, size: usize, kernel: &[f64]) -> Vec<f64> {
    let rows = light.len() / fine;
    let mut out = vec![0.0; rows * size];
    for y in 0..rows {
        for x in 0..size {
            // The pixel's middle lies between two fine points; the kernel has an even length.
            let middle = (x * FINE + FINE / 2) as isize;
            let first = middle - kernel.len() as isize / 2;
            let value = kernel.iter().enumerate().map(|(k, weight)| {
                let at = (first + k as isize).clamp(0, fine as isize - 1) as usize;
                weight * light[y * fine + at]
            });
            out[x * rows + y] = value.sum();
        }
    }
    out
}

/// Over many markers: share refined, mean radial error (outwards is positive), scatter of both
/// coordinates, and root mean square of error over stated deviation.
struct Outcome {
    refined: f64,
    bias: f64,
    scatter: f64,
    normalised: f64,
}

fn measure(seed: u64, side: f64, tilt_deg: f64, blur: f64, noise: f64, runs: usize) -> Outcome {
    let mut dice = Dice(seed);
    let (mut radial, mut squares, mut normalised, mut refined) = (0.0, 0.0, 0.0, 0);
    for _ in 0..runs {
        let scene = Scene::new(&mut dice, side, tilt_deg.to_radians(), blur, noise);
        let guess = scene.guess(&mut dice);
        let Some(found) = scene.refine(&mut dice, &guess) else { continue };
        refined += 1;
        let middle = scene.middle();
        for k in 0..4 {
            let error = found.corners_in_view[k].0 - scene.corners[k].0;
            radial += error.dot(&(scene.corners[k].0 - middle).normalize());
            squares += error.norm_squared() / 2.0;
            normalised += error.norm_squared() / 2.0 / found.deviations_px[k].powi(2);
        }
    }
    let corners = 4.0 * refined as f64;
    let outcome = Outcome {
        refined: refined as f64 / runs as f64,
        bias: radial / corners,
        scatter: (squares / corners).sqrt(),
        normalised: (normalised / corners).sqrt(),
    };
    println!(
        "side {side:4} tilt {tilt_deg:4} blur {blur:4} noise {noise:5}: refined {:5.1} %, radial \
         bias {:+.3} px, scatter {:.3} px, error/deviation {:.2}",
        100.0 * outcome.refined,
        outcome.bias,
        outcome.scatter,
        outcome.normalised
    );
    outcome
}

#[test]
fn corners_are_unbiased_and_their_deviations_honest() {
    for (index, side) in [14.0, 20.0, 30.0, 60.0].into_iter().enumerate() {
        for tilt in [0.0, 30.0, 60.0] {
            for blur in [0.6, 1.0, 1.5] {
                let outcome = measure(77 + index as u64, side, tilt, blur, 0.01, 40);
                // A cell of this marker, where it is narrowest, in blurs: below two the edge's
                // neighbours are in it, and nobody knows what lies beyond the quiet zone.
                let cell = side * tilt.to_radians().cos() / 7.0;
                if cell < 1.9 * blur {
                    continue;
                }
                assert!(outcome.refined >= 0.85, "too few");
                assert!(outcome.bias.abs() < 0.1, "biased");
                // Deviations have a floor of 0.03 px and of 0.03 blurs: cameras are less perfect
                // than these drawings, whose blur is the model's own.
                let honest = (0.5..2.0).contains(&outcome.normalised)
                    || (outcome.normalised < 0.5 && outcome.scatter < 0.035 * blur.max(0.8));
                assert!(honest, "dishonest");
            }
        }
    }
}

#[test]
fn a_hidden_piece_of_a_side_does_little_harm() {
    let mut dice = Dice(5);
    let mut errors = Vec::new();
    for _ in 0..30 {
        let mut scene = Scene::new(&mut dice, 36.0, 0.4, 0.9, 0.005);
        scene.hidden = 0.2;
        let guess = scene.guess(&mut dice);
        if let Some(found) = scene.refine(&mut dice, &guess) {
            errors.extend((0..4).map(|k| (found.corners_in_view[k].0 - scene.corners[k].0).norm()));
        }
    }
    errors.sort_by(f64::total_cmp);
    println!("{} corners, median {:.3} px", errors.len(), errors[errors.len() / 2]);
    assert!(errors.len() > 60 && errors[errors.len() / 2] < 0.15);
}

#[test]
fn clipped_whites_do_not_move_the_edge() {
    let mut dice = Dice(9);
    let mut radial = Vec::new();
    for _ in 0..30 {
        let mut scene = Scene::new(&mut dice, 30.0, 0.5, 1.0, 0.005);
        scene.white = 1.3;
        let guess = scene.guess(&mut dice);
        let Some(found) = scene.refine(&mut dice, &guess) else { continue };
        let middle = scene.middle();
        radial.extend((0..4).map(|k| {
            let error = found.corners_in_view[k].0 - scene.corners[k].0;
            error.dot(&(scene.corners[k].0 - middle).normalize())
        }));
    }
    let mean = radial.iter().sum::<f64>() / radial.len() as f64;
    println!("{} corners, mean radial error {mean:+.3} px", radial.len());
    assert!(radial.len() > 60 && mean.abs() < 0.1);
}

#[test]
fn without_a_marker_there_is_no_answer() {
    let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
    let guess = [(10.0, 10.0), (30.0, 10.0), (30.0, 30.0), (10.0, 30.0)];
    let guess = guess.map(|(x, y)| ViewPixel::new(x, y));
    let print = MarkerPrint::of_bits(&[true; 25]).unwrap();
    let mut dice = Dice(3);
    for flat in [0u8, 90, 255] {
        let pixels = [flat; 1600];
        let image = LumaImage::new(&pixels, 40, 40, 40).unwrap();
        assert_eq!(refine_corners(&image, &light, &guess, &print), None);
    }
    // Too small, beyond the border, turned round, no numbers, one pixel.
    let pixels: Vec<u8> = (0..1600).map(|_| dice.uniform(0.0, 255.0) as u8).collect();
    let image = LumaImage::new(&pixels, 40, 40, 40).unwrap();
    let shifted =
        |scale: f64, by: f64| guess.map(|p| ViewPixel(p.0 * scale + Vector2::new(by, by)));
    assert_eq!(refine_corners(&image, &light, &shifted(0.3, 0.0), &print), None);
    assert_eq!(refine_corners(&image, &light, &shifted(1.0, 100.0), &print), None);
    assert_eq!(refine_corners(&image, &light, &shifted(1.0, f64::NAN), &print), None);
    let mut turned = guess;
    turned.reverse();
    assert_eq!(refine_corners(&image, &light, &turned, &print), None);
    let point = LumaImage::new(&pixels[..1], 1, 1, 1).unwrap();
    assert_eq!(refine_corners(&point, &light, &guess, &print), None);
}

#[test]
fn guesses_a_pixel_and_a_half_off_lead_to_the_same_corners() {
    let mut dice = Dice(21);
    for _ in 0..20 {
        let scene = Scene::new(&mut dice, 28.0, 0.5, 0.9, 0.0);
        let pixels = scene.render(&mut dice);
        let image = LumaImage::new(&pixels, scene.size, scene.size, scene.size).unwrap();
        let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
        let print = scene.print();
        let exact = refine_corners(&image, &light, &scene.corners, &print).expect("from the truth");
        let middle = scene.middle();
        let inside = scene.corners.map(|p| ViewPixel(p.0 + (middle - p.0).normalize() * 1.5));
        assert!(mean_side_px(&inside) < mean_side_px(&scene.corners));
        let found = refine_corners(&image, &light, &inside, &print).expect("from inside");
        for k in 0..4 {
            let apart = (found.corners_in_view[k].0 - exact.corners_in_view[k].0).norm();
            assert!(apart < 0.05, "corner {k}: {apart} px apart");
        }
    }
}
