//! How the drone itself moves, from the autopilot, at any instant of the last two seconds. It reads no clock.

mod heard;
mod instant;
mod ring;

use mavlink::dialects::development::MavMessage;
use nalgebra::{Isometry3, UnitQuaternion, Vector3};

use crate::timesync::TimeOffset;
use heard::{AttitudeSample, PositionSample, from_attitude, from_odometry, from_position};
pub use instant::{OdometryAt, OdometryFrame};
use ring::{Interpolate, Ring};

/// A message does not take longer than this from its stamp to us, nanoseconds; one that seems to has a stamp of
/// another clock.
const LONGEST_WAY_NS: i64 = 1_000_000_000;
/// A message may seem to come so much before its stamp, nanoseconds, because clocks are known so well only.
const EARLIEST_NS: i64 = 20_000_000;

/// The odometry of the last two seconds.
#[derive(Debug, Default)]
pub struct Odometry {
    whole: Ring<OdometryAt>,
    positions: Ring<PositionSample>,
    attitudes: Ring<AttitudeSample>,
    /// Of `ODOMETRY`: changes where the autopilot's estimate has leapt.
    resets: Option<u8>,
}

impl Odometry {
    /// Takes in `ODOMETRY`, `LOCAL_POSITION_NED` and `ATTITUDE_QUATERNION` that arrived at `arrived_ns`
    /// (CLOCK_MONOTONIC). Its instant is that of its stamp where the autopilot's clock is known, and else that of
    /// its arrival.
    pub fn on_message(
        &mut self,
        message: &MavMessage,
        arrived_ns: i64,
        clock: Option<&TimeOffset>,
    ) {
        match message {
            MavMessage::ODOMETRY(odometry) => {
                let Some(sample) = from_odometry(odometry) else { return };
                let is_reset = self.resets.replace(odometry.reset_counter);
                let is_other_frame =
                    self.whole.newest().is_some_and(|newest| newest.frame != sample.frame);
                if is_reset.is_some_and(|last| last != odometry.reset_counter) || is_other_frame {
                    self.whole.clear();
                }
                let stamp_ns =
                    i64::try_from(odometry.time_usec).ok().and_then(|us| us.checked_mul(1000));
                self.whole.push(instant_ns(stamp_ns, arrived_ns, clock), sample);
            }
            MavMessage::LOCAL_POSITION_NED(position) => {
                let Some(sample) = from_position(position) else { return };
                let stamp_ns = i64::from(position.time_boot_ms) * 1_000_000;
                self.positions.push(instant_ns(Some(stamp_ns), arrived_ns, clock), sample);
            }
            MavMessage::ATTITUDE_QUATERNION(attitude) => {
                let Some(sample) = from_attitude(attitude) else { return };
                let stamp_ns = i64::from(attitude.time_boot_ms) * 1_000_000;
                self.attitudes.push(instant_ns(Some(stamp_ns), arrived_ns, clock), sample);
            }
            _ => {}
        }
    }

    /// The odometry at this instant of CLOCK_MONOTONIC; none outside the last two seconds, before the newest
    /// sample has come, and in gaps of more than half a second.
    pub fn at(&self, monotonic_ns: i64) -> Option<OdometryAt> {
        self.whole.at(monotonic_ns).or_else(|| {
            let position = self.positions.at(monotonic_ns)?;
            let attitude = self.attitudes.at(monotonic_ns)?;
            let enu_from_base = attitude.enu_from_base;
            Some(OdometryAt {
                odom_from_base: Isometry3::from_parts(
                    position.position_enu_m.into(),
                    enu_from_base,
                ),
                frame: OdometryFrame::Enu,
                covariance: None,
                linear_velocity_m_s: enu_from_base.inverse() * position.velocity_enu_m_s,
                angular_velocity_rad_s: attitude.angular_velocity_rad_s,
            })
        })
    }

