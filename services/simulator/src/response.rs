//! The response curve between light and code values, in both directions.

use flockeye_imaging::light::TransferCurve;

/// The response curve of a camera.
#[derive(Debug, Clone, Copy, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "a world has one, and it is copied seldom")]
pub enum CameraCurve {
    /// A standard curve.
    Curve(TransferCurve),
    /// A measured curve: light of each code value, rising to 1.
    Table([f32; 256]),
}

impl CameraCurve {
    /// Linear light of `level`, as a share of full scale. sRGB: IEC 61966-2-1.
    pub(crate) fn light(&self, level: u8) -> f32 {
        let encoded = f32::from(level) / 255.0;
        match self {
            Self::Curve(TransferCurve::Srgb) if encoded <= 0.040_45 => encoded / 12.92,
            Self::Curve(TransferCurve::Srgb) => ((encoded + 0.055) / 1.055).powf(2.4),
            Self::Curve(TransferCurve::Gamma(gamma)) => encoded.powf(*gamma),
            Self::Curve(TransferCurve::Linear) => encoded,
            Self::Table(table) => table[usize::from(level)],
        }
    }

    /// Encoded value (0 to 1) of linear light (0 to 1), before rounding to a level.
    pub(crate) fn encoded(&self, light: f32) -> f32 {
        match self {
            Self::Curve(TransferCurve::Srgb) if light <= 0.003_130_8 => light * 12.92,
            Self::Curve(TransferCurve::Srgb) => 1.055 * light.powf(1.0 / 2.4) - 0.055,
            Self::Curve(TransferCurve::Gamma(gamma)) => light.powf(1.0 / gamma),
            Self::Curve(TransferCurve::Linear) => light,
            Self::Table(table) => {
                // Index of the first code with more light; linear interpolation between the two.
                let above = table.partition_point(|&entry| entry <= light);
                let Some(below) = above.checked_sub(1) else { return 0.0 };
                let Some(&more) = table.get(above) else { return 1.0 };
                let share = (light - table[below]) / (more - table[below]);
                (below as f32 + share) / 255.0
            }
        }
    }

    /// This curve followed by a tone curve in the form of an S: c - `tone` sin(2 pi c) / (2 pi).
    pub(crate) fn bent(&self, tone: f64) -> Self {
        use std::f64::consts::TAU;
        let toned = |code: f64| code - tone * (TAU * code).sin() / TAU;
        let light_of = |code: f64| {
            // Light between two codes, linearly.
            let below = (code * 255.0).floor().clamp(0.0, 254.0);
            let [low, high] = [0, 1].map(|step| self.light(below as u8 + step));
            low + (high - low) * (code * 255.0 - below) as f32
        };
        Self::Table(std::array::from_fn(|level| {
            let wanted = level as f64 / 255.0;
            let (mut low, mut high) = (0.0, 1.0);
            for _ in 0..40 {
                let middle = (low + high) / 2.0;
                *(if toned(middle) < wanted { &mut low } else { &mut high }) = middle;
            }
            light_of((low + high) / 2.0)
        }))
    }

    /// The error in the curve, as text.
    pub(crate) fn problem(&self) -> Option<String> {
        match self {
            Self::Curve(TransferCurve::Gamma(gamma)) if !(0.1..=10.0).contains(gamma) => {
                Some(format!("a gamma of {gamma}: must be 0.1 to 10"))
            }
            Self::Curve(_) => None,
            Self::Table(table) => {
                // NaN fails the comparison.
                let rises = table.windows(2).all(|pair| pair[0] < pair[1]);
                let is_light = table[0] >= 0.0 && table[255] <= 1.0;
                (!(rises && is_light))
                    .then(|| "a response table: light must rise from code to code, 0 to 1".into())
            }
        }
    }
}

impl Default for CameraCurve {
    fn default() -> Self {
        Self::Curve(TransferCurve::Srgb)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use flockeye_imaging::light::{CodeRange, LinearLight};

    use super::*;

    #[test]
    fn every_curve_is_what_imaging_undoes() {
        for curve in [TransferCurve::Srgb, TransferCurve::Gamma(2.2), TransferCurve::Linear] {
            let undone = LinearLight::new(curve, CodeRange::Full).unwrap();
            for response in [CameraCurve::Curve(curve), CameraCurve::Table(*undone.table())] {
                for level in 0..=255 {
                    let light = undone.of(level);
                    assert!((response.light(level) - light).abs() < 1e-6, "{response:?}");
                    let code = response.encoded(light) * 255.0;
                    assert!((code - f32::from(level)).abs() < 1e-3, "{response:?} {code}");
                }
            }
        }
        // A value of the standard: half of full scale is 0.735 encoded.
        assert!((CameraCurve::default().encoded(0.5) - 0.735_36).abs() < 1e-5);
    }

    #[test]
    fn a_table_goes_on_straight_between_codes_and_ends_at_its_ends() {
        let table = std::array::from_fn(|code| 0.01 + code as f32 / 300.0);
        let response = CameraCurve::Table(table);
        assert_eq!(response.problem(), None);
        assert!((response.encoded((table[7] + table[8]) / 2.0) * 255.0 - 7.5).abs() < 1e-3);
        assert_eq!((response.encoded(0.0), response.encoded(1.0)), (0.0, 1.0));
    }

    #[test]
    fn a_tone_curve_darkens_shadows_and_brightens_lights() {
        let (plain, bent) = (CameraCurve::default(), CameraCurve::default().bent(0.5));
        assert_eq!(bent.problem(), None);
        let code = |curve: &CameraCurve, light| curve.encoded(light) * 255.0;
        assert!(code(&bent, 0.03) < code(&plain, 0.03) - 8.0);
        assert!(code(&bent, 0.6) > code(&plain, 0.6) + 8.0);
        for light in [0.0, 1.0] {
            assert!((code(&bent, light) - code(&plain, light)).abs() < 0.01);
        }
    }

    #[test]
    fn what_does_not_rise_is_no_response() {
        assert!(CameraCurve::Table([0.5; 256]).problem().is_some());
        assert!(CameraCurve::Table([f32::NAN; 256]).problem().is_some());
        assert!(CameraCurve::Curve(TransferCurve::Gamma(f32::NAN)).problem().is_some());
    }
}
