//! Direct passes: from predictions alone, before regions of interest are searched for markers.

use super::{FrameTime, Tracker, Update};
use crate::account::{AccountEntry, NotRun, Pass};
use crate::decide::Verdict;
use crate::decide::outcome::Outcome;
use crate::frame::parts::{Parts, Status};
use crate::measure::Row;
use crate::measure::prediction::{self, Candidate, Region, RejectedAlignment};

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
                Ok(candidate) => candidates.push(candidate),
                Err(reason) => {
                    let entry = AccountEntry::NotRun(Pass::Direct, reason);
                    self.note(time.order, region.target, entry);
                }
            }
        }
        let trials = prediction::measure(&self.means.aligner, &candidates, self.means.threads);
        self.attempts.direct += candidates.len() as u32;
        let mut updates = Vec::new();
        for (candidate, mut trial) in candidates.into_iter().zip(trials) {
            let Candidate { region: Region { target, view }, predicted } = candidate;
            // A view may come twice, cut again for another worker.
            let Some(part) = parts.get_mut(target).filter(|part| !part.is_published()) else {
                continue;
            };
            let measured = trial.measurement().map(|found| {
                let pose = found.pose.camera_from_markers;
                (self.corrected(found, view.rays_m, target, time.at_s), pose)
            });
            let accepted = measured.filter(|(measurement, _)| {
                self.targets[target].is_inside_gate(time.at_s, measurement, &self.camera.ego)
            });
            let found = trial.hypotheses.first().map(|hypothesis| hypothesis.found.clone());
            let stretch_px2 = found.as_ref().and_then(|found| found.as_ref().ok()?.stretch_px2);
            if let (Some(_), Some(stretch_px2)) = (&accepted, stretch_px2) {
                let rate = view.picture.motion.rate_in_camera.norm();
                self.camera.exposure.note(target, stretch_px2, rate);
            }
            let outcome = match accepted {
                Some((measurement, pose)) => {
                    let (update, outcome) =
                        self.take_in(time, target, Some(&mut *part), measurement);
                    if update.is_some() {
                        part.status = Status::Published { direct_pose: Some(pose) };
                    }
                    updates.extend(update);
                    outcome
                }
                None => measured.map_or(Outcome::Nothing, |(pose, _)| Outcome::OutsideGate(pose)),
            };
            if let (None, Some(found)) = (accepted, found) {
                let (view_index, found) = (view.view_index, found.map(Box::new));
                part.rejected = Some(RejectedAlignment { predicted, view_index, found });
            }
            if let Outcome::OutsideGate(_) = outcome {
                trial.decision = trial.decision.refused(Verdict::OutsideGate);
            }
            self.note_trial(time.order, target, trial, outcome);
        }
        updates
    }

    /// A region with its target's prediction, or why the direct pass may not measure it.
    fn direct_candidate<'v>(
        &self,
        time: FrameTime,
        parts: &Parts,
        region: Region<'v>,
    ) -> Result<Candidate<'v>, NotRun> {
        let target = self.targets.get(region.target).ok_or(NotRun::NotMeasuredBefore)?;
        if parts.is_published(region.target) {
            return Err(NotRun::Published);
        }
        if self.direct_policy.is_suspended(region.target) {
            return Err(NotRun::Suspended);
        }
        let prior = self.prior(region.target, time.at_s);
        let is_allowed = Row::of(Pass::Direct).prior.allows(target);
        let confirmed = prior.confirmed().filter(|_| is_allowed);
        let predicted = confirmed.ok_or(NotRun::NotMeasuredBefore)?.camera_from_markers;
        let view = region.view.moving(self.motion(region.target, time.at_s, &prior));
        Ok(Candidate { region: Region { view, ..region }, predicted })
    }
}
