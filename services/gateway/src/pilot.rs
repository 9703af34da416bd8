//! What the drone's autopilot is told, and what it says of the drone.

use flockeye_autopilot::{
    Autopilot as Line, AutopilotError, AutopilotParameters, NeighbourState, OdometryAt, Rates,
};
use flockeye_config::Autopilot as Settings;
use flockeye_contract::wire::Odometry;
use flockeye_contract::{Track, TrackState};
use flockeye_convert::{isometry, matrix6, xyzw};
use flockeye_runtime::logs::Throttle;
use nalgebra::Matrix6;

/// A line to the autopilot, and how often it refused something.
#[derive(Debug)]
pub struct Pilot {
    line: Line,
    failures: Throttle,
}

impl Pilot {
    /// Begins to talk. A line that is not there is tried again in the background.
    ///
    /// # Errors
    /// A setting that cannot work.
    pub fn open(settings: &Settings) -> Result<Self, AutopilotError> {
        let parameters = AutopilotParameters {
            link: settings.link.clone(),
            system_id: settings.system_id,
            component_id: settings.component_id,
            target: settings.target.clone(),
            rates: Rates {
                target_hz: settings.target_hz,
                obstacles_hz: settings.obstacles_hz,
                odometry_hz: settings.odometry_hz,
            },
            max_age_ms: settings.max_age_ms,
            obstacle_range_m: settings.obstacle_range_m,
        };
        Ok(Self { line: Line::open(&parameters)?, failures: Throttle::default() })
    }

    /// This drone sees a neighbour, at an exposure on CLOCK_MONOTONIC.
    pub fn sees(&mut self, exposure_monotonic_ns: i64, track: &Track) {
        let Some(is_lost) = told_as_lost(track.state) else { return };
        let told = self.line.neighbour(&NeighbourState {
            name: track.name.to_string(),
            observer_from_target: isometry(&track.observer_from_target),
            covariance: matrix6(&track.covariance),
            exposure_monotonic_ns,
            is_lost,
        });
        if let Err(error) = told
            && let Some(more_since) = self.failures.admit()
        {
            tracing::warn!(more_since, "the autopilot is not told: {error}");
        }
    }

    /// Where the autopilot has the drone at an exposure on CLOCK_MONOTONIC.
    pub fn odometry(&self, exposure_monotonic_ns: i64) -> Option<Odometry> {
        self.line.odometry_at(exposure_monotonic_ns).map(|odometry| to_wire(&odometry))
    }
}

/// Whether a track of this state has ended; none for one that the autopilot is not told of.
fn told_as_lost(state: u32) -> Option<bool> {
    match TrackState::try_from(state) {
        Ok(TrackState::Lost) => Some(true),
        Ok(TrackState::Confirmed | TrackState::Coasting | TrackState::Measured) => Some(false),
        Ok(TrackState::Tentative) | Err(_) => None,
    }
}

fn to_wire(odometry: &OdometryAt) -> Odometry {
    let pose = &odometry.odom_from_base;
    let deviations = |covariance: &Matrix6<f64>| covariance.diagonal().map(|v| v.max(0.0).sqrt());
    Odometry {
        position: pose.translation.vector.into(),
        orientation: xyzw(&pose.rotation),
        deviations: odometry.covariance.as_ref().map(|covariance| deviations(covariance).into()),
        linear_velocity: odometry.linear_velocity_m_s.into(),
        angular_velocity: odometry.angular_velocity_rad_s.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_may_be_nobody_is_not_told_of() {
        let told: Vec<_> = TrackState::ALL.iter().map(|state| told_as_lost(state.code())).collect();
        // Tentative, confirmed, coasting, lost, measured.
        assert_eq!(told, [None, Some(false), Some(false), Some(true), Some(false)]);
        assert_eq!(told_as_lost(99), None);
    }

    #[test]
    fn a_setting_that_cannot_work_is_refused_with_its_cure() {
        let settings = Settings { link: "udpin:14540".into(), ..Settings::default() };
        let error = Pilot::open(&settings).map(drop).map_err(|error| error.to_string());
        assert!(error.is_err_and(|error| error.starts_with("link: 'udpin:14540'")));
    }
}
