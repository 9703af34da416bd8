//! From code values back to radiance (linear light).
//!
//! A lens blurs an edge, then the camera encodes it. That moves the edge towards the dark side,
//! because the curve lifts dark values more than bright ones: by some tenths of a pixel on a 20 px
//! marker. So all edge measurements use linear values.

use flockeye_geometry::view::ViewPixel;
use thiserror::Error;

use crate::image::LumaImage;

/// The curve from radiance to code values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TransferCurve {
    /// The sRGB curve (IEC 61966-2-1).
    Srgb,
    /// code = radiance^(1/gamma).
    Gamma(f32),
    /// Code values proportional to radiance.
    Linear,
}

/// Code values of black and white.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CodeRange {
    /// 0 to 255.
    Full,
    /// 16 to 235, as in most video (ITU-R BT.601 and BT.709).
    Limited,
}

impl CodeRange {
    /// A code value between black, 0, and nominal white, 1.
    fn value(self, code: f64) -> f64 {
        match self {
            Self::Full => code / 255.0,
            Self::Limited => (code - 16.0) / 219.0,
        }
    }
}

/// Least gamma of a camera, and the largest: see [`LinearLight::gamma_seen`].
const LEAST_GAMMA: f64 = 0.4;
const MOST_GAMMA: f64 = 4.0;

/// Reason why a curve cannot be inverted.
#[allow(missing_docs, reason = "the messages say what each is")]
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum LightError {
    #[error("a gamma of {gamma} cannot be undone; 0.1 to 10 can")]
    Gamma { gamma: f32 },
    #[error(
        "code {code} stands for {light}, the code before it for {before}; light must not fall, and be finite"
    )]
    Table { code: u8, light: f32, before: f32 },
}

/// Radiance of each code value: black is 0, nominal white is 1.
#[derive(Debug, Clone, PartialEq)]
pub struct LinearLight {
    table: [f32; 256],
    range: CodeRange,
}

impl LinearLight {
    /// The table that inverts `curve`. Code values beyond nominal black and white continue the
    /// curve, below black with a negative sign, so that noise around black keeps its mean.
    ///
    /// # Errors
    /// A gamma outside 0.1 to 10.
    pub fn new(curve: TransferCurve, range: CodeRange) -> Result<Self, LightError> {
        if let TransferCurve::Gamma(gamma) = curve
            && !(0.1..=10.0).contains(&gamma)
        {
            return Err(LightError::Gamma { gamma });
        }
        let mut table = [0.0; 256];
        for (code, light) in (0u16..).zip(&mut table) {
            let value = range.value(f64::from(code));
            *light = (undo(curve, value.abs()) * value.signum()) as f32;
        }
        Ok(Self { table, range })
    }

    /// Creates the table of a measured response: the radiance of each code value, up to a common
    /// factor.
    ///
    /// # Errors
    /// The first code value at which the radiance falls or is not finite.
    pub fn from_table(table: [f32; 256]) -> Result<Self, LightError> {
        let mut before = f32::MIN;
        for (code, &light) in (0u8..=255).zip(&table) {
            if !(light.is_finite() && light >= before) {
                return Err(LightError::Table { code, light, before });
            }
            before = light;
        }
        Ok(Self { table, range: CodeRange::Full })
    }

    /// Radiance of `code`.
    #[inline]
    pub fn of(&self, code: u8) -> f32 {
        self.table[usize::from(code)]
    }

    /// Radiance of a code value that need not be whole. Beyond 0 and 255 the curve is extrapolated.
    pub fn between(&self, code: f64) -> f64 {
        let below = code.clamp(0.0, 254.0) as usize;
        let (here, next) = (f64::from(self.table[below]), f64::from(self.table[below + 1]));
        here + (next - here) * (code - below as f64)
    }

    /// Code value of a radiance, not necessarily whole; 0 or 255 beyond the curve's ends.
    pub fn code_of(&self, radiance: f64) -> f64 {
        let above = self.table.partition_point(|&of| f64::from(of) < radiance).clamp(1, 255);
        let (below, at) = (f64::from(self.table[above - 1]), f64::from(self.table[above]));
        let share = if at > below { (radiance - below) / (at - below) } else { 0.0 };
        (above - 1) as f64 + share.clamp(0.0, 1.0)
    }

    /// The radiance of every code value.
    pub fn table(&self) -> &[f32; 256] {
        &self.table
    }

