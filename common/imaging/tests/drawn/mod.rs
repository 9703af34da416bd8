//! Exactly rendered markers: blurred as radiance, integrated over each pixel, with noise, and
//! encoded.

#![allow(clippy::unwrap_used, clippy::expect_used)]

use flockeye_geometry::view::ViewPixel;
use flockeye_imaging::edges::MarkerPrint;
use flockeye_imaging::light::TransferCurve;
use flockeye_imaging::square::SquareInView;
use nalgebra::{Matrix3, Rotation3, Unit, Vector3};

/// Cells along a marker's side.
pub(crate) const CELLS: usize = 7;
/// Points rendered for each pixel, along each axis.
const FINE: usize = 8;

/// Pseudorandom numbers by xorshift64*, the same on every machine.
pub(crate) struct Dice(pub u64);

impl Dice {
    pub(crate) fn uniform(&mut self, from: f64, to: f64) -> f64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        let bits = self.0.wrapping_mul(0x2545_f491_4f6c_dd1d) >> 11;
        from + (to - from) * bits as f64 / (1u64 << 53) as f64
    }

    /// Mean 0, variance 1.
    pub(crate) fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform(0.0, 1.0)).sum::<f64>() - 6.0
    }
}

/// Code values of radiances, with noise of this size. The noise is that of photons and of the
/// readout.
pub(crate) fn encode(
    radiances: &[f64],
    curve: TransferCurve,
    noise: f64,
    dice: &mut Dice,
) -> Vec<u8> {
    let code = |radiance: f64| match curve {
        TransferCurve::Linear => radiance,
        TransferCurve::Gamma(gamma) => radiance.max(0.0).powf(1.0 / f64::from(gamma)),
        TransferCurve::Srgb if radiance <= 0.003_130_8 => 12.92 * radiance,
        TransferCurve::Srgb => 1.055 * radiance.powf(1.0 / 2.4) - 0.055,
    };
    let noisy = |radiance: f64| radiance + noise * (0.1 + radiance).sqrt() * dice.normal();
    radiances
        .iter()
        .copied()
        .map(noisy)
        .map(|x| (255.0 * code(x)).round().clamp(0.0, 255.0) as u8)
        .collect()
}

/// One marker in front of a camera.
pub(crate) struct Scene {
    pub size: usize,
    pub corners: [ViewPixel; 4],
    pub cells: [[bool; CELLS]; CELLS],
    pub blur: f64,
    pub white: f64,
    pub black: f64,
    /// Radiance beyond the quiet zone, on each side.
    pub around: [f64; 4],
    /// Share of the first side, about its middle, that something grey occludes.
    pub occluded: f64,
    /// The corner that a dark strut, a quarter of a side wide, runs into from outside.
    pub strut: Option<usize>,
    /// What holds the marker by a corner.
    pub glove: Option<Glove>,
    /// Stripes of sun across the plane.
    pub stripes: Option<Stripes>,
}

/// Something with a straight edge that covers a corner, as fingers do that hold a marker.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Glove {
    /// The corner.
    pub corner: usize,
    /// How much it covers of the corner's two sides, as shares of them.
    pub covered: [f64; 2],
    pub radiance: f64,
}

impl Glove {
    fn covers(&self, u: f64, v: f64) -> bool {
        // From the corner along both sides; the plane beyond the square is covered too.
        let along = [
            if matches!(self.corner, 1 | 2) { 1.0 - u } else { u },
            if matches!(self.corner, 2 | 3) { 1.0 - v } else { v },
        ];
        along[0] / self.covered[0] + along[1] / self.covered[1] < 1.0
    }
}

/// Stripes of sun, as wide as the shade between them.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Stripes {
    /// Direction across them, radians.
    pub across_rad: f64,
    /// Where the first begins, and the width of sun and shade together, sides of the marker.
    pub first: f64,
    pub width: f64,
    /// Light in the shade, as a share of that in the sun.
    pub shade: f64,
}

impl Stripes {
    /// Stripes of any direction, with a width of half a side to one and a half, and this share of
    /// light between them.
    pub(crate) fn of_shade(shade: f64, dice: &mut Dice) -> Self {
        Self {
            across_rad: dice.uniform(0.0, 6.3),
            first: dice.uniform(0.0, 1.5),
            width: dice.uniform(0.5, 1.5),
            shade,
        }
    }

