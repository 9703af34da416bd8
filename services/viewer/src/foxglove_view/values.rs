//! Conversions to Foxglove's types.

use flockeye_convert::xyzw;
use foxglove::messages::{Color, Point3, Pose, Quaternion, Timestamp, Vector3};
use nalgebra::{self as na, Isometry3, UnitQuaternion};

/// Names of the frames of reference.
pub(super) const OBSERVER: &str = "observer";
pub(super) const CAMERA: &str = "camera";

/// Colours of bodies by their numbers, as on the page.
const COLOURS: [[u8; 3]; 8] = [
    [0x6c, 0xc6, 0xff],
    [0xff, 0xb8, 0x6b],
    [0x8c, 0xe9, 0x9a],
    [0xf7, 0x83, 0xac],
    [0xb1, 0x97, 0xfc],
    [0xff, 0xe0, 0x66],
    [0x63, 0xe6, 0xbe],
    [0xff, 0x87, 0x87],
];

pub(super) fn colour(target: u32, alpha: f64) -> Color {
    of_bytes(COLOURS[target as usize % COLOURS.len()], alpha)
}

pub(super) fn of_bytes(rgb: [u8; 3], alpha: f64) -> Color {
    let [r, g, b] = rgb.map(|part| f64::from(part) / 255.0);
    Color { r, g, b, a: alpha }
}

/// A point in time, nanoseconds since 1970.
pub(super) fn timestamp(unix_ns: i64) -> Timestamp {
    let seconds = u32::try_from(unix_ns.div_euclid(1_000_000_000)).unwrap_or(0);
    // The remainder is below 10^9.
    Timestamp::new(seconds, unix_ns.rem_euclid(1_000_000_000) as u32)
}

pub(super) fn vector(v: &na::Vector3<f64>) -> Vector3 {
    Vector3 { x: v.x, y: v.y, z: v.z }
}

pub(super) fn point(p: &na::Point3<f64>) -> Point3 {
    Point3 { x: p.x, y: p.y, z: p.z }
}

pub(super) fn quaternion(rotation: &UnitQuaternion<f64>) -> Quaternion {
    let [x, y, z, w] = xyzw(rotation);
    Quaternion { x, y, z, w }
}

pub(super) fn pose(isometry: &Isometry3<f64>) -> Pose {
    Pose {
        position: Some(vector(&isometry.translation.vector)),
        orientation: Some(quaternion(&isometry.rotation)),
    }
}
