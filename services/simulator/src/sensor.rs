//! Image sensor: from linear light to code values, with response curve, clipping and noise.

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rand_distr::StandardNormal;

use crate::parameters::WorldParameters;
use crate::response::CameraCurve;
use crate::scatter::mix;

/// Entries of the table from the root of light to levels. Their step shifts rounding thresholds by
/// less than 0.02 level.
const ENCODING_STEPS: usize = 16_384;
/// Samples in the noise field.
const NOISE_SAMPLES: usize = 1 << 20;
/// Standard deviation of the noise field's values.
const NOISE_UNIT: f32 = 32.0;
/// Units of a sigma value per grey level.
const SIGMA_UNIT: f32 = 16.0;
/// Binary logarithm of (noise value times sigma value) per grey level.
const NOISE_SHIFT: i16 = 9;

/// The sensor and encoder of a camera.
#[derive(Debug)]
pub(crate) struct ImageSensor {
    decode: [f32; 256],
    encode: Vec<u8>,
    shot_variance: f32,
    read_variance: f32,
    response: CameraCurve,
    /// Output for light 1: 2 for an exposure twice the correct one.
    gain: f32,
    sigma_of_level: [u8; 256],
    /// Table from level to level and sigma after the exposure variation; `None` without a
    /// variation.
    adapted: Option<Box<[[u8; 2]; 256]>>,
    noise: Vec<i8>,
    seed: u64,
}

impl ImageSensor {
    pub(crate) fn new(parameters: &WorldParameters) -> Self {
        let response = parameters.response;
        let gain = f64::from(parameters.iso) / 100.0;
        let shot_variance = (gain * parameters.shot_noise.powi(2)) as f32;
        let read_variance = (gain * parameters.read_noise).powi(2) as f32;
        let root = |step: usize| (step as f32 + 0.5) / ENCODING_STEPS as f32;
        let mut random = StdRng::seed_from_u64(parameters.seed ^ 0x6e6f_6973);
        let noise = if shot_variance + read_variance > 0.0 { NOISE_SAMPLES } else { 0 };
        let mut sensor = Self {
            decode: std::array::from_fn(|level| response.light(level as u8)),
            encode: (0..ENCODING_STEPS)
                .map(|step| (response.encoded(root(step).powi(2)) * 255.0).round() as u8)
                .collect(),
            shot_variance,
            read_variance,
            response,
            gain: parameters.exposure_stops.exp2() as f32,
            sigma_of_level: [0; 256],
            adapted: None,
            noise: (0..noise)
                .map(|_| (random.sample::<f32, _>(StandardNormal) * NOISE_UNIT).round() as i8)
                .collect(),
            seed: parameters.seed,
        };
        sensor.sigma_of_level =
            std::array::from_fn(|level| sensor.sigma_of_light(sensor.light(level as u8)));
        sensor
    }

    /// Linear light of a level, corrected by the gain.
    pub(crate) fn light(&self, level: u8) -> f32 {
        self.decode[usize::from(level)] / self.gain
    }

    /// Level of linear light, clipped at full scale.
    pub(crate) fn level(&self, light: f32) -> u8 {
        let step = ((light * self.gain).max(0.0).sqrt() * ENCODING_STEPS as f32) as usize;
        self.encode[step.min(ENCODING_STEPS - 1)]
    }

    /// Sigma at a level, in the units of [`ImageSensor::expose`].
    pub(crate) fn sigma(&self, level: u8) -> u8 {
        self.sigma_of_level[usize::from(level)]
    }

    /// Sigma at linear light that may exceed full scale, where clipping removes the noise.
    pub(crate) fn sigma_of_light(&self, light: f32) -> u8 {
        let light = light * self.gain;
        let sigma = (self.shot_variance * light + self.read_variance).sqrt();
        if light - 4.0 * sigma > 1.0 {
            return 0;
        }
        // Mean slope of the curve over the noise's range: the curvature is too large for the
        // tangent.
        let (low, high) = ((light - sigma).max(0.0), (light + sigma).min(1.0));
        let slope = if high - low > 1e-9 {
            (self.response.encoded(high) - self.response.encoded(low)) / (high - low)
        } else {
            0.0
        };
        (sigma * slope * 255.0 * SIGMA_UNIT).round() as u8
    }

    /// Brightens the next pictures by `stops`, after they were drawn in levels. Levels are scaled
    /// in light and clipped again, so their steps become coarser.
    pub(crate) fn adapt(&mut self, stops: f64) {
        let more = stops.exp2() as f32;
        let adapted = |level: usize| {
            let light = self.light(level as u8) * more;
            [self.level(light), self.sigma_of_light(light)]
        };
        self.adapted = (stops != 0.0).then(|| Box::new(std::array::from_fn(adapted)));
    }

    /// Writes a row of `levels` with noise of their `sigmas`. The noise depends on `frame` and
    /// `row` alone; `column` is the first column of the levels.
    pub(crate) fn expose(
        &self,
        frame: u64,
        row: usize,
        column: usize,
        levels: &[u8],
        sigmas: &[u8],
        out: &mut [u8],
    ) {
        let adapted: Option<(Vec<u8>, Vec<u8>)> = self.adapted.as_ref().map(|adapted| {
            let at = levels.iter().map(|level| adapted[usize::from(*level)]);
            at.map(|[level, sigma]| (level, sigma)).unzip()
        });
        let (levels, sigmas) =
            adapted.as_ref().map_or((levels, sigmas), |(levels, sigmas)| (levels, sigmas));
        if self.noise.is_empty() {
            out.copy_from_slice(levels);
            return;
        }
        let room = NOISE_SAMPLES - (column + levels.len());
        let offset = mix(self.seed ^ mix(frame) ^ mix(row as u64 + 1)) as usize % room;
        let noise = &self.noise[offset + column..][..levels.len()];
        add_noise(levels, sigmas, noise, out);
    }
}

