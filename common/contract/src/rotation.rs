//! `rotation`: rotation of the observer's camera.

use bytemuck::{Pod, Zeroable};
use flockeye_contract_derive::Described;
use iceoryx2::prelude::ZeroCopySend;

use crate::error::{check_finite, check_unit};
use crate::{ContractError, FrameStamp, RotationSource};

/// Header of `rotation`: rotation of the camera from an earlier frame to this one. No payload.
///
/// There is one for each frame that egomotion processes, even if the rotation is unknown.
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable, ZeroCopySend, Described)]
#[type_name("flockeye/Rotation")]
#[repr(C)]
pub struct Rotation {
    /// The frame.
    pub stamp: FrameStamp,
    /// Middle of the earlier frame's exposure, on the clock of `stamp.exposure_ns`.
    pub earlier_exposure_ns: i64,
    /// Rotates directions from the earlier camera frame into the present one: unit quaternion x y z
    /// w.
    pub later_from_earlier: [f64; 4],
    /// Its covariance, 3x3 row-major: rotation vector (rad) in the present camera frame.
    pub covariance: [f64; 9],
    /// The camera's own angular velocity in the middle of the exposure, in its own axes, rad/s.
    pub rate_in_camera: [f64; 3],
    /// Its covariance, 3x3 row-major, (rad/s)^2.
    pub rate_covariance: [f64; 9],
    /// End of the rotation beyond the exposure, as the inertial sensor measured it, on the same
    /// clock. Without it this is `stamp.exposure_ns`, and the next four fields have no meaning.
    pub ahead_ns: i64,
    /// Rotates directions from the camera frame of the exposure into that of `ahead_ns`: x y z w.
    pub ahead_from_later: [f64; 4],
    /// Its covariance, 3x3 row-major: rotation vector (rad) in the camera frame of `ahead_ns`.
    pub ahead_covariance: [f64; 9],
    /// The camera's own angular velocity at `ahead_ns`, in its own axes, rad/s.
    pub ahead_rate_in_camera: [f64; 3],
    /// Its covariance, 3x3 row-major, (rad/s)^2.
    pub ahead_rate_covariance: [f64; 9],
    /// A [`RotationSource`]: the source of the measurement. With `nothing`, only the stamp has a
    /// meaning.
    pub source: u32,
    /// Rises each time egomotion's process is replaced.
    pub generation: u32,
}

impl Default for Rotation {
    fn default() -> Self {
        let no_turn = [0.0, 0.0, 0.0, 1.0];
        Self { later_from_earlier: no_turn, ahead_from_later: no_turn, ..Self::zeroed() }
    }
}

/// Maximum time of the rotation beyond the exposure, nanoseconds.
const MAX_AHEAD_NS: i64 = 1_000_000_000;

impl Rotation {
    /// Refuses an unknown source, invalid rotations and invalid covariances.
    pub fn check(&self) -> Result<(), ContractError> {
        if RotationSource::try_from(self.source)? == RotationSource::Nothing {
            return Ok(());
        }
        check_unit(&self.later_from_earlier)?;
        check_finite("rate of the camera", &self.rate_in_camera)?;
        check_covariance("covariance of the rotation", &self.covariance)?;
        check_covariance("covariance of the rate", &self.rate_covariance)?;
        if self.earlier_exposure_ns >= self.stamp.exposure_ns {
            return Err(ContractError::NotFinite { what: "time between the two exposures" });
        }
        if self.is_known_ahead() {
            if self.ahead_ns.saturating_sub(self.stamp.exposure_ns) > MAX_AHEAD_NS {
                return Err(ContractError::NotFinite { what: "time known ahead" });
            }
            check_unit(&self.ahead_from_later)?;
            check_finite("rate of the camera ahead", &self.ahead_rate_in_camera)?;
            check_covariance("covariance of the rotation ahead", &self.ahead_covariance)?;
            check_covariance("covariance of the rate ahead", &self.ahead_rate_covariance)?;
        }
        Ok(())
    }

    /// Whether the rotation is known beyond the exposure.
    pub fn is_known_ahead(&self) -> bool {
        self.ahead_ns > self.stamp.exposure_ns
    }
}

/// Refuses a matrix that is not symmetric or has a variance below zero.
fn check_covariance(what: &'static str, numbers: &[f64; 9]) -> Result<(), ContractError> {
    check_finite(what, numbers)?;
    let at = |row: usize, column: usize| numbers[3 * row + column];
    let is_covariance = (0..3).all(|row| {
        at(row, row) >= 0.0
            && (0..row).all(|column| {
                let difference = (at(row, column) - at(column, row)).abs();
                difference <= 1e-6 * (at(row, row) + at(column, column))
            })
    });
    if is_covariance { Ok(()) } else { Err(ContractError::NotFinite { what }) }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use crate::{Rotations, Topic};

    fn rotation() -> Rotation {
        let stamp = FrameStamp { exposure_ns: 40_000_000, ..FrameStamp::default() };
        Rotation { stamp, source: RotationSource::Picture.code(), ..Rotation::default() }
    }

    #[test]
    fn rotations_that_are_none_are_refused() {
        assert_eq!(Rotations::check(&rotation(), &[]), Ok(()));
        let refused = |change: &dyn Fn(&mut Rotation)| {
            let mut rotation = rotation();
            change(&mut rotation);
            Rotations::check(&rotation, &[]).expect_err("it is wrong").to_string()
        };
        assert!(refused(&|rotation| rotation.later_from_earlier[3] = 2.0).contains("length 2"));
        assert!(refused(&|rotation| rotation.rate_in_camera[1] = f64::NAN).contains("rate"));
        assert!(refused(&|rotation| rotation.covariance[0] = -1.0).contains("covariance"));
        assert!(refused(&|rotation| rotation.covariance[1] = 1.0).contains("covariance"));
        assert!(refused(&|rotation| rotation.earlier_exposure_ns = 40_000_000).contains("time"));
        let ahead = |rotation: &mut Rotation| rotation.ahead_ns = 50_000_000;
        assert!(
            refused(&|rotation| {
                ahead(rotation);
                rotation.ahead_from_later[0] = 1.0;
            })
            .contains("length 1.41")
        );
        assert!(
            refused(&|rotation| {
                ahead(rotation);
                rotation.ahead_rate_covariance[4] = -1.0;
            })
            .contains("rate ahead")
        );
        assert!(refused(&|rotation| rotation.source = 9).contains("rotation source code 9"));
        // What is not known need not be right.
        let unknown = Rotation { later_from_earlier: [f64::NAN; 4], ..Rotation::default() };
        assert_eq!(Rotations::check(&unknown, &[]), Ok(()));
    }
}
