//! The drone's own motion from the autopilot. It reads no clock.

mod heard;
mod instant;

use flockeye_geometry::timeline::{Interpolate, Timeline};
use mavlink::dialects::development::MavMessage;
use nalgebra::{Isometry3, UnitQuaternion};

use crate::timesync::TimeOffset;
use heard::{AttitudeSample, PositionSample, from_attitude, from_odometry, from_position};
pub use instant::{OdometryAt, OdometryFrame, OdometryState};

/// Maximum time from a message's stamp to its arrival, nanoseconds. A longer time means that the
/// stamp is of another clock.
const LONGEST_WAY_NS: i64 = 1_000_000_000;
/// Maximum time by which a message may arrive before its stamp, nanoseconds, because the clock
/// offset has an error.
const EARLIEST_NS: i64 = 20_000_000;
/// Time without `ODOMETRY` after which position and attitude replace it, nanoseconds.
const MISSING_NS: i64 = 500_000_000;

/// The odometry of the last two seconds.
#[derive(Debug, Default)]
pub(crate) struct OdometryHistory {
    whole: Timeline<OdometryAt>,
    positions: Timeline<PositionSample>,
    attitudes: Timeline<AttitudeSample>,
    /// The reset counter of `ODOMETRY`, which changes when the autopilot's estimate jumps.
    resets: Option<u8>,
    /// Increases when the estimate jumps.
    epoch: u32,
    /// The state that was taken last: its time, and whether `ODOMETRY` gave it.
    taken: Option<(i64, bool)>,
}

