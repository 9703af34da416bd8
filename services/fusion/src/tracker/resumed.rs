//! Tracks that go on in another process.

use flockeye_geometry::ego_rotation::EgoRotation;

use super::{FilterChoice, Tracker};
use crate::exposure::LearnedExposure;
use crate::snapshot::SavedTarget;

impl Tracker {
    /// The targets with their tracks, how the camera has turned, and what blur has shown of the exposure.
    pub fn saved(&self) -> (Vec<SavedTarget>, EgoRotation, LearnedExposure) {
        let targets = self.targets.iter().map(super::Target::saved).collect();
        (targets, self.ego.clone(), self.exposure.learned())
    }

    /// Goes on with the tracks of another process, and returns the names of their bodies. Bodies that this
    /// process does not know, and tracks with numbers that are not finite, are left out. What was told is not
    /// told again in any case.
    pub fn resume(
        &mut self,
        saved: Vec<SavedTarget>,
        ego: EgoRotation,
        exposure: LearnedExposure,
    ) -> Vec<String> {
        let has_tracks = self.filter != FilterChoice::None && self.ego.resume(ego);
        if has_tracks {
            self.exposure.resume(exposure);
        }
        let mut resumed = Vec::new();
        for mut saved in saved {
            saved.life = saved.life.filter(|_| has_tracks);
            let (name, is_tracked) = (saved.body.clone(), saved.life.is_some());
            let target = self.targets.iter_mut().find(|target| target.body.name == name);
            let is_resumed = target.is_some_and(|target| target.resume(saved, &self.ego).is_ok());
            resumed.extend((is_resumed && is_tracked).then_some(name));
        }
        resumed
    }
}
