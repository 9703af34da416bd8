//! `flockeye calibrate`: what is really where, from flights or recordings.
//!
//! | module | what it finds |
//! | --- | --- |
//! | [`body`] | where a body's markers really are |
//! | [`response`] | the curve between light and code values |
//! | [`latency`] | how late a camera's frames arrive |
//! | [`imu`] | how the inertial sensor lies to the camera, and how its clock goes |

pub mod body;
pub mod imu;
pub mod latency;
pub mod response;

pub use body::CalibrateBodyArguments;
pub use imu::CalibrateImuArguments;
pub use response::CalibrateResponseArguments;