    /// The attitude at this instant of CLOCK_MONOTONIC in ENU axes; none as in [`Self::at`], and where the
    /// autopilot does not know north.
    pub fn enu_from_base_at(&self, monotonic_ns: i64) -> Option<UnitQuaternion<f64>> {
        let whole = self.whole.at(monotonic_ns).filter(|at| at.frame == OdometryFrame::Enu);
        whole
            .map(|at| at.odom_from_base.rotation)
            .or_else(|| self.attitudes.at(monotonic_ns).map(|attitude| attitude.enu_from_base))
    }
}

/// When a sample was taken, CLOCK_MONOTONIC: by its stamp, if that can be of the autopilot's clock, else by its
/// arrival.
fn instant_ns(stamp_ns: Option<i64>, arrived_ns: i64, clock: Option<&TimeOffset>) -> i64 {
    let stamped_ns = stamp_ns.zip(clock).map(|(ns, clock)| clock.monotonic_from_autopilot(ns));
    stamped_ns
        .filter(|at_ns| (-EARLIEST_NS..LONGEST_WAY_NS).contains(&arrived_ns.saturating_sub(*at_ns)))
        .unwrap_or(arrived_ns)
}

fn between(earlier: &Vector3<f64>, later: &Vector3<f64>, share: f64) -> Vector3<f64> {
    earlier.lerp(later, share)
}

/// The shorter way round. None between opposite attitudes, where there is no shorter way.
fn slerp(
    earlier: &UnitQuaternion<f64>,
    later: &UnitQuaternion<f64>,
    share: f64,
) -> Option<UnitQuaternion<f64>> {
    earlier.try_slerp(later, share, 1e-9)
}

impl Interpolate for OdometryAt {
    fn between(&self, later: &Self, share: f64) -> Option<Self> {
        if self.frame != later.frame {
            return None;
        }
        let [a, b] = [self, later].map(|at| at.odom_from_base);
        let position = between(&a.translation.vector, &b.translation.vector, share);
        let rotation = slerp(&a.rotation, &b.rotation, share)?;
        Some(Self {
            odom_from_base: Isometry3::from_parts(position.into(), rotation),
            frame: self.frame,
            covariance: self.covariance.zip(later.covariance).map(|(a, b)| a + (b - a) * share),
            linear_velocity_m_s: between(
                &self.linear_velocity_m_s,
                &later.linear_velocity_m_s,
                share,
            ),
            angular_velocity_rad_s: between(
                &self.angular_velocity_rad_s,
                &later.angular_velocity_rad_s,
                share,
            ),
        })
    }
}

impl Interpolate for PositionSample {
    fn between(&self, later: &Self, share: f64) -> Option<Self> {
        Some(Self {
            position_enu_m: between(&self.position_enu_m, &later.position_enu_m, share),
            velocity_enu_m_s: between(&self.velocity_enu_m_s, &later.velocity_enu_m_s, share),
        })
    }
}

