//! Interpolation of the sphere image in integers, so that every back end gives the same bytes.

use super::cubic;
use super::fixed_point::{FRACTION_BITS, NOWHERE};
use super::image::SphereImage;

/// Largest weight of a row. Times 255, the largest weight of a column, it is 2^22 within 2e-5, so
/// that a shift divides by it. Smaller weights are truncated, by 0.5 each on average, so it is
/// larger by two than 2^22/255.
pub(super) const ROW_WEIGHT: u16 = 16_450;

/// Bits of the product of a column's and a row's weight.
pub(super) const WEIGHT_BITS: u32 = 22;

/// The grey value at a position between four pixels (upper left, upper right, lower left, lower
/// right). The position is (column, row) in 1/65536 px, of which only the fractions count.
#[inline(always)]
pub(super) fn blend([column, row]: [i32; 2], pixels: [u8; 4]) -> u8 {
    // Grey values are relative to 128, so that vector code can hold weighted sums in 16 bits.
    let [a, b, c, d] = pixels.map(|grey| i32::from(grey) - 128);
    let right = (column >> (FRACTION_BITS - 8)) & 0xff;
    let upper = (255 - right) * a + right * b;
    let lower = (255 - right) * c + right * d;
    let down = row & 0xffff;
    let weight = i32::from(ROW_WEIGHT);
    let (above, below) = (((0xffff - down) * weight) >> 16, (down * weight) >> 16);
    let sum = upper * above + lower * below;
    ((sum + (128 << WEIGHT_BITS) + (1 << (WEIGHT_BITS - 1))) >> WEIGHT_BITS) as u8
}

/// The grey value at any position, 1/65536 px, interpolated bilinearly.
#[inline(always)]
fn sample(sphere: &SphereImage<'_>, [column, row]: [i32; 2]) -> u8 {
    if column == NOWHERE {
        return 0;
    }
    let (left, top) = (column >> FRACTION_BITS, row >> FRACTION_BITS);
    let pixel = |x: i32, y: i32| pixel(sphere, left + x, top + y);
    blend([column, row], [pixel(0, 0), pixel(1, 0), pixel(0, 1), pixel(1, 1)])
}

/// The grey value at any position, 1/65536 px, interpolated by the cubic.
#[inline(always)]
fn sample_cubic(sphere: &SphereImage<'_>, [column, row]: [i32; 2]) -> u8 {
    if column == NOWHERE {
        return 0;
    }
    let (left, top) = ((column >> FRACTION_BITS) - 1, (row >> FRACTION_BITS) - 1);
    let line = |y: i32| [0, 1, 2, 3].map(|x| pixel(sphere, left + x, top + y));
    cubic::blend([column, row], [line(0), line(1), line(2), line(3)])
}

/// The grey value at any position, 1/65536 px, by [`sample_cubic`] or [`sample`].
#[inline(always)]
pub(super) fn sample_by<const CUBIC: bool>(sphere: &SphereImage<'_>, at: [i32; 2]) -> u8 {
    if CUBIC { sample_cubic(sphere, at) } else { sample(sphere, at) }
}

/// The pixel at column `x` of row `y`, which may lie outside the image. An equirectangular image
/// wraps around, and continues half a turn further beyond its first and last row. Others repeat
/// their outermost pixels.
#[inline(always)]
fn pixel(sphere: &SphereImage<'_>, x: i32, y: i32) -> u8 {
    let (width, height) = (sphere.camera.width() as i32, sphere.camera.height() as i32);
    let (mut x, mut y) = (x, y);
    if sphere.is_round() {
        if y < 0 || y >= height {
            x += width / 2;
            y = if y < 0 { -1 - y } else { 2 * height - 1 - y };
        }
        if !(0..width).contains(&x) {
            x = x.rem_euclid(width);
        }
    }
    let (x, y) = (x.clamp(0, width - 1), y.clamp(0, height - 1));
    sphere.pixels[y as usize * sphere.stride + x as usize]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blending_is_bilinear_within_its_rounding() {
        let corners = [[0, 255, 255, 0], [255, 255, 255, 255], [0, 0, 0, 0], [3, 90, 200, 17]];
        for pixels in corners {
            let [a, b, c, d] = pixels.map(f64::from);
            for column in (0..65_536).step_by(771) {
                for row in (0..65_536).step_by(771) {
                    let (x, y) = (f64::from(column) / 65_536.0, f64::from(row) / 65_536.0);
                    let exact = (1.0 - y) * ((1.0 - x) * a + x * b) + y * ((1.0 - x) * c + x * d);
                    let found = f64::from(blend([column, row], pixels));
                    // The fraction of a column is rounded to 1/256, of up to 255 grey levels.
                    assert!(
                        (found - exact).abs() < 0.52 + (b - a).abs().max((d - c).abs()) / 256.0
                    );
                }
            }
        }
    }

    #[test]
    fn neighbours_continue_across_the_seam_and_the_poles() {
        #![allow(clippy::unwrap_used)]
        let camera = flockeye_geometry::camera::Camera::equirectangular(4, 2);
        let pixels = [10, 20, 30, 40, 50, 60, 70, 80];
        let sphere = SphereImage::new(&pixels, 4, camera).unwrap();
        let at = |x: f64, y: f64| sample(&sphere, [(x * 65_536.0) as i32, (y * 65_536.0) as i32]);
        assert_eq!(at(0.0, 0.0), 10);
        assert_eq!([at(-0.5, 0.0), at(3.5, 0.0), at(7.5, 0.0)], [25; 3]);
        // Above column 0 of the first row lies column 2 of the same row. Below the last row it is
        // the same.
        assert_eq!([at(0.0, -0.5), at(0.0, 1.5)], [20, 60]);
    }
}
