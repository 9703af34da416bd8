//! Mathematics of calibration: real poses of a drone's parts, from recorded rays and rotations. The
//! commands that use it are in `calibrate`.
//!
//! | module | what it estimates |
//! | --- | --- |
//! | `body` | the poses of a body's markers, as they were glued |
//! | `mount` | the pose of the camera on the drone |
//! | `lenses` | the pose of a camera's second lens relative to the first |
//! | `sensor` | mounting, time offset and bias of an inertial sensor |

mod adjust;
pub(crate) mod body;
mod descent;
mod error;
mod gauge;
pub(crate) mod lenses;
mod leverage;
pub(crate) mod mount;
pub(crate) mod sensor;
mod weighted_ray;

pub(crate) use error::CalibrationError;
pub use gauge::alignment;