impl OdometryHistory {
    /// Takes `ODOMETRY`, `LOCAL_POSITION_NED` and `ATTITUDE_QUATERNION` that arrived at
    /// `arrived_ns` (CLOCK_MONOTONIC). Its instant is its stamp where the autopilot's clock is
    /// known, and its arrival otherwise.
    pub(crate) fn on_message(
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
                    self.whole.newest().is_some_and(|(_, newest)| newest.frame != sample.frame);
                if is_reset.is_some_and(|last| last != odometry.reset_counter) || is_other_frame {
                    self.whole.clear();
                    self.epoch = self.epoch.wrapping_add(1);
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

    /// Drops everything: the line has another autopilot, or the same one was restarted.
    pub(crate) fn restart(&mut self) {
        let epoch = self.epoch.wrapping_add(1);
        *self = Self { epoch, taken: self.taken, ..Self::default() };
    }

    /// The newest state; each is returned once.
    pub(crate) fn take_newest(&mut self) -> Option<OdometryState> {
        let whole = self.whole.newest().map(|(at_ns, odometry)| (*at_ns, *odometry));
        let parts = self.newest_parts();
        let is_missing = |at_ns: i64| {
            parts.is_some_and(|(newest_ns, _)| newest_ns.saturating_sub(at_ns) > MISSING_NS)
        };
        let whole = whole.filter(|(at_ns, _)| !is_missing(*at_ns));
        let is_whole = whole.is_some();
        let (at_ns, odometry) = whole.or(parts)?;
        if let Some((taken_ns, was_whole)) = self.taken {
            if was_whole != is_whole {
                // `ODOMETRY` and the other two messages have different origins.
                self.epoch = self.epoch.wrapping_add(1);
            } else if at_ns <= taken_ns {
                return None;
            }
        }
        self.taken = Some((at_ns, is_whole));
        Some(OdometryState { at_ns, epoch: self.epoch, odometry })
    }

    /// The newest state of `LOCAL_POSITION_NED` and `ATTITUDE_QUATERNION`.
    fn newest_parts(&self) -> Option<(i64, OdometryAt)> {
        let (position_ns, _) = self.positions.newest()?;
        let (attitude_ns, _) = self.attitudes.newest()?;
        let at_ns = *position_ns.min(attitude_ns);
        let (position, attitude) = (self.positions.at(at_ns)?, self.attitudes.at(at_ns)?);
        let enu_from_base = attitude.enu_from_base;
        let odometry = OdometryAt {
            odom_from_base: Isometry3::from_parts(position.position_enu_m.into(), enu_from_base),
            frame: OdometryFrame::Enu,
            covariance: None,
            linear_velocity_m_s: enu_from_base.inverse() * position.velocity_enu_m_s,
            angular_velocity_rad_s: attitude.angular_velocity_rad_s,
        };
        Some((at_ns, odometry))
    }

    /// The attitude at this instant of CLOCK_MONOTONIC in ENU axes. None outside the last two
    /// seconds, and in gaps of more than half a second. None where north is unknown to the
    /// autopilot.
    pub(crate) fn enu_from_base_at(&self, monotonic_ns: i64) -> Option<UnitQuaternion<f64>> {
        let whole = self.whole.at(monotonic_ns).filter(|at| at.frame == OdometryFrame::Enu);
        whole
            .map(|at| at.odom_from_base.rotation)
            .or_else(|| self.attitudes.at(monotonic_ns).map(|attitude| attitude.enu_from_base))
    }
}

/// Time of a sample, CLOCK_MONOTONIC: its stamp, if that can be of the autopilot's clock, else its
/// arrival.
fn instant_ns(stamp_ns: Option<i64>, arrived_ns: i64, clock: Option<&TimeOffset>) -> i64 {
    let stamped_ns = stamp_ns.zip(clock).map(|(ns, clock)| clock.monotonic_from_autopilot(ns));
    stamped_ns
        .filter(|at_ns| (-EARLIEST_NS..LONGEST_WAY_NS).contains(&arrived_ns.saturating_sub(*at_ns)))
        .unwrap_or(arrived_ns)
}

impl Interpolate for OdometryAt {
    fn between(&self, later: &Self, share: f64) -> Option<Self> {
        if self.frame != later.frame {
            return None;
        }
        let linear = self.linear_velocity_m_s.lerp(&later.linear_velocity_m_s, share);
        let angular = self.angular_velocity_rad_s.lerp(&later.angular_velocity_rad_s, share);
        Some(Self {
            odom_from_base: self.odom_from_base.between(&later.odom_from_base, share)?,
            frame: self.frame,
            covariance: self.covariance.zip(later.covariance).map(|(a, b)| a + (b - a) * share),
            linear_velocity_m_s: linear,
            angular_velocity_rad_s: angular,
        })
    }
}

impl Interpolate for PositionSample {
    fn between(&self, later: &Self, share: f64) -> Option<Self> {
        Some(Self {
            position_enu_m: self.position_enu_m.lerp(&later.position_enu_m, share),
            velocity_enu_m_s: self.velocity_enu_m_s.lerp(&later.velocity_enu_m_s, share),
        })
    }
}

impl Interpolate for AttitudeSample {
    fn between(&self, later: &Self, share: f64) -> Option<Self> {
        let angular = self.angular_velocity_rad_s.lerp(&later.angular_velocity_rad_s, share);
        Some(Self {
            enu_from_base: self.enu_from_base.between(&later.enu_from_base, share)?,
            angular_velocity_rad_s: angular,
        })
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use mavlink::dialects::development::{
        ATTITUDE_QUATERNION_DATA, LOCAL_POSITION_NED_DATA, ODOMETRY_DATA,
    };

    use nalgebra::Vector3;

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
    fn each_state_is_given_once_at_the_instant_of_its_stamp() {
        let mut odometry = OdometryHistory::default();
        assert_eq!(odometry.take_newest(), None);
        for time_ms in (0..=1000).step_by(20) {
            // Up to 30 ms late, each differently; stamps make up for it.
            let arrived_ms = 10_000 + time_ms + time_ms % 31;
            let message = MavMessage::ODOMETRY(at(time_ms));
            odometry.on_message(&message, arrived_ms * MS, Some(&CLOCK));
            let OdometryState { at_ns, epoch, odometry: found } = odometry.take_newest().unwrap();
            assert_eq!((at_ns, epoch), ((10_000 + time_ms) * MS, 0));
            assert!((found.odom_from_base.translation.y - time_ms as f64).abs() < 1e-3);
            let (_, _, yaw) = found.odom_from_base.rotation.euler_angles();
            // NED's yaw is clockwise from north, ENU's the other way from east.
            let wanted = std::f64::consts::FRAC_PI_2 - time_ms as f64 * 1e-3;
            assert!((yaw - wanted).abs() < 1e-5, "{yaw}");
            assert!(found.covariance.is_some());
            assert_eq!(odometry.take_newest(), None, "each once");
        }
        // Between two of them.
        let attitude = odometry.enu_from_base_at(10_513 * MS).unwrap();
        let (_, _, yaw) = attitude.euler_angles();
        assert!((yaw - (std::f64::consts::FRAC_PI_2 - 0.513)).abs() < 1e-5, "{yaw}");
        assert_eq!(odometry.enu_from_base_at(9_999 * MS), None);
        assert_eq!(odometry.enu_from_base_at(11_001 * MS), None);
    }

    #[test]
    fn without_the_clock_it_is_the_instant_of_arrival() {
        let mut odometry = OdometryHistory::default();
        for (time_ms, arrived_ms) in [(0, 500), (20, 520), (40, 540)] {
            odometry.on_message(&MavMessage::ODOMETRY(at(time_ms)), arrived_ms * MS, None);
        }
        let found = odometry.take_newest().unwrap();
        assert_eq!(found.at_ns, 540 * MS);
        assert!((found.odometry.odom_from_base.translation.y - 40.0).abs() < 1e-3);
        // A stamp of another clock is none.
        odometry.on_message(&MavMessage::ODOMETRY(at(60)), 560 * MS, Some(&CLOCK));
        assert_eq!(odometry.take_newest().map(|state| state.at_ns), Some(560 * MS));
    }

    #[test]
    fn position_and_attitude_do_where_there_is_no_odometry() {
        let mut odometry = OdometryHistory::default();
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
        let OdometryState { at_ns, epoch, odometry: found } = odometry.take_newest().unwrap();
        assert_eq!((at_ns, epoch), (10_200 * MS, 0));
        assert!((found.odom_from_base.translation.y - 200.0).abs() < 1e-3);
        let turned = found.odom_from_base.rotation * found.linear_velocity_m_s;
        assert!((turned - Vector3::y()).norm() < 1e-6, "north at 1 m/s: {turned}");
        assert_eq!(found.covariance, None);
        assert_eq!(odometry.enu_from_base_at(10_003 * MS), None, "no attitude yet");
        assert!(odometry.enu_from_base_at(10_205 * MS).is_some(), "that needs no position");
        // Odometry is better, and has another origin.
        odometry.on_message(&MavMessage::ODOMETRY(at(210)), 10_210 * MS, Some(&CLOCK));
        let state = odometry.take_newest().unwrap();
        assert!(state.odometry.covariance.is_some() && state.epoch == 1);
    }

    #[test]
    fn a_leap_of_the_estimate_begins_another_epoch() {
        let mut odometry = OdometryHistory::default();
        for (time_ms, reset_counter, epoch) in [(0, 0, 0), (20, 0, 0), (40, 1, 1), (60, 1, 1)] {
            let message = MavMessage::ODOMETRY(ODOMETRY_DATA { reset_counter, ..at(time_ms) });
            odometry.on_message(&message, (10_000 + time_ms) * MS, Some(&CLOCK));
            assert_eq!(odometry.take_newest().map(|state| state.epoch), Some(epoch));
        }
        assert_eq!(odometry.enu_from_base_at(10_030 * MS), None);
        assert!(odometry.enu_from_base_at(10_050 * MS).is_some());
        odometry.restart();
        assert_eq!(odometry.take_newest(), None);
        odometry.on_message(&MavMessage::ODOMETRY(at(80)), 10_080 * MS, Some(&CLOCK));
        assert_eq!(odometry.take_newest().map(|state| state.epoch), Some(2));
    }
}