fn add_noise(levels: &[u8], sigmas: &[u8], noise: &[i8], out: &mut [u8]) {
    for (((out, level), sigma), noise) in out.iter_mut().zip(levels).zip(sigmas).zip(noise) {
        // No overflow: at most 127 * 255 + 256.
        let change =
            (i16::from(*noise) * i16::from(*sigma) + (1 << (NOISE_SHIFT - 1))) >> NOISE_SHIFT;
        *out = (i16::from(*level) + change).clamp(0, 255) as u8;
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::expect_used)]
mod tests {
    use flockeye_imaging::light::TransferCurve;

    use super::*;

    fn sensor(iso: u32) -> ImageSensor {
        ImageSensor::new(&WorldParameters { iso, ..Default::default() })
    }

    #[test]
    fn levels_survive_decoding() {
        let sensor = sensor(0);
        for level in 0..=255 {
            assert_eq!(sensor.level(sensor.light(level)), level);
        }
        assert_eq!((sensor.level(-0.1), sensor.level(7.0)), (0, 255));
    }

    #[test]
    fn a_picture_that_is_exposed_longer_is_brighter_and_clips() {
        let exposed = |exposure_stops: f64| {
            ImageSensor::new(&WorldParameters { exposure_stops, ..Default::default() })
        };
        let (usual, longer) = (exposed(0.0), exposed(2.0));
        assert_eq!(longer.level(0.1), usual.level(0.4));
        assert_eq!((longer.level(0.25), longer.level(0.9)), (255, 255));
        assert_eq!(longer.sigma_of_light(0.1), usual.sigma_of_light(0.4));
        assert!((longer.light(255) - 0.25).abs() < 1e-6);
        assert_eq!(exposed(-3.0).level(0.8), usual.level(0.1));
    }

    #[test]
    fn an_auto_exposure_brightens_light_and_clips_it() {
        let mut sensor = sensor(0);
        let levels = [sensor.level(0.1), sensor.level(0.3), sensor.level(0.0)];
        let exposed = |sensor: &ImageSensor| {
            let mut out = vec![0; 3];
            sensor.expose(0, 0, 0, &levels, &[0; 3], &mut out);
            out
        };
        sensor.adapt(2.0);
        let brighter = exposed(&sensor);
        assert!(brighter[0].abs_diff(sensor.level(0.4)) <= 1, "{brighter:?}");
        assert_eq!(brighter[1..], [255, 0]);
        sensor.adapt(-1.0);
        assert!(exposed(&sensor)[1].abs_diff(sensor.level(0.15)) <= 1);
        sensor.adapt(0.0);
        assert_eq!(exposed(&sensor), levels);
    }

    #[test]
    fn levels_survive_with_every_response() {
        let table = std::array::from_fn(|code| (code as f32 / 255.0).powf(1.7));
        let curves = [TransferCurve::Gamma(2.2), TransferCurve::Linear].map(CameraCurve::Curve);
        for response in curves.into_iter().chain([CameraCurve::Table(table)]) {
            let sensor = ImageSensor::new(&WorldParameters { response, ..Default::default() });
            for level in 0..=255 {
                assert_eq!(sensor.level(sensor.light(level)), level, "{response:?}");
            }
        }
    }

    #[test]
    fn noise_has_the_strength_asked_for_and_no_bias() {
        let sensor = sensor(400);
        for level in [60u8, 120, 200] {
            let levels = vec![level; 3840];
            let sigmas = vec![sensor.sigma(level); 3840];
            let (mut sum, mut squares) = (0.0, 0.0);
            for row in 0..20 {
                let mut out = vec![0; 3840];
                sensor.expose(3, row, 0, &levels, &sigmas, &mut out);
                for value in out {
                    let light = f64::from(sensor.light(value));
                    sum += light;
                    squares += light * light;
                }
            }
            let count = 20.0 * 3840.0;
            let light = f64::from(sensor.light(level));
            let expected = (4.0 * 0.0078f64.powi(2) * light + (4.0f64 * 0.0004).powi(2)).sqrt();
            let mean = sum / count;
            let deviation = (squares / count - mean * mean).sqrt();
            assert!((deviation / expected - 1.0).abs() < 0.06, "{level}: {deviation} {expected}");
            assert!((mean - light).abs() < 0.05 * expected, "{level}: {mean} {light}");
        }
    }

    #[test]
    fn noise_repeats_for_a_frame_and_differs_between_frames_and_rows() {
        let sensor = sensor(400);
        let (levels, sigmas) = (vec![128; 64], vec![sensor.sigma(128); 64]);
        let row = |frame, row| {
            let mut out = vec![0; 64];
            sensor.expose(frame, row, 0, &levels, &sigmas, &mut out);
            out
        };
        assert_eq!(row(5, 9), row(5, 9));
        assert_ne!(row(5, 9), row(6, 9));
        assert_ne!(row(5, 9), row(5, 10));
    }

    #[test]
    fn without_sensitivity_there_is_no_noise() {
        let sensor = sensor(0);
        let mut out = vec![0; 3];
        sensor.expose(0, 0, 0, &[0, 128, 255], &[0; 3], &mut out);
        assert_eq!((out, sensor.sigma(128)), (vec![0, 128, 255], 0));
    }
}
