//! Direct passes: from predictions alone, before regions of interest are searched for markers.

use super::{FrameTime, Tracker, Update};
use crate::account::{Outcome, Pass};
use crate::frame::parts::{Parts, Status};
use crate::measure::Row;
use crate::measure::prediction::{self, Candidate, Region, RejectedAlignment};
use crate::measurement::Measurement;
use crate::target::outcome_of;

impl Tracker {
    /// The direct pass over regions of interest of one frame that have been cut. Targets whose pose
    /// is not accepted wait for their markers.
    pub fn direct_pass(
        &mut self,
        time: FrameTime,
        parts: &mut Parts,
        regions: &[Region<'_>],
    ) -> Vec<Update> {
        let mut candidates: Vec<Candidate<'_>> = Vec::new();
        for region in regions {
            match self.direct_candidate(time, parts, *region) {
                Some(candidate) => candidates.push(candidate),
                None => self.note_no_direct_pass(time.order, region.target, parts),
            }
        }
        let found = prediction::align(&self.means.aligner, &candidates, self.means.threads);
        self.attempts.direct += candidates.len() as u32;
        let mut updates = Vec::new();
        for (candidate, found) in candidates.into_iter().zip(found) {
            let Candidate { region: Region { target, view }, predicted } = candidate;
            // A view may come twice, cut again for another worker.
            let Some(part) = parts.get_mut(target).filter(|part| !part.is_published()) else {
                continue;
            };
            let measured = found.as_ref().ok().and_then(|found| {
                let measurement = prediction::accepted(found, &predicted)?;
                let measurement = self.corrected(measurement, view.rays_m, target, time.at_s);
                Some((measurement, found.camera_from_markers))
            });
            let is_inside = |(measurement, _): &(Measurement, _)| {
                self.targets[target].is_inside_gate(time.at_s, measurement, &self.camera.ego)
            };
            let accepted = measured.filter(is_inside);
            let stretch_px2 = found.as_ref().ok().and_then(|found| found.stretch_px2);
            if let (Some(_), Some(stretch_px2)) = (&accepted, stretch_px2) {
                let rate = view.picture.motion.rate_in_camera.norm();
                self.camera.exposure.note(target, stretch_px2, rate);
            }
            let (view_index, found) = (view.view_index, found.map(Box::new));
            let tried = RejectedAlignment { predicted, view_index, found };
            let outcome = match accepted {
                Some((measurement, pose)) => {
                    let update = self.take_in(time, target, Some(&mut *part), &measurement);
                    if update.is_some() {
                        part.status = Status::Published { direct_pose: Some(pose) };
                    }
                    let outcome = outcome_of(measurement, update.as_ref());
                    updates.extend(update);
                    outcome
                }
                None => measured.map_or(Outcome::Nothing, |(pose, _)| Outcome::OutsideGate(pose)),
            };
            self.note_direct_pass(time.order, &candidate, &tried, outcome);
            if accepted.is_none() {
                part.rejected = Some(tried);
            }
        }
        updates
    }

    /// A region with its target's prediction, if the direct pass may measure it.
    fn direct_candidate<'v>(
        &self,
        time: FrameTime,
        parts: &Parts,
        region: Region<'v>,
    ) -> Option<Candidate<'v>> {
        let target = self.targets.get(region.target)?;
        let may_run = Row::of(Pass::Direct).prior.allows(target)
            && !self.direct_policy.is_suspended(region.target)
            && !parts.is_published(region.target);
        let prior = self.prior(region.target, time.at_s);
        let predicted = prior.confirmed().filter(|_| may_run)?.camera_from_markers;
        let view = region.view.moving(self.motion(region.target, time.at_s, &prior));
        Some(Candidate { region: Region { view, ..region }, predicted })
    }
}
