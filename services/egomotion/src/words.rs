//! Text on the camera's rotation in egomotion's health.

use flockeye_contract::{Rotation, RotationSource};
use nalgebra::{Matrix3, Vector3};

/// Number of frames with a known rotation since this process started, for its health.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct RotationCount {
    known: u64,
    frames: u64,
}

impl RotationCount {
    /// Counts a frame's rotation, and describes how the camera turns. The text has its rate and the
    /// standard deviation stated for it (root of the covariance's trace), both in degrees/s. It
    /// also states the source, and the number of frames with a known rotation. It has at most 96
    /// bytes, the room in `Health`.
    pub(crate) fn in_words(&mut self, rotation: &Rotation) -> String {
        self.frames += 1;
        // The contract's check refuses unknown codes before this.
        let source = RotationSource::try_from(rotation.source).unwrap_or(RotationSource::Nothing);
        if source == RotationSource::Nothing {
            return format!(
                "rotation not known; known in {} of {} frames",
                self.known, self.frames
            );
        }
        self.known += 1;
        let rate_deg_s = Vector3::from(rotation.rate_in_camera).norm().to_degrees();
        let variance = Matrix3::from_row_slice(&rotation.rate_covariance).trace();
        format!(
            "turning {rate_deg_s:.1} ± {:.1} degrees/s by {}; known in {} of {} frames",
            variance.max(0.0).sqrt().to_degrees(),
            words(source),
            self.known,
            self.frames
        )
    }
}

fn words(source: RotationSource) -> &'static str {
    match source {
        RotationSource::Nothing => "nothing",
        RotationSource::Picture => "picture",
        RotationSource::Inertial => "sensor",
        RotationSource::PictureAndInertial => "picture and sensor",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_words_say_rate_deviation_source_and_how_often() {
        let mut count = RotationCount::default();
        assert_eq!(
            count.in_words(&Rotation::default()),
            "rotation not known; known in 0 of 1 frames"
        );
        let variance = 0.01_f64.powi(2) / 3.0;
        let mut rotation = Rotation {
            source: RotationSource::Picture.code(),
            rate_in_camera: [0.3, 0.0, -0.4],
            rate_covariance: [variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance],
            ..Rotation::default()
        };
        let words = count.in_words(&rotation);
        assert_eq!(words, "turning 28.6 ± 0.6 degrees/s by picture; known in 1 of 2 frames");
        // A day of frames at a wild rate.
        rotation.rate_in_camera = [20.0, 0.0, 0.0];
        rotation.source = RotationSource::PictureAndInertial.code();
        let mut count = RotationCount { known: 2_591_999, frames: 2_591_999 };
        let words = count.in_words(&rotation);
        assert!(words.len() <= 96, "{} bytes: {words}", words.len());
    }
}