    /// Curvature -L c''/c' of code values c over radiance L, in the middle of the range.
    ///
    /// It is 1 - 1/g where code values are the g-th root of radiance, and 0 where they are
    /// proportional to it. It determines the shift of edges by smoothing of code values.
    pub fn bend(&self) -> f64 {
        let [dark, middle, light] = [68, 128, 188].map(|code: u8| f64::from(self.of(code)));
        let (step, slope) = (60.0, (light - dark) / 120.0);
        let curvature = (light - 2.0 * middle + dark) / (step * step);
        // By the inverse function: with L = d(c), -L c''/c' = L d''/d'^2.
        if slope > 0.0 { middle * curvature / (slope * slope) } else { 0.0 }
    }

    /// The gamma with which the middle between black and white looks as it does.
    ///
    /// `black` and `white` are radiances by this table, and the apparent middle between both is off
    /// by a quarter of `bend` times their difference. `None` where no gamma from 0.4 to 4 explains
    /// that, or codes are not those of black and white.
    pub(crate) fn gamma_seen(&self, [black, white]: [f64; 2], bend: f64) -> Option<f64> {
        // A fitted level beyond white is no measured one.
        if white > f64::from(self.of(u8::MAX)) {
            return None;
        }
        let seen = (black + white) / 2.0 + bend * (white - black) / 4.0;
        let [black, seen, white] =
            [black, seen, white].map(|radiance| self.range.value(self.code_of(radiance)).max(0.0));
        let share = |gamma: f64| {
            let [black, seen, white] = [black, seen, white].map(|value| value.powf(gamma));
            (seen - black) / (white - black)
        };
        let (mut low, mut high) = (LEAST_GAMMA, MOST_GAMMA);
        // A larger gamma makes the middle darker. False for a NaN.
        let is_between = share(low) > 0.5 && share(high) < 0.5;
        while is_between && high - low > 1e-4 {
            let middle = (low + high) / 2.0;
            *(if share(middle) > 0.5 { &mut low } else { &mut high }) = middle;
        }
        is_between.then_some((low + high) / 2.0)
    }

    /// The radiance at a point between pixels, interpolated bilinearly between linear values.
    /// `None` where one of the four pixels around it is outside the image.
    // Called for hundreds of points of each square.
    #[inline(always)]
    pub fn at(&self, image: &LumaImage<'_>, at: ViewPixel) -> Option<f32> {
        let (x, y) = (at.0.x, at.0.y);
        let (last_x, last_y) = ((image.width() - 1) as f64, (image.height() - 1) as f64);
        // In this form a NaN counts as outside.
        if !(x >= 0.0 && y >= 0.0 && x <= last_x && y <= last_y) {
            return None;
        }
        // Converting a float to i32 takes fewer instructions than to usize, and no image is wider.
        let (left, top) = (x as i32, y as i32);
        let (fx, fy) = ((x - f64::from(left)) as f32, (y - f64::from(top)) as f32);
        let (left, top) = (left as usize, top as usize);
        let (right, bottom) =
            ((left + 1).min(image.width() - 1), (top + 1).min(image.height() - 1));
        let row = |y: usize| {
            let row = image.row(y);
            self.of(row[left]) * (1.0 - fx) + self.of(row[right]) * fx
        };
        Some(row(top) * (1.0 - fy) + row(bottom) * fy)
    }
}

