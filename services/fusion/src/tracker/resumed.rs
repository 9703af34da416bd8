//! Tracks that continue in another process.

use flockeye_contract::FrameOrder;
use flockeye_geometry::ego_rotation::EgoRotation;

use super::Tracker;
use crate::target::SavedTarget;

impl Tracker {
    /// State for a successor: targets with their tracks, rotation of the camera, and exposure from
    /// blur. `published` is the frame of each target's last published pose.
    pub(crate) fn saved(
        &self,
        published: impl Fn(usize) -> Option<FrameOrder>,
    ) -> (Vec<SavedTarget>, EgoRotation, (f64, f64)) {
        let targets = self.targets.iter().enumerate();
        let saved = targets.map(|(number, target)| target.saved(published(number))).collect();
        (saved, self.camera.ego.clone(), self.camera.exposure.learned())
    }

    /// Continues the tracks of another process, and returns the names of their bodies. Unknown
    /// bodies, and tracks with numbers that are not finite, are left out.
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
