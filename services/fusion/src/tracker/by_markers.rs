//! The corner pass: measures targets by their markers, and by the picture from there.

use flockeye_contract::MeasuredBy;
use flockeye_geometry::body::Body;
use flockeye_geometry::camera::Stitch;
use flockeye_geometry::pose::{CornerRay, solve};

use super::{Tracker, Update};
use crate::account::{AccountEntry, NotRun, Pass, Trial};
use crate::decide::outcome::Outcome;
use crate::frame::parts::{Part, Status};
use crate::measure::inputs::PassInputs;
use crate::measure::{AnsweredView, BestViews, FrameTime};
use crate::measurement::{PoseMeasurement, decoded_rays, marker_ids};
use crate::parallel;
use crate::policy::TimeBudget;
use crate::stitching::{StitchEstimate, correct_rays};
use crate::track_prior::TrackPrior;

impl Tracker {
    /// Measures targets, each from some of a frame's records and its best view, and updates their
    /// tracks.
    pub(super) fn corner_pass(
        &mut self,
        time: FrameTime,
        parts: &mut [Part],
        tried: &[(usize, &[AnsweredView<'_>])],
        best_views: &BestViews<'_>,
        pass: Pass,
        budget: TimeBudget,
    ) -> Vec<Update> {
        // Removed meanwhile, because the inputs borrow from everything else.
        let mut background = self.background.take();
        let has_background = background.is_some();
        let mut inputs: Vec<PassInputs<'_>> = Vec::new();
        let mut unmeasurable = Vec::new();
        for (target, answered) in tried {
            let Some(part) = parts.get(*target) else { continue };
            let begun = self.begin_trial(time, *target, part, pass, budget, has_background);
            match self.inputs(time, *target, part, answered, best_views, begun) {
                Ok(offered) => inputs.push(offered),
                Err(reason) => unmeasurable.push((*target, reason)),
            }
        }
        let mut attempts = self.attempts;
        for inputs in &inputs {
            match inputs.prior.predicted() {
                Some(_) => attempts.tracked += 1,
                None => attempts.untracked += 1,
            }
        }
        let trials = parallel::map(&inputs, self.threads, |inputs| inputs.measure(&self.aligner));
        let mut failed = Vec::new();
        let mut found = Vec::new();
        for (inputs, trial) in inputs.iter().zip(trials) {
            let target = inputs.target;
            let corrected = trial.measurement().map(|measurement| {
                let view =
                    inputs.best_view.filter(|_| measurement.measured_by == MeasuredBy::Aligned);
                let rays_m = view.map_or(inputs.rays_m, |view| view.rays_m);
                self.corrected(measurement, rays_m, target, time.at_s)
            });
            if let Some(measurement) = corrected.filter(PoseMeasurement::is_usable_alone) {
                found.push((target, trial, measurement));
                continue;
            }
            let is_in_background = inputs.wants_background()
                && background.as_mut().is_some_and(|slot| slot.request(time, inputs));
            failed.push((target, trial, inputs.attempt(), is_in_background, corrected));
        }
        (self.background, self.attempts) = (background, attempts);
        for (target, reason) in unmeasurable {
            self.note(time.order, target, AccountEntry::NotRun(pass, reason));
        }
        for (target, trial, attempt, is_in_background, imprecise) in failed {
            if let Some(part) = parts.get_mut(target) {
                part.status = Status::Failed(attempt);
                part.imprecise = imprecise.or(part.imprecise);
                if is_in_background {
                    part.background = Some(attempt);
                }
            }
            let outcome = Outcome::unpublished(imprecise, is_in_background);
            self.note_trial(time.order, target, trial, outcome);
        }
        let mut updates = Vec::new();
        for (target, trial, measurement) in found {
            let part = parts.get_mut(target);
            updates.extend(self.take_in_trial(time, target, part, measurement, trial));
        }
        updates
    }

    /// Begins a corner pass over a target. Rough starts are left to the background pass if others
    /// wait: a tracked target's frame is still open, or another target is tracked.
    pub(super) fn begin_trial(
        &self,
        time: FrameTime,
        target: usize,
        part: &Part,
        pass: Pass,
        budget: TimeBudget,
        has_background: bool,
    ) -> Trial {
        let prior = self.prior(target, time.at_s);
        let is_open = prior.confirmed().is_some() && part.is_region_tried;
        // Rough starts need a prediction.
        let is_deferred = budget != TimeBudget::Unlimited
            && has_background
            && prior.predicted().is_some()
            && (is_open || self.tracks_others(target));
        Trial { is_deferred, ..Trial::of(pass, &prior, budget) }
    }

    /// Collects the inputs for a target, or returns the reason why there are none.
    pub(super) fn inputs<'f>(
        &'f self,
        time: FrameTime,
        target: usize,
        part: &'f Part,
        answered: &[AnsweredView<'_>],
        best_views: &BestViews<'f>,
        begun: Trial,
    ) -> Result<PassInputs<'f>, NotRun> {
        let body = &self.targets.get(target).ok_or(NotRun::NothingKnown)?.body;
        let prior = self.prior(target, time.at_s);
        // All rays are corrected to the best known distance before the pose is solved.
        let of_parallax = self.camera.parallax.as_ref().map(|it| it.assumed_m);
        let stitching = self.camera.stitching.as_ref();
        let assumed_m = of_parallax.or(stitching.map(StitchEstimate::assumed_m));
        let rays_m = assumed_m.map_or(f64::INFINITY, |assumed_m| {
            let predicted = prior.confirmed().map(|prior| prior.camera_from_markers.translation);
            predicted.map_or(assumed_m, |position| position.vector.norm())
        });
        let motion = self.motion(target, time.at_s, &prior);
        let best_view = best_views.get(&target).map(|view| view.moving(motion));
        let (mut decoded, mut cameras) = (Vec::new(), Vec::new());
        for AnsweredView { record, view, .. } in answered {
            let mut of_view = decoded_rays(body, &record.markers);
            // A foreign detector may not know of the lens's error.
            for ray in &mut of_view {
                ray.deviation_rad = ray.deviation_rad.max(self.camera.lens.deviation_rad);
            }
            if let Some(parallax) = &self.camera.parallax {
                let from_m = parallax.distance_m(*view);
                for ray in &mut of_view {
                    ray.ray_in_camera = parallax.brought(&ray.ray_in_camera, from_m, rays_m);
                }
            }
            let camera = stitching.map(|stitching| stitching.of_view(*view));
            cameras.extend(camera.iter().flat_map(|camera| of_view.iter().map(|_| *camera)));
            decoded.extend(of_view);
        }
        let rays_m = self.correct_to_body(body, &mut decoded, &cameras, rays_m, &prior);
        let is_tracked = prior.predicted().is_some();
        if decoded.is_empty() && !(is_tracked && best_view.is_some()) {
            return Err(if is_tracked { NotRun::NoView } else { NotRun::NothingKnown });
        }
        let trial = Trial {
            view_index: best_view.map(|best| best.view_index),
            decoded: marker_ids(&decoded),
            ..begun
        };
        Ok(PassInputs { target, body, decoded, rays_m, prior, best_view, trial, part: Some(part) })
    }

    /// Corrects the corner rays of a body in a stitched picture to `rays_m`, or to the distance that the
    /// corners show if no track knows it. Returns the distance.
    fn correct_to_body(
        &self,
        body: &Body,
        rays: &mut [CornerRay],
        cameras: &[Stitch],
        rays_m: f64,
        prior: &TrackPrior,
    ) -> f64 {
        let mut corrected = rays.to_vec();
        correct_rays(&mut corrected, cameras, rays_m);
        let is_known = cameras.is_empty() || prior.confirmed().is_some();
        let solved = if is_known { None } else { solve(body, &corrected).ok() };
        let nearest = solved.as_ref().and_then(|solutions| solutions.first());
        let seen_m =
            nearest.map_or(rays_m, |pose| pose.camera_from_markers.translation.vector.norm());
        correct_rays(rays, cameras, seen_m);
        seen_m
    }

    /// Whether any other target is tracked.
    fn tracks_others(&self, target: usize) -> bool {
        let mut others = self.targets.iter().enumerate().filter(|(other, _)| *other != target);
        others.any(|(_, target)| target.is_tracked())
    }
}