impl Interpolate for AttitudeSample {
    fn between(&self, later: &Self, share: f64) -> Option<Self> {
        Some(Self {
            enu_from_base: slerp(&self.enu_from_base, &later.enu_from_base, share)?,
            angular_velocity_rad_s: between(
                &self.angular_velocity_rad_s,
                &later.angular_velocity_rad_s,
                share,
            ),
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use mavlink::dialects::development::{
        ATTITUDE_QUATERNION_DATA, LOCAL_POSITION_NED_DATA, ODOMETRY_DATA,
    };

    use super::heard::tests::message;
    use super::*;
    use crate::axes::to_wxyz;

    const MS: i64 = 1_000_000;
    /// The autopilot started ten seconds after this machine.
    const CLOCK: TimeOffset =
        TimeOffset { autopilot_less_monotonic_ns: -10_000 * MS, bound_ns: MS };

    fn at(time_ms: i64) -> ODOMETRY_DATA {
        let time_usec = u64::try_from(time_ms * 1000).unwrap();
        let yaw = time_ms as f64 * 1e-3;
        ODOMETRY_DATA {
            x: time_ms as f32,
            q: to_wxyz(&UnitQuaternion::from_euler_angles(0.0, 0.0, yaw)),
            ..message(time_usec)
        }
    }

    #[test]
    fn it_is_interpolated_at_the_instant_of_its_stamp() {
        let mut odometry = Odometry::default();
        for time_ms in (0..=1000).step_by(20) {
            // Up to 30 ms late, each differently; stamps make up for it.
            let arrived_ms = 10_000 + time_ms + time_ms % 31;
            let message = MavMessage::ODOMETRY(at(time_ms));
            odometry.on_message(&message, arrived_ms * MS, Some(&CLOCK));
        }
        let found = odometry.at(10_513 * MS).unwrap();
        assert!((found.odom_from_base.translation.y - 513.0).abs() < 1e-3, "{found:?}");
        let (_, _, yaw) = found.odom_from_base.rotation.euler_angles();
        // NED's yaw is clockwise from north, ENU's the other way from east.
        assert!((yaw - (std::f64::consts::FRAC_PI_2 - 0.513)).abs() < 1e-5, "{yaw}");
        assert!(found.covariance.is_some());
        assert_eq!(odometry.at(9_999 * MS), None);
        assert_eq!(odometry.at(11_001 * MS), None);
    }

    #[test]
    fn without_the_clock_it_is_the_instant_of_arrival() {
        let mut odometry = Odometry::default();
        for (time_ms, arrived_ms) in [(0, 500), (20, 520), (40, 540)] {
            odometry.on_message(&MavMessage::ODOMETRY(at(time_ms)), arrived_ms * MS, None);
        }
        let found = odometry.at(530 * MS).unwrap();
        assert!((found.odom_from_base.translation.y - 30.0).abs() < 1e-3);
        // A stamp of another clock is none.
        odometry.on_message(&MavMessage::ODOMETRY(at(60)), 560 * MS, Some(&CLOCK));
        assert!(odometry.at(560 * MS).is_some());
    }

    #[test]
    fn position_and_attitude_do_where_there_is_no_odometry() {
        let mut odometry = Odometry::default();
        for time_ms in [0, 100, 200] {
            let q = at(i64::from(time_ms)).q;
            let attitude = ATTITUDE_QUATERNION_DATA {
                time_boot_ms: time_ms + 7,
                q1: q[0],
                q2: q[1],
                q3: q[2],
                q4: q[3],
                ..ATTITUDE_QUATERNION_DATA::DEFAULT
            };
            let position = LOCAL_POSITION_NED_DATA {
                time_boot_ms: time_ms,
                x: time_ms as f32,
                vx: 1.0,
                ..LOCAL_POSITION_NED_DATA::DEFAULT
            };
            let arrived_ns = (10_010 + i64::from(time_ms)) * MS;
            for message in [
                MavMessage::LOCAL_POSITION_NED(position),
                MavMessage::ATTITUDE_QUATERNION(attitude),
            ] {
                odometry.on_message(&message, arrived_ns, Some(&CLOCK));
            }
        }
        let found = odometry.at(10_150 * MS).unwrap();
        assert!((found.odom_from_base.translation.y - 150.0).abs() < 1e-3);
        let turned = found.odom_from_base.rotation * found.linear_velocity_m_s;
        assert!((turned - Vector3::y()).norm() < 1e-6, "north at 1 m/s: {turned}");
        assert_eq!(found.covariance, None);
        assert_eq!(odometry.at(10_003 * MS), None, "no attitude yet");
        assert!(odometry.enu_from_base_at(10_205 * MS).is_some(), "that needs no position");
        // Odometry is better.
        for time_ms in [140, 160] {
            let message = MavMessage::ODOMETRY(at(time_ms));
            odometry.on_message(&message, (10_000 + time_ms) * MS, Some(&CLOCK));
        }
        assert!(odometry.at(10_150 * MS).unwrap().covariance.is_some());
    }

    #[test]
    fn nothing_is_said_across_a_leap_of_the_estimate() {
        let mut odometry = Odometry::default();
        for (time_ms, reset_counter) in [(0, 0), (20, 0), (40, 1), (60, 1)] {
            let message = MavMessage::ODOMETRY(ODOMETRY_DATA { reset_counter, ..at(time_ms) });
            odometry.on_message(&message, (10_000 + time_ms) * MS, Some(&CLOCK));
        }
        assert_eq!(odometry.at(10_030 * MS), None);
        assert!(odometry.at(10_050 * MS).is_some());
    }
}
