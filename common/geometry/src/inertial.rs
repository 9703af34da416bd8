//! The camera's rotation from an inertial sensor, with the errors of that sensor.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`record`] | angular velocities over the last seconds, and the rotation between any two times |
//! | [`errors`] | bias, mounting and time offset of the sensor, filtered by comparison with the picture |

pub mod errors;
pub mod record;

pub use errors::SensorErrors;
pub use record::{RateRecord, RateSample};
