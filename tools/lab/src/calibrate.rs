//! `flockeye calibrate`: what is really where, from flights or recordings.
//!
//! | module | what it finds |
//! | --- | --- |
//! | [`body`] | where a body's markers really are |
//! | [`imu`] | how the inertial sensor lies to the camera, and how its clock goes |

pub mod body;
pub mod imu;

pub use body::CalibrateBodyArguments;
pub use imu::CalibrateImuArguments;
