//! `imu`: measurements of an inertial sensor on the observer.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::ContractError;
use crate::error::check_count;

/// Maximum number of samples in one message.
pub const MAX_IMU_SAMPLES: usize = 256;

/// Header of `imu`. Payload: [`ImuSample`]s in the order of their time, at most
/// [`MAX_IMU_SAMPLES`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/ImuHeader")]
#[repr(C)]
pub struct ImuHeader {
    /// Sending time, CLOCK_MONOTONIC, nanoseconds. A latency field.
    pub sent_ns: i64,
    /// Rises each time the sensor's clock begins anew: a restart, or a recording that loops.
    pub epoch: u32,
    /// Rises each time the sender's process is replaced.
    pub generation: u32,
}

/// One sample of an inertial sensor, along the sensor's own axes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/ImuSample")]
#[repr(C)]
pub struct ImuSample {
    /// Sampling time on the clock of `stamp.exposure_ns`, nanoseconds. It does not include
    /// `inertial.time_offset_ms`.
    pub at_ns: i64,
    /// Angular velocity, rad/s.
    pub rate: [f64; 3],
    /// Specific force, m/s^2: a sensor at rest with its z axis up has +9.8 along z. NaN where the
    /// sender has none.
    pub specific_force: [f64; 3],
}

/// Maximum angular rate of a drone, rad/s (2000 degrees/s, at which usual sensors saturate, is 35).
pub const MAX_IMU_RATE: f64 = 100.0;

impl ImuHeader {
    /// Refuses too many samples, invalid rates, and times that do not rise.
    pub fn check(&self, samples: &[ImuSample]) -> Result<(), ContractError> {
        check_count("samples", samples.len(), MAX_IMU_SAMPLES)?;
        let is_rate = |rate: &f64| rate.abs() < MAX_IMU_RATE;
        if !samples.iter().all(|sample| sample.rate.iter().all(is_rate)) {
            return Err(ContractError::NotFinite { what: "angular velocity" });
        }
        if !samples.is_sorted_by(|earlier, later| earlier.at_ns < later.at_ns) {
            return Err(ContractError::NotFinite { what: "time from sample to sample" });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used)]
    use super::*;
    use crate::{Imus, Topic};

    #[test]
    fn samples_that_are_none_are_refused() {
        let sample = |at_ns| ImuSample { at_ns, rate: [0.1, -0.2, 3.0], ..ImuSample::default() };
        let header = ImuHeader::default();
        assert_eq!(Imus::check(&header, &[]), Ok(()));
        let no_force = ImuSample { specific_force: [f64::NAN; 3], ..sample(7) };
        assert_eq!(Imus::check(&header, &[sample(5), no_force]), Ok(()));
        let refused = |samples: &[ImuSample]| {
            Imus::check(&header, samples).expect_err("it is wrong").to_string()
        };
        assert!(refused(&[sample(5), sample(5)]).contains("time from sample to sample"));
        let nan = ImuSample { rate: [0.0, f64::NAN, 0.0], ..sample(1) };
        assert!(refused(&[nan]).contains("angular velocity"));
        let absurd = ImuSample { rate: [0.0, 0.0, 1e5], ..sample(1) };
        assert!(refused(&[absurd]).contains("angular velocity"));
        let many: Vec<_> = (0..300).map(sample).collect();
        assert!(refused(&many).contains("300 samples (at most 256"));
    }
}
