//! Direct passes: from predictions alone, before regions of interest are searched for markers.

use super::{FrameTime, Tracker, Update};
use crate::account::{AccountEntry, NotRun, Pass, Trial};
use crate::decide::Verdict;
use crate::decide::outcome::Outcome;
use crate::frame::parts::{Part, Parts, RejectedAlignment, Status};
use crate::measure::inputs::Inputs;
use crate::measure::{Region, Row};
use crate::parallel;

impl Tracker {
    /// The direct pass over regions of interest of one frame that have been cut. Targets whose pose
    /// is not accepted wait for their markers.
    pub fn direct_pass(
        &mut self,
        time: FrameTime,
        parts: &mut Parts,
        regions: &[Region<'_>],
    ) -> Vec<Update> {
        let mut inputs: Vec<Inputs<'_>> = Vec::new();
        let mut not_run = Vec::new();
        for region in regions {
            match self.region_inputs(time, parts, region) {
                Ok(offered) => inputs.push(offered),
                Err(reason) => not_run.push((region.target, reason)),
            }
        }
        let measure = |inputs: &Inputs<'_>| {
            let rate = inputs.best_view.map(|view| view.picture.motion.rate_in_camera.norm());
            (
                inputs.target,
                inputs.rays_m,
                rate.unwrap_or_default(),
                inputs.measure(&self.means.aligner),
            )
        };
        let measured = parallel::map(&inputs, self.means.threads, measure);
        self.attempts.direct += measured.len() as u32;
        for (target, reason) in not_run {
            self.note(time.order, target, AccountEntry::NotRun(Pass::Direct, reason));
        }
        let mut updates = Vec::new();
        for (target, rays_m, rate, trial) in measured {
            // A view may come twice, cut again for another worker.
            let Some(part) = parts.get_mut(target).filter(|part| !part.is_published()) else {
                continue;
            };
            updates.extend(self.take_in_direct(time, target, part, (rays_m, rate), trial));
        }
        updates
    }

    /// Takes in what the direct pass found in a view whose rays are right for `rays_m` and in which
    /// the target moves at `rate`, radians per second.
    fn take_in_direct(
        &mut self,
        time: FrameTime,
        target: usize,
        part: &mut Part,
        (rays_m, rate): (f64, f64),
        mut trial: Trial,
    ) -> Option<Update> {
        let measured = trial.measurement().map(|found| {
            let pose = found.pose.camera_from_markers;
            (self.corrected(found, rays_m, target, time.at_s), pose)
        });
        let accepted = measured.filter(|(measurement, _)| {
            self.targets[target].is_inside_gate(time.at_s, measurement, &self.camera.ego)
        });
        let found = trial.hypotheses.first().map(|hypothesis| hypothesis.found.clone());
        let stretch_px2 = found.as_ref().and_then(|found| found.as_ref().ok()?.stretch_px2);
        if let (Some(_), Some(stretch_px2)) = (&accepted, stretch_px2) {
            self.camera.exposure.note(target, stretch_px2, rate);
        }
        let (update, outcome) = match accepted {
            Some((measurement, pose)) => {
                let (update, outcome) = self.take_in(time, target, Some(&mut *part), measurement);
                if update.is_some() {
                    part.status = Status::Published { direct_pose: Some(pose) };
                }
                (update, outcome)
            }
            None => {
                part.rejected = found.zip(trial.predicted).zip(trial.view_index).map(
                    |((found, predicted), view_index)| RejectedAlignment {
                        predicted,
                        view_index,
                        found: found.map(Box::new),
                    },
                );
                (None, measured.map_or(Outcome::Nothing, |(pose, _)| Outcome::OutsideGate(pose)))
            }
        };
        if let Outcome::OutsideGate(_) = outcome {
            trial.decision = trial.decision.refused(Verdict::OutsideGate);
        }
        self.note_trial(time.order, target, trial, outcome);
        update
    }

    /// What a region offers, or why the direct pass may not measure its target.
    fn region_inputs<'f>(
        &'f self,
        time: FrameTime,
        parts: &Parts,
        region: &Region<'f>,
    ) -> Result<Inputs<'f>, NotRun> {
        let number = region.target;
        let target = self.targets.get(number).ok_or(NotRun::NotMeasuredBefore)?;
        if parts.is_published(number) {
            return Err(NotRun::Published);
        }
        if self.direct_policy.is_suspended(number) {
            return Err(NotRun::Suspended);
        }
        let prior = self.prior(number, time.at_s);
        if !Row::of(Pass::Direct).prior.allows(target) || prior.confirmed().is_none() {
            return Err(NotRun::NotMeasuredBefore);
        }
        let view = region.view.moving(self.motion(number, time.at_s, &prior));
        Ok(Inputs::of_view(Pass::Direct, number, &target.body, prior, view))
    }
}
