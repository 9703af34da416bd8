//! Mathematics of calibration: where the parts of a drone really are, from recorded rays and rotations.
//! The commands around it are in [`crate::calibrate`].
//!
//! | module | what it estimates |
//! | --- | --- |
//! | [`body`] | the poses of a body's markers, as they were glued |
//! | [`mount`] | the pose of the camera on the drone |
//! | [`lenses`] | the pose of a camera's second lens relative to the first |
//! | [`sensor`] | mounting, time offset and bias of an inertial sensor |

mod adjust;
pub mod body;
mod descent;
mod gauge;
pub mod lenses;
mod leverage;
pub mod mount;
pub mod sensor;
mod sight;

pub use gauge::alignment;
pub use leverage::worst_error_m;