    fn light(&self, u: f64, v: f64) -> f64 {
        let (sine, cosine) = self.across_rad.sin_cos();
        let at = ((u * cosine + v * sine - self.first) / self.width).rem_euclid(1.0);
        if at < 0.5 { 1.0 } else { self.shade }
    }
}

impl Scene {
    /// A marker whose sides, seen frontally, would have `side` pixels, tilted by `tilt`.
    pub(crate) fn new(dice: &mut Dice, side: f64, tilt: f64, blur: f64) -> Self {
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
            white: dice.uniform(0.4, 0.85),
            black: dice.uniform(0.01, 0.05),
            around,
            occluded: 0.0,
            strut: None,
            glove: None,
            stripes: None,
        }
    }

    /// Radiance of the printed plane. The black square is [0, 1] x [0, 1].
    pub(crate) fn radiance(&self, u: f64, v: f64) -> f64 {
        self.printed(u, v) * self.stripes.map_or(1.0, |stripes| stripes.light(u, v))
    }

    /// The same in even light.
    fn printed(&self, u: f64, v: f64) -> f64 {
        // 0.875 cells of quiet zone: facets of 62.5 mm with markers of 50 mm.
        let quiet = 0.875 / CELLS as f64;
        if self.occluded > 0.0 && (u - 0.5).abs() < self.occluded / 2.0 && v < 0.3 {
            return 0.3;
        }
        if let Some(k) = self.strut {
            let (corner_u, corner_v) = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)][k];
            let (x, y) = (u - corner_u, v - corner_v);
            let (right, down) = (2.0 * corner_u - 1.0, 2.0 * corner_v - 1.0);
            let is_outside = x * right > 0.0 || y * down > 0.0;
            if is_outside && x * right + y * down > -0.1 && (x * down - y * right).abs() < 0.18 {
                return self.black;
            }
        }
        if let Some(glove) = self.glove.filter(|glove| glove.covers(u, v)) {
            return glove.radiance;
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

    pub(crate) fn print(&self) -> MarkerPrint {
        let inner = self.cells[1..CELLS - 1].iter().flat_map(|row| row[1..CELLS - 1].iter());
        MarkerPrint::of_bits(&inner.copied().collect::<Vec<bool>>()).unwrap()
    }

    /// The radiance that each pixel integrates.
    pub(crate) fn render(&self) -> Vec<f64> {
        let fine = self.size * FINE;
        let square_from_view = homography(&self.corners).try_inverse().unwrap();
        let at = |k: usize| (k as f64 + 0.5) / FINE as f64 - 0.5;
        let mut radiances: Vec<f64> = Vec::with_capacity(fine * fine);
        for y in 0..fine {
            for x in 0..fine {
                let p = square_from_view * Vector3::new(at(x), at(y), 1.0);
                radiances.push(self.radiance(p.x / p.z, p.y / p.z));
            }
        }
        // The lens blurs, and the pixel takes the mean over its area: one kernel along each axis.
        let kernel = kernel(self.blur * FINE as f64);
        let rows = reduce(&radiances, fine, self.size, &kernel);
        reduce(&rows, fine, self.size, &kernel)
    }
}

fn homography(corners: &[ViewPixel; 4]) -> Matrix3<f64> {
    // From four points of the library's map, which is exact up to a factor.
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

/// A Gaussian convolved with a box of one pixel, in fine steps.
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

/// Convolves the rows, keeps one value for each pixel, and transposes the image.
fn reduce(radiances: &[f64], fine: usize, size: usize, kernel: &[f64]) -> Vec<f64> {
    let rows = radiances.len() / fine;
    let mut out = vec![0.0; rows * size];
    for y in 0..rows {
        for x in 0..size {
            // The pixel's middle lies between two fine points; the kernel has an even length.
            let middle = (x * FINE + FINE / 2) as isize;
            let first = middle - kernel.len() as isize / 2;
            let value = kernel.iter().enumerate().map(|(k, weight)| {
                let at = (first + k as isize).clamp(0, fine as isize - 1) as usize;
                weight * radiances[y * fine + at]
            });
            out[x * rows + y] = value.sum();
        }
    }
    out
}
