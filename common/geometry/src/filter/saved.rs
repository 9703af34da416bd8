//! Tracks that another process continues.

use serde::{Deserialize, Serialize};

use super::life::{FrameMeasurement, HistoryEntry, Life, LifeCycle};
use super::{FilterError, check};
use crate::ego_rotation::EgoRotation;
use crate::pose::PoseEstimate;

/// A track with its history, from a process for its successor. The successor filters the history
/// anew with its own policy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedLife {
    /// The state before the history.
    base: Option<Life>,
    /// Result of each frame of the history, with its time, seconds.
    said: Vec<(f64, Option<FrameMeasurement>)>,
}

impl LifeCycle {
    /// The track with its history.
    pub fn saved(&self) -> SavedLife {
        SavedLife {
            base: self.base.clone(),
            said: self.events.iter().map(|event| (event.stamp_s, event.measured)).collect(),
        }
    }

    /// Continues a track of another process. `ego` is the rotation of the camera.
    ///
    /// # Errors
    /// [`FilterError::Unusable`]; nothing changes then.
    pub fn resume(&mut self, saved: SavedLife, ego: &EgoRotation) -> Result<(), FilterError> {
        saved.check()?;
        self.base = saved.base;
        self.events = saved
            .said
            .into_iter()
            .map(|(stamp_s, measured)| HistoryEntry { stamp_s, measured, after: None })
            .collect();
        self.refilter_from(0, ego);
        Ok(())
    }
}

impl SavedLife {
    fn check(&self) -> Result<(), FilterError> {
        if let Some(Life { track, started_s, .. }) = &self.base {
            let camera_from_markers = track.camera_from_markers;
            let covariance = track.pose_covariance();
            check(track.stamp_s, &PoseEstimate { camera_from_markers, covariance })?;
            let mut rest = track.velocity.iter().chain(&track.rate).chain(&track.covariance);
            if !started_s.is_finite() || !rest.all(|number| number.is_finite()) {
                return Err(FilterError::Unusable { what: "saved track" });
            }
        }
        for (stamp_s, measured) in &self.said {
            match measured {
                Some(measured) => check(*stamp_s, &measured.pose)?,
                None if stamp_s.is_finite() => {}
                None => return Err(FilterError::Unusable { what: "time" }),
            }
        }
        if !self.said.is_sorted_by(|(earlier_s, _), (later_s, _)| earlier_s <= later_s) {
            return Err(FilterError::Unusable { what: "order of the history" });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use nalgebra::{Isometry3, Matrix6};

    use super::*;
    use crate::filter::TrackPolicy;

    #[test]
    fn a_track_with_numbers_that_are_not_finite_is_refused() {
        let ego = EgoRotation::new(2.0);
        let mut known = LifeCycle::new(TrackPolicy::default());
        let pose = PoseEstimate {
            camera_from_markers: Isometry3::translation(1.0, 0.0, 0.0),
            covariance: Matrix6::identity() * 1e-4,
        };
        let measured = FrameMeasurement { pose, is_proven: false };
        for k in 0..30 {
            known.measured(f64::from(k) / 30.0, &measured, &ego).unwrap();
        }
        type Spoil = fn(&mut SavedLife, &mut Life);
        let spoil: [(&str, Spoil); 7] = [
            ("time", |_, life| life.track.stamp_s = f64::NAN),
            ("velocity", |_, life| life.track.velocity.y = f64::INFINITY),
            ("covariance of the rate", |_, life| life.track.covariance[(9, 9)] = f64::NAN),
            ("covariance of the pose", |_, life| life.track.covariance[(0, 0)] = -1.0),
            ("start", |_, life| life.started_s = f64::NAN),
            ("order", |saved, _| saved.said[3].0 = 1e9),
            ("measurement", |saved, _| saved.said[3].1.as_mut().unwrap().pose.covariance *= -1.0),
        ];
        let mut fresh = LifeCycle::new(TrackPolicy::default());
        for (what, spoil) in spoil {
            let mut saved = known.saved();
            let mut life = saved.base.clone().expect("it is older than its history");
            spoil(&mut saved, &mut life);
            let refused = fresh.resume(SavedLife { base: Some(life), ..saved }, &ego);
            assert!(refused.is_err(), "{what}");
            assert_eq!(fresh.state(), None, "{what}");
        }
        fresh.resume(known.saved(), &ego).unwrap();
        assert_eq!(fresh, known);
    }
}
