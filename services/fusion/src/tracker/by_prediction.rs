//! Direct passes: from predictions alone, before regions of interest are searched for markers.

use super::{Tracker, Update};
use crate::account::{AccountEntry, NotRun, Pass, Trial};
use crate::aligner::BestView;
use crate::decide::Verdict;
use crate::decide::outcome::Outcome;
use crate::frame::parts::{Part, Status, is_published};
use crate::hypothesis::Hypothesis;
use crate::measure::FrameTime;
use crate::measure::inputs::PassInputs;
use crate::parallel;
use crate::policy::TimeBudget;

impl Tracker {
    /// The direct pass over regions of interest of one frame that have been cut, each with its
    /// target's number. Targets whose pose is not accepted wait for their markers.
    pub(crate) fn direct_pass(
        &mut self,
        time: FrameTime,
        parts: &mut [Part],
        regions: &[(usize, BestView<'_>)],
    ) -> Vec<Update> {
        let mut inputs: Vec<PassInputs<'_>> = Vec::new();
        let mut not_run = Vec::new();
        for (target, view) in regions {
            match self.region_inputs(time, parts, *target, view) {
                Ok(offered) => inputs.push(offered),
                Err(reason) => not_run.push((*target, reason)),
            }
        }
        let measure = |inputs: &PassInputs<'_>| {
            let rate = inputs.best_view.map(|view| view.picture.motion.rate_in_camera.norm());
            let trial = inputs.measure(&self.aligner);
            (inputs.target, inputs.rays_m, rate.unwrap_or_default(), trial)
        };
        let measured = parallel::map(&inputs, self.threads, measure);
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

    /// Handles the result of the direct pass in a view whose rays are exact for `rays_m`. The
    /// target moves at `rate`, radians per second.
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
            self.targets[target].accepts(time.at_s, measurement, &self.camera.ego)
        });
        let found = trial.hypotheses.first().and_then(Hypothesis::alignment);
        if let (Some(_), Some(stretch_px2)) = (&accepted, found.and_then(|it| it.stretch_px2)) {
            self.camera.exposure.note(target, stretch_px2, rate);
        }
        let (update, outcome) = match accepted {
            Some((measurement, pose)) => {
                let (update, outcome) = self.take_in(time, target, Some(&mut *part), measurement);
                if update.is_some() {
                    self.note_camera(target, &trial);
                    part.status = Status::Published { direct_pose: Some(pose) };
                }
                (update, outcome)
            }
            None => {
                part.rejected = Some(Box::new(trial.clone()));
                (None, measured.map_or(Outcome::Nothing, |(pose, _)| Outcome::OutsideGate(pose)))
            }
        };
        if let Outcome::OutsideGate(_) = outcome {
            trial.decision = trial.decision.refused(Verdict::OutsideGate);
        }
        self.note_trial(time.order, target, trial, outcome);
        update
    }

    /// Inputs of a region, or the reason why the direct pass may not measure its target.
    fn region_inputs<'f>(
        &'f self,
        time: FrameTime,
        parts: &[Part],
        number: usize,
        view: &BestView<'f>,
    ) -> Result<PassInputs<'f>, NotRun> {
        let target = self.targets.get(number).ok_or(NotRun::NotConfirmed)?;
        if is_published(parts, number) {
            return Err(NotRun::Published);
        }
        if target.is_suspended() {
            return Err(NotRun::Suspended);
        }
        let prior = self.prior(number, time.at_s);
        if prior.confirmed().is_none() {
            return Err(NotRun::NotConfirmed);
        }
        let begun = Trial::of(Pass::Direct, &prior, TimeBudget::OneFrame);
        let view = view.moving(self.motion(number, time.at_s, &prior));
        Ok(PassInputs {
            target: number,
            body: &target.body,
            decoded: Vec::new(),
            rays_m: view.rays_m,
            prior,
            best_view: Some(view),
            trial: Trial { view_index: Some(view.view_index), ..begun },
            part: None,
        })
    }
}
