//! Configured mounts as transforms.

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};

use crate::types::Mount;

/// A configured mount as a transform.
pub fn isometry(mount: &Mount) -> Isometry3<f64> {
    Isometry3::from_parts(
        Translation3::from(Vector3::from(mount.position)),
        UnitQuaternion::from_quaternion(Quaternion::from(mount.orientation)),
    )
}
