//! What an inertial sensor says about the camera's rotation, and how far it is right.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`record`] | angular velocities over the last seconds, and the rotation between any two times |
//! | [`errors`] | bias, mounting and time offset of the sensor, filtered by comparison with the picture |
//! | [`calibration`] | the same for a whole recording, with nothing known before |

pub mod calibration;
pub mod errors;
#[cfg(test)]
mod fixtures;
pub mod record;

pub use calibration::{CalibrationError, SensorCalibration, TurnSeen, calibrate};
pub use errors::SensorErrors;
pub use record::{RateRecord, RateSample, SensorTurn};
