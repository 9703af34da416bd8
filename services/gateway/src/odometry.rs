//! This drone's pose at an exposure, from its autopilot's estimate.

use flockeye_contract::OdometrySample;
use flockeye_contract::wire::Odometry;
use flockeye_convert::{isometry, matrix6, xyzw};
use flockeye_geometry::timeline::{Interpolate, Timeline};
use nalgebra::{Isometry3, Matrix6, Vector3};

/// The odometry of the last two seconds.
#[derive(Debug, Default)]
pub(crate) struct OwnOdometry {
    /// Generation and epoch of the samples.
    origin: Option<(u32, u32)>,
    motions: Timeline<OwnMotion>,
}

/// The drone's motion at one instant.
#[derive(Debug, Clone, PartialEq)]
struct OwnMotion {
    odom_from_observer: Isometry3<f64>,
    covariance: Matrix6<f64>,
    linear_m_s: Vector3<f64>,
    angular_rad_s: Vector3<f64>,
}

impl OwnOdometry {
    /// Adds a sample. One with another origin invalidates all samples before it.
    pub(crate) fn add(&mut self, sample: &OdometrySample) {
        let origin = Some((sample.generation, sample.epoch));
        if self.origin != origin {
            self.origin = origin;
            self.motions.clear();
        }
        let motion = OwnMotion {
            odom_from_observer: isometry(&sample.odom_from_observer),
            covariance: matrix6(&sample.covariance),
            linear_m_s: sample.linear_velocity.into(),
            angular_rad_s: sample.angular_velocity.into(),
        };
        self.motions.push(sample.at_ns, motion);
    }

    /// The odometry at an instant of CLOCK_MONOTONIC; none outside the samples and in long gaps.
    pub(crate) fn at(&self, monotonic_ns: i64) -> Option<Odometry> {
        let motion = self.motions.at(monotonic_ns)?;
        let variances = motion.covariance.diagonal();
        let is_known = variances.iter().all(|variance| variance.is_finite());
        Some(Odometry {
            position: motion.odom_from_observer.translation.vector.into(),
            orientation: xyzw(&motion.odom_from_observer.rotation),
            deviations: is_known.then(|| variances.map(|v| v.max(0.0).sqrt()).into()),
            linear_velocity: motion.linear_m_s.into(),
            angular_velocity: motion.angular_rad_s.into(),
        })
    }
}

impl Interpolate for OwnMotion {
    fn between(&self, later: &Self, share: f64) -> Option<Self> {
        Some(Self {
            odom_from_observer: self
                .odom_from_observer
                .between(&later.odom_from_observer, share)?,
            covariance: self.covariance + (later.covariance - self.covariance) * share,
            linear_m_s: self.linear_m_s.lerp(&later.linear_m_s, share),
            angular_rad_s: self.angular_rad_s.lerp(&later.angular_rad_s, share),
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use flockeye_contract::Pose;
    use nalgebra::UnitQuaternion;

    use super::*;

    const MS: i64 = 1_000_000;

    fn sample(at_ms: i64) -> OdometrySample {
        let yaw = UnitQuaternion::from_euler_angles(0.0, 0.0, at_ms as f64 * 1e-3);
        let mut covariance = [0.0; 36];
        (0..6).for_each(|k| covariance[7 * k] = 0.04);
        OdometrySample {
            odom_from_observer: Pose {
                position: [at_ms as f64, 0.0, 0.0],
                orientation: yaw.coords.into(),
            },
            covariance,
            linear_velocity: [1.0, 0.0, 0.0],
            angular_velocity: [0.0, 0.0, 1.0],
            at_ns: at_ms * MS,
            epoch: 0,
            generation: 0,
        }
    }

    #[test]
    fn it_is_interpolated_between_samples_and_unknown_outside() {
        let mut odometry = OwnOdometry::default();
        (0..=50).for_each(|k| odometry.add(&sample(20 * k)));
        let found = odometry.at(513 * MS).unwrap();
        assert!((found.position[0] - 513.0).abs() < 1e-9, "{found:?}");
        assert!((found.orientation[2] - (0.513f64 / 2.0).sin()).abs() < 1e-9);
        assert!(found.deviations.is_some_and(|found| found.iter().all(|s| (s - 0.2).abs() < 1e-9)));
        assert_eq!((found.linear_velocity[0], found.angular_velocity[2]), (1.0, 1.0));
        assert_eq!(odometry.at(-1), None);
        assert_eq!(odometry.at(1001 * MS), None);
    }

    #[test]
    fn poses_of_two_origins_are_not_mixed() {
        let mut odometry = OwnOdometry::default();
        odometry.add(&sample(0));
        odometry.add(&OdometrySample { epoch: 1, ..sample(20) });
        assert_eq!(odometry.at(10 * MS), None);
        odometry.add(&OdometrySample { epoch: 1, ..sample(40) });
        assert!(odometry.at(30 * MS).is_some());
        odometry.add(&OdometrySample { generation: 1, ..sample(60) });
        assert_eq!(odometry.at(30 * MS), None, "another process counts epochs anew");
    }

    #[test]
    fn deviations_are_left_out_where_no_covariance_is_known() {
        let mut odometry = OwnOdometry::default();
        let unknown = |at_ms| OdometrySample { covariance: [f64::NAN; 36], ..sample(at_ms) };
        odometry.add(&unknown(0));
        odometry.add(&unknown(20));
        let found = odometry.at(10 * MS).unwrap();
        assert_eq!((found.deviations, found.position[0]), (None, 10.0));
    }
}
