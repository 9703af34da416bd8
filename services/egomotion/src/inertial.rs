//! The inertial sensor beside the picture: whether it is right, and what it adds where it is.
//!
//! The picture is the judge. Bias, mounting and time offset of the sensor are filtered by comparing
//! its rotations with the picture's ([`SensorErrors`]). A sensor counts once it has agreed while
//! the drone turned, and until it disagrees in five of fifteen frames.

use flockeye_geometry::ego_rotation::Turned;
use flockeye_geometry::inertial::errors::Corrected;
use flockeye_geometry::inertial::{RateRecord, RateSample, SensorErrors};
use nalgebra::{Matrix3, Vector3};

/// Time for which samples are kept, seconds: a frame that comes late is still covered.
const KEEP_S: f64 = 2.0;

/// Sensor and picture agree within this squared Mahalanobis distance: 99.9 % of the comparisons of
/// a sensor that is right (chi-square, 3 degrees of freedom).
const GATE: f64 = 16.27;

/// Number of comparisons among which [`OUTSIDE`] are counted.
const WINDOW: u32 = 15;
/// Number of comparisons outside the gate that makes the sensor wrong. With one in fifty outside,
/// twenty times what a right sensor has, that happens every three hours at 30 frames/s: p (14 over
/// 4) p^4 (1 - p)^10 a frame.
const OUTSIDE: u32 = 5;

/// Comparisons in a row that must agree before a sensor counts. Once it was wrong, twice as many.
const AGREED: u32 = 15;
/// Least turn of the drone meanwhile, radians (3 degrees): at rest all mountings agree.
const TURNED: f64 = 0.052;

/// Time of pictures without samples after which the sensor counts as silent, seconds.
const SILENT_S: f64 = 0.5;

/// Longest time ahead for which the rotation is asked, seconds: no camera is older on arrival.
const AHEAD_S: f64 = 0.5;

/// What is worth a line in the log.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum SensorNotice {
    /// The sensor agrees with the picture; from now on it counts.
    Agrees {
        /// Its bias along the camera's axes, rad/s.
        bias: Vector3<f64>,
    },
    /// The sensor disagrees with the picture; from now on it is left out.
    Disagrees {
        /// The picture's rate less the sensor's in the last frame, rad/s.
        off: Vector3<f64>,
    },
    /// The sensor has sent no samples for a while.
    Silent,
    /// Samples come again.
    Heard,
}

/// The inertial sensor, and how far it agrees with the picture.
#[derive(Debug)]
pub(crate) struct SensorWatch {
    record: RateRecord,
    errors: SensorErrors,
    standing: Standing,
    /// The last comparisons, newest in the lowest bit: 1 where they were outside the gate.
    outside: u32,
    /// Comparisons that agreed in a row, and what the drone turned by in them, radians.
    agreed: u32,
    turned: f64,
    /// Since when pictures have no samples, seconds of the exposures.
    silent_since_s: Option<f64>,
    is_silent: bool,
    notices: Vec<SensorNotice>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Standing {
    Unproven,
    Counts,
    LeftOut,
}

impl SensorWatch {
    /// A sensor before its first sample.
    pub(crate) fn new() -> Self {
        Self {
            record: RateRecord::new(KEEP_S),
            errors: SensorErrors::new(),
            standing: Standing::Unproven,
            outside: 0,
            agreed: 0,
            turned: 0.0,
            silent_since_s: None,
            is_silent: false,
            notices: Vec::new(),
        }
    }

    /// Takes in the next sample, in the camera's axes and on the camera's clock.
    pub(crate) fn push(&mut self, sample: RateSample) {
        self.record.push(sample);
    }

    /// The sensor's clock begins anew.
    pub(crate) fn begin_epoch(&mut self) {
        self.record.clear();
        self.errors.begin_clock();
    }

    pub(crate) fn counts(&self) -> bool {
        self.standing == Standing::Counts
    }

    /// What has happened since this was asked last.
    pub(crate) fn take_notices(&mut self) -> Vec<SensorNotice> {
        std::mem::take(&mut self.notices)
    }

    /// The rotation between the exposures of two frames by the sensor, with its known errors taken
    /// out. `None` where samples are missing.
    pub(crate) fn between(&mut self, earlier_s: f64, later_s: f64) -> Option<Corrected> {
        let found = self.errors.turned(&self.record, earlier_s, later_s);
        match found {
            Some(_) => {
                self.silent_since_s = None;
                if std::mem::take(&mut self.is_silent) {
                    self.notices.push(SensorNotice::Heard);
                }
            }
            None => {
                let since_s = *self.silent_since_s.get_or_insert(earlier_s);
                // A recording that begins again has an earlier time.
                let silent_s = (later_s - since_s).abs();
                if silent_s > SILENT_S && !std::mem::replace(&mut self.is_silent, true) {
                    self.notices.push(SensorNotice::Silent);
                }
            }
        }
        found
    }

    /// Compares the sensor with the picture's rotation over `step_s` seconds. Where the sensor
    /// counts and both agree, gives the rotation by both.
    pub(crate) fn with_picture(
        &mut self,
        corrected: &Corrected,
        picture: &Turned,
        step_s: f64,
    ) -> Option<Turned> {
        let is_inside = corrected.distance(picture)? <= GATE;
        self.outside = (self.outside << 1 | u32::from(!is_inside)) & ((1 << WINDOW) - 1);
        let both = (is_inside && self.counts()).then(|| corrected.with(picture)).flatten();
        if is_inside {
            self.errors.compare(corrected, picture, step_s);
            self.agreed += 1;
            self.turned += picture.later_from_earlier.angle();
        } else {
            (self.agreed, self.turned) = (0, 0.0);
            if !self.counts() {
                self.errors = SensorErrors::new();
            }
        }
        self.judge(corrected.off(picture) / step_s);
        both
    }

    fn judge(&mut self, off: Vector3<f64>) {
        let needed = match self.standing {
            Standing::Counts | Standing::Unproven => AGREED,
            Standing::LeftOut => 2 * AGREED,
        };
        if self.standing != Standing::LeftOut && self.outside.count_ones() >= OUTSIDE {
            self.standing = Standing::LeftOut;
            self.errors = SensorErrors::new();
            (self.agreed, self.turned) = (0, 0.0);
            self.notices.push(SensorNotice::Disagrees { off });
        } else if !self.counts() && self.agreed >= needed && self.turned >= TURNED {
            self.standing = Standing::Counts;
            self.outside = 0;
            self.notices.push(SensorNotice::Agrees { bias: self.errors.bias });
        }
    }

    /// The rate by the sensor round a time, averaged over `width_s`, rad/s, with its covariance:
    /// where it counts.
    pub(crate) fn rate(&self, at_s: f64, width_s: f64) -> Option<(Vector3<f64>, Matrix3<f64>)> {
        self.counts().then(|| self.errors.rate(&self.record, at_s, width_s)).flatten()
    }

    /// Until when the samples reach beyond an exposure, and the rotation since, where the sensor
    /// counts.
    pub(crate) fn ahead(&self, exposure_s: f64) -> Option<(f64, Turned)> {
        let newest_s = self.errors.camera_time_s(self.record.newest_s()?);
        let until_s = newest_s.min(exposure_s + AHEAD_S);
        if !self.counts() || until_s <= exposure_s {
            return None;
        }
        Some((until_s, self.errors.turned(&self.record, exposure_s, until_s)?.turned))
    }
}

#[cfg(test)]
mod tests;
