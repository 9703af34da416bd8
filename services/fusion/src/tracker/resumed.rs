//! Tracks that go on in another process.

use flockeye_contract::FrameOrder;
use flockeye_geometry::ego_rotation::EgoRotation;

use super::Tracker;
use crate::target::SavedTarget;

impl Tracker {
    /// The targets with their tracks, how the camera has turned, and what blur has shown of the
    /// exposure. `published` says in which frame each target's pose has left last.
    pub(crate) fn saved(
        &self,
        published: impl Fn(usize) -> Option<FrameOrder>,
    ) -> (Vec<SavedTarget>, EgoRotation, (f64, f64)) {
        let targets = self.targets.iter().enumerate();
        let saved = targets.map(|(number, target)| target.saved(published(number))).collect();
        (saved, self.camera.ego.clone(), self.camera.exposure.learned())
    }

    /// Goes on with the tracks of another process, and returns the names of their bodies. Bodies
    /// that this process does not know, and tracks with numbers that are not finite, are left out.
    pub(crate) fn resume(
        &mut self,
        saved: Vec<SavedTarget>,
        ego: EgoRotation,
        exposure: (f64, f64),
    ) -> Vec<String> {
        let has_tracks = self.filter.is_some() && self.camera.ego.resume(ego);
        if has_tracks {
            self.camera.exposure.resume(exposure);
        }
        let mut resumed = Vec::new();
        for mut saved in saved {
            saved.life = saved.life.filter(|_| has_tracks);
            let (name, is_tracked) = (saved.body.clone(), saved.life.is_some());
            let target = self.targets.iter_mut().find(|target| target.body.name == name);
            let is_resumed =
                target.is_some_and(|target| target.resume(saved, &self.camera.ego).is_ok());
            resumed.extend((is_resumed && is_tracked).then_some(name));
        }
        resumed
    }
}