/// Radiance in [0, 1] of the encoded `value` >= 0.
fn undo(curve: TransferCurve, value: f64) -> f64 {
    match curve {
        TransferCurve::Srgb if value <= 0.04045 => value / 12.92,
        TransferCurve::Srgb => ((value + 0.055) / 1.055).powf(2.4),
        TransferCurve::Gamma(gamma) => value.powf(f64::from(gamma)),
        TransferCurve::Linear => value,
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;

    #[test]
    fn code_values_proportional_to_radiance_have_no_curvature() {
        let linear = LinearLight::new(TransferCurve::Linear, CodeRange::Limited).unwrap();
        assert!(linear.bend().abs() < 1e-6);
        let square_root = LinearLight::new(TransferCurve::Gamma(2.0), CodeRange::Full).unwrap();
        assert!((square_root.bend() - 0.5).abs() < 1e-3);
        assert!(LinearLight::from_table([0.5; 256]).unwrap().bend() == 0.0);
    }

    #[test]
    fn standard_curves_have_their_known_values() {
        let srgb = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
        assert!((srgb.of(0), srgb.of(255)) == (0.0, 1.0));
        // The curve's exponent is 2.4; the straight part near black lowers the effective one.
        assert!((srgb.bend() - (1.0 - 1.0 / 2.4)).abs() < 0.03);
        // 18 % grey is code 118 in sRGB, 21 % is 128.
        assert!((srgb.of(118) - 0.1812).abs() < 1e-3 && (srgb.of(128) - 0.2159).abs() < 1e-3);
        let video = LinearLight::new(TransferCurve::Gamma(2.0), CodeRange::Limited).unwrap();
        assert!((video.of(16), video.of(235)) == (0.0, 1.0));
        assert!((video.of(126) - 0.2523).abs() < 1e-3);
        assert!(video.of(10) < 0.0 && video.of(255) > 1.0);
    }

    #[test]
    fn every_table_increases() {
        for curve in [TransferCurve::Srgb, TransferCurve::Gamma(2.2), TransferCurve::Linear] {
            for range in [CodeRange::Full, CodeRange::Limited] {
                let light = LinearLight::new(curve, range).unwrap();
                assert!(light.table().windows(2).all(|pair| pair[0] < pair[1]), "{curve:?}");
                assert_eq!(LinearLight::from_table(*light.table()).unwrap().table(), light.table());
            }
        }
    }

    #[test]
    fn codes_between_whole_ones_go_there_and_back() {
        let srgb = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
        for code in [0.0, 0.25, 17.5, 128.0, 254.9, 255.0] {
            assert!((srgb.code_of(srgb.between(code)) - code).abs() < 1e-3, "{code}");
        }
        assert!((srgb.code_of(-1.0), srgb.code_of(2.0)) == (0.0, 255.0));
        assert!(srgb.between(-10.0) < 0.0 && srgb.between(260.0) > 1.0);
        let flat = LinearLight::from_table([0.5; 256]).unwrap();
        assert!(flat.code_of(0.5).is_finite() && flat.between(3.3) == 0.5);
    }

    #[test]
    fn a_wrong_curve_gives_the_right_gamma() {
        let table = |curve| LinearLight::new(curve, CodeRange::Full).unwrap();
        let (srgb, linear) = (table(TransferCurve::Srgb), table(TransferCurve::Linear));
        for (assumed, actual, gamma) in [
            (&srgb, &linear, 0.99..1.01),
            (&linear, &linear, 0.99..1.01),
            (&srgb, &srgb, 2.0..2.3),
            (&linear, &srgb, 2.0..2.3),
            (&linear, &table(TransferCurve::Gamma(1.7)), 1.69..1.71),
        ] {
            let levels = [0.05, 0.6].map(|light| assumed.between(actual.code_of(light)));
            let middle = assumed.between(actual.code_of(0.325));
            let bend = 4.0 * (middle - (levels[0] + levels[1]) / 2.0) / (levels[1] - levels[0]);
            let seen = assumed.gamma_seen(levels, bend).unwrap();
            assert!(gamma.contains(&seen), "{seen}, not {gamma:?}");
        }
        for (levels, bend) in
            [([0.5, 0.5], 0.1), ([0.1, 0.6], 3.0), ([0.1, 1.2], 0.0), ([0.1, 0.6], f64::NAN)]
        {
            assert_eq!(srgb.gamma_seen(levels, bend), None, "{levels:?} {bend}");
        }
    }

    #[test]
    fn curves_that_cannot_be_inverted_are_refused() {
        for gamma in [0.0, -1.0, f32::NAN, 11.0] {
            assert!(LinearLight::new(TransferCurve::Gamma(gamma), CodeRange::Full).is_err());
        }
        let mut table = std::array::from_fn(|code| code as f32);
        table[77] = 3.0;
        let error = LinearLight::from_table(table).unwrap_err();
        assert_eq!(error, LightError::Table { code: 77, light: 3.0, before: 76.0 });
        table[77] = f32::NAN;
        assert!(LinearLight::from_table(table).is_err());
    }

    #[test]
    fn radiance_is_interpolated_between_linear_values() {
        let light = LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap();
        let pixels = [0, 255, 0, 255];
        let image = LumaImage::new(&pixels, 2, 2, 2).unwrap();
        assert_eq!(light.at(&image, ViewPixel::new(0.25, 0.7)), Some(0.25));
        assert_eq!(light.at(&image, ViewPixel::new(1.0, 1.0)), Some(1.0));
        assert_eq!(light.at(&image, ViewPixel::new(1.01, 0.0)), None);
        assert_eq!(light.at(&image, ViewPixel::new(f64::NAN, 0.0)), None);
    }
}
