//! Tracks that another process continues.

use serde::{Deserialize, Serialize};

use super::belief::Belief;
use super::life::{FrameMeasurement, HistoryEntry, LifeCycle, RivalPose};
use super::{FilterError, check};
use crate::ego_rotation::EgoRotation;

/// A track with its history, from a process for its successor. The successor filters the history
/// anew with its own policy.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedLife {
    /// The state before the history.
    base: Option<Belief>,
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
        self.base.as_ref().map_or(Ok(()), Belief::check)?;
        for (stamp_s, measured) in &self.said {
            match measured {
                Some(FrameMeasurement { pose, rival, jump, .. }) => {
                    check(*stamp_s, pose)?;
                    if !jump.iter().flatten().all(|number| number.is_finite()) {
                        return Err(FilterError::Unusable { what: "jump" });
                    }
                    rival.map_or(Ok(()), |RivalPose { pose, lead }| match lead.is_finite() {
                        false => Err(FilterError::Unusable { what: "lead" }),
                        true => check(*stamp_s, &pose),
                    })?;
                }
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
    use nalgebra::{Isometry3, Matrix6, UnitQuaternion};

    use super::*;
    use crate::filter::TrackPolicy;
    use crate::pose::PoseEstimate;

    fn spoiled(saved: &mut SavedLife) -> &mut FrameMeasurement {
        saved.said[3].1.as_mut().unwrap()
    }

    #[test]
    fn a_track_with_numbers_that_are_not_finite_is_refused() {
        let ego = EgoRotation::new(2.0);
        let mut known = LifeCycle::new(TrackPolicy::default());
        let pose = PoseEstimate {
            camera_from_markers: Isometry3::translation(1.0, 0.0, 0.0),
            covariance: Matrix6::identity() * 1e-4,
        };
        let mut mirrored = pose;
        mirrored.camera_from_markers.rotation = UnitQuaternion::from_euler_angles(0.8, 0.0, 0.0);
        let rival = Some(RivalPose { pose: mirrored, lead: 1.0 });
        let measured = FrameMeasurement { pose, rival, is_proven: false, jump: None };
        for k in 0..30 {
            known.measured(f64::from(k) / 30.0, &measured, &ego).unwrap();
        }
        type Spoil = fn(&mut SavedLife, &mut Belief);
        let spoil: [(&str, Spoil); 12] = [
            ("time", |_, base| base.best.track.stamp_s = f64::NAN),
            ("velocity", |_, base| base.best.track.velocity.y = f64::INFINITY),
            ("covariance of the rate", |_, base| base.best.track.covariance[(9, 9)] = f64::NAN),
            ("covariance of the pose", |_, base| base.best.track.covariance[(0, 0)] = -1.0),
            ("start", |_, base| base.best.started_s = f64::NAN),
            ("order", |saved, _| saved.said[3].0 = 1e9),
            ("measurement", |saved, _| spoiled(saved).pose.covariance *= -1.0),
            ("rival", |saved, _| spoiled(saved).rival.as_mut().unwrap().pose.covariance *= -1.0),
            ("lead", |saved, _| spoiled(saved).rival.as_mut().unwrap().lead = f64::NAN),
            ("jump", |saved, _| spoiled(saved).jump = Some(Matrix6::repeat(f64::NAN))),
            ("rival's track", |_, base| base.rivals[0].branch.track.rate.x = f64::NAN),
            ("rival's odds", |_, base| base.rivals[0].odds.frame = f64::NAN),
        ];
        let mut fresh = LifeCycle::new(TrackPolicy::default());
        for (what, spoil) in spoil {
            let mut saved = known.saved();
            let mut base = saved.base.clone().expect("it is older than its history");
            assert_eq!(base.rivals.len(), 1);
            spoil(&mut saved, &mut base);
            let refused = fresh.resume(SavedLife { base: Some(base), ..saved }, &ego);
            assert!(refused.is_err(), "{what}");
            assert_eq!(fresh.state(), None, "{what}");
        }
        fresh.resume(known.saved(), &ego).unwrap();
        assert_eq!(fresh, known);
    }
}
