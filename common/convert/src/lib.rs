//! Conversions between contract types and the types of nalgebra, geometry and imaging.
//!
//! The contract uses arrays and codes, which any language can read; geometry and imaging use
//! nalgebra's types and enumerations. This crate has all conversions between the two, so that all
//! stages interpret a message alike.

mod codes;
mod imu;
mod pose;
mod radiance;
mod turn;
mod view;

pub use codes::{
    code_range, frame_header, projection_of, purpose_of, search_code, search_of, stop_rule,
    transfer_curve,
};
pub use imu::rate_sample;
pub use pose::{isometry, matrix6, pose, rotation, row_major, symmetric6, upper_triangle, xyzw};
pub use radiance::RadianceCache;
pub use turn::{camera_turn, rotation_message};
pub use view::{ViewError, at_exposure, image_of, view_of};
