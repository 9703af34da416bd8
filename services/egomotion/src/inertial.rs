//! The inertial sensor, with its comparison to the picture.
//!
//! The picture is the reference. A filter estimates bias, mounting and time offset of the sensor
//! from both rotations ([`SensorErrors`]). A sensor is enabled after comparisons inside the gate
//! while the drone turned. It is disabled after five of fifteen frames outside the gate.

use flockeye_geometry::ego_rotation::Turned;
use flockeye_geometry::inertial::errors::Corrected;
use flockeye_geometry::inertial::{RateRecord, RateSample, SensorErrors};
use nalgebra::{Matrix3, Vector3};

/// Time for which samples are kept, seconds, so that a late frame is still covered.
const KEEP_S: f64 = 2.0;

/// Gate of the squared Mahalanobis distance between sensor and picture: 99.9 % of the comparisons
/// of a right sensor pass (chi-square, 3 degrees of freedom).
const GATE: f64 = 16.27;

/// Number of comparisons among which [`OUTSIDE`] are counted.
const WINDOW: u32 = 15;
/// Number of comparisons outside the gate that disables the sensor. One in fifty outside is twenty
/// times the share of a right sensor. With that, it happens every three hours at 30 frames/s:
/// p (14 over 4) p^4 (1 - p)^10 a frame.
const OUTSIDE: u32 = 5;

/// Number of consecutive comparisons inside the gate that enables a sensor. After it was disabled,
/// twice as many are needed.
const AGREED: u32 = 15;
/// Least rotation of the drone in these comparisons, radians (3 degrees): at rest all mountings
/// pass.
const TURNED: f64 = 0.052;

/// Time of pictures without samples after which the sensor counts as silent, seconds.
const SILENT_S: f64 = 0.5;

/// Longest time ahead for a requested rotation, seconds: no camera is older on arrival.
const AHEAD_S: f64 = 0.5;

/// Notice for the log.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum SensorNotice {
    /// The sensor passed its comparisons with the picture and is enabled.
    Agrees {
        /// Its bias along the camera's axes, rad/s.
        bias: Vector3<f64>,
    },
    /// The sensor failed its comparisons with the picture and is disabled.
    Disagrees {
        /// The picture's rate less the sensor's in the last frame, rad/s.
        off: Vector3<f64>,
    },
    /// The sensor has sent no samples for a while.
    Silent,
    /// Samples arrive again.
    Heard,
}

/// The inertial sensor and its comparison with the picture.
#[derive(Debug)]
pub(crate) struct SensorWatch {
    record: RateRecord,
    errors: SensorErrors,
    standing: Standing,
    /// The last comparisons, newest in the lowest bit: 1 where they were outside the gate.
    outside: u32,
    /// Consecutive comparisons inside the gate, and the rotation of the drone in them, radians.
    agreed: u32,
    turned: f64,
    /// Start of the time without samples, seconds of the exposures.
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

    /// Handles the next sample, in the camera's axes and on the camera's clock.
    pub(crate) fn push(&mut self, sample: RateSample) {
        self.record.push(sample);
    }

    /// Handles a new start of the sensor's clock.
    pub(crate) fn begin_epoch(&mut self) {
        self.record.clear();
        self.errors.begin_clock();
    }

    pub(crate) fn counts(&self) -> bool {
        self.standing == Standing::Counts
    }

    /// Returns the notices since the last call.
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

    /// Compares the sensor with the picture's rotation over `step_s` seconds. If the sensor is
    /// enabled and the comparison passes, returns the rotation from both.
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

    /// Rate from the enabled sensor around a time, averaged over `width_s`, rad/s, with its
    /// covariance.
    pub(crate) fn rate(&self, at_s: f64, width_s: f64) -> Option<(Vector3<f64>, Matrix3<f64>)> {
        self.counts().then(|| self.errors.rate(&self.record, at_s, width_s)).flatten()
    }

    /// End of the samples beyond an exposure, and the rotation since, from the enabled sensor.
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
