//! State of one neighbour.

use flockeye_contract::wire::is_name;
use nalgebra::{Isometry3, Matrix6};

use crate::error::AutopilotError;

/// Maximum distance of a neighbour, metres: no camera detects a drone beyond it.
const FARTHEST_M: f64 = 10_000.0;

/// Pose of a neighbour at an exposure.
#[derive(Debug, Clone, PartialEq)]
pub struct NeighbourState {
    /// Its name: 1 to 31 letters, digits, '-', '_' or '.'.
    pub name: String,
    /// Its pose in this drone's `base_link` (x forward, y left, z up), metres.
    pub observer_from_target: Isometry3<f64>,
    /// Covariance of that pose: position (m), then rotation vector (rad), both along the axes of
    /// this drone's `base_link`.
    pub covariance: Matrix6<f64>,
    /// Middle of the exposure, CLOCK_MONOTONIC, nanoseconds.
    pub exposure_monotonic_ns: i64,
    /// Whether its track has ended. The pose is not used then.
    pub is_lost: bool,
}

impl NeighbourState {
    /// Its distance, metres.
    pub fn distance_m(&self) -> f64 {
        self.observer_from_target.translation.vector.norm()
    }

    /// Refuses an invalid state.
    ///
    /// # Errors
    /// [`AutopilotError::Neighbour`] names the invalid part.
    pub fn check(&self) -> Result<(), AutopilotError> {
        let wrong = |field, found: String, wanted| {
            Err(AutopilotError::Neighbour { name: self.name.clone(), field, found, wanted })
        };
        if !is_name(&self.name) {
            return wrong(
                "its name",
                self.name.clone(),
                "1 to 31 letters, digits, '-', '_' or '.'",
            );
        }
        if self.is_lost {
            return Ok(());
        }
        let position = self.observer_from_target.translation.vector;
        // NaN fails this comparison too.
        if !(position.norm() > 0.0 && position.norm() < FARTHEST_M) {
            let found = format!("{:?}", position.as_slice());
            return wrong("its position", found, "finite, not zero and within 10 km");
        }
        let rotation = self.observer_from_target.rotation;
        if (rotation.norm() - 1.0).abs().is_nan() || (rotation.norm() - 1.0).abs() > 1e-3 {
            let found = format!("{:?}", rotation.coords.as_slice());
            return wrong("its orientation", found, "a unit quaternion");
        }
        let variances = self.covariance.diagonal();
        if !variances.iter().all(|variance| variance.is_finite() && *variance >= 0.0) {
            let found = format!("{:?}", variances.as_slice());
            return wrong("its covariance's diagonal", found, "finite and not negative");
        }
        Ok(())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use nalgebra::{Quaternion, Translation3, UnitQuaternion};

    use super::*;

    /// A neighbour two metres ahead, one to the left, half a metre above, seen then.
    pub(crate) fn neighbour(name: &str, exposure_monotonic_ns: i64) -> NeighbourState {
        NeighbourState {
            name: name.into(),
            observer_from_target: Isometry3::from_parts(
                Translation3::new(2.0, 1.0, 0.5),
                UnitQuaternion::from_euler_angles(0.0, 0.0, 0.5),
            ),
            covariance: Matrix6::from_diagonal(&[0.04, 0.09, 0.16, 0.01, 0.01, 0.25].into()),
            exposure_monotonic_ns,
            is_lost: false,
        }
    }

    #[test]
    fn what_no_autopilot_could_use_is_refused() {
        neighbour("kite", 0).check().unwrap();
        let refused = |change: fn(&mut NeighbourState)| {
            let mut state = neighbour("kite", 0);
            change(&mut state);
            state.check().expect_err("refused").to_string()
        };
        assert!(refused(|state| state.name = "a/b".into()).contains("name"));
        let far = refused(|state| state.observer_from_target.translation.x = f64::NAN);
        assert!(far.contains("kite") && far.contains("position"), "{far}");
        assert!(refused(|state| state.covariance[(1, 1)] = -1.0).contains("covariance"));
        let zero = UnitQuaternion::new_unchecked(Quaternion::new(0.0, 0.0, 0.0, 0.0));
        let mut state = neighbour("kite", 0);
        state.observer_from_target.rotation = zero;
        assert!(state.check().unwrap_err().to_string().contains("unit quaternion"));
        // A lost one has no pose.
        state.is_lost = true;
        state.check().unwrap();
    }
}
