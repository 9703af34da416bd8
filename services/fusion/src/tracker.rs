//! All targets with their tracks: runs the measurement passes and handles their results.
//!
//! A measurement enters a track in one place, [`Tracker::take_in`].

use std::fmt;
use std::sync::Arc;

use flockeye_contract::FrameOrder;
use flockeye_geometry::body::Bodies;
use flockeye_geometry::camera::Camera;
use flockeye_geometry::ego_rotation::EgoRotation;
use flockeye_geometry::filter::{HISTORY_S, TrackPolicy};
use flockeye_geometry::pose::LensError;

use crate::account::{AccountEntry, Pass, Trial};
use crate::aligner::Aligner;
use crate::decide::markers::contradicts;
use crate::decide::outcome::Outcome;
use crate::exposure::ExposureEstimate;
use crate::frame::parts::{Part, Status, unpublished};
use crate::measure::background::BackgroundSlot;
use crate::measure::{AnsweredView, BestViews, FrameTime, distinct_decoded};
use crate::measurement::{PoseMeasurement, decoded_rays};
use crate::parallax::Parallax;
use crate::policy::TimeBudget;
use crate::response::{ResponseEstimate, Stated, Surprise};
use crate::schedule::Attempts;
use crate::stitching::{StitchEstimate, correct_rays, remade};
use crate::target::{Target, TargetEstimate, Update};

/// State of the camera beside its picture.
pub(crate) struct CameraState {
    /// Its rotation.
    ego: EgoRotation,
    exposure: ExposureEstimate,
    pub(crate) response: ResponseEstimate,
    /// Corrects rays and poses to their distances; `None` if all lenses lie at the camera's centre, and
    /// for a stitched camera.
    pub(crate) parallax: Option<Parallax>,
    /// The lenses of a stitched camera; `None` if it is known to have one centre.
    pub(crate) stitching: Option<StitchEstimate>,
    /// The error of its lens model.
    pub(crate) lens: LensError,
    /// Its model, and the time from its first to its last row, seconds; `None` where all rows are
    /// exposed at once.
    pub(crate) readout: Option<(Camera, f64)>,
}

impl CameraState {
    /// Whether rays are right for things at any distance.
    fn has_one_centre(&self) -> bool {
        self.parallax.is_none() && self.stitching.is_none()
    }
}

/// What is known of the response and of the lenses, for health.
impl fmt::Display for CameraState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.response)?;
        self.stitching.iter().try_for_each(|stitching| write!(f, "; {stitching}"))
    }
}

/// All targets with their tracks.
pub struct Tracker {
    targets: Vec<Target>,
    /// Policy of the tracks' filters; `None`: each frame is independent.
    filter: Option<TrackPolicy>,
    aligner: Arc<Aligner>,
    /// See [`Bodies::radius_in_sides`].
    radius_in_sides: f64,
    /// Most threads that measure targets of one frame.
    pub(crate) threads: usize,
    pub(crate) camera: CameraState,
    /// Background passes; `None`: rough starts run at once.
    pub(crate) background: Option<BackgroundSlot>,
    attempts: Attempts,
    /// The last frame that has ended, and its exposure, seconds.
    pub(crate) ended: Option<(FrameOrder, f64)>,
    /// The target with an account, and its events with their frames.
    account: Option<(usize, Vec<(FrameOrder, AccountEntry)>)>,
}

impl Tracker {
    /// Creates targets before their first measurement. `exposure_s` is the exposure time of frames,
    /// seconds. Without it, it is learned from the blur of moving bodies.
    pub(crate) fn new(
        bodies: &Bodies,
        filter: Option<TrackPolicy>,
        aligner: Arc<Aligner>,
        threads: usize,
        exposure_s: Option<f64>,
    ) -> Self {
        let policy = filter.unwrap_or_default();
        Self {
            targets: bodies.iter().map(|body| Target::new(body.clone(), policy)).collect(),
            filter,
            radius_in_sides: bodies.radius_in_sides(),
            threads,
            camera: CameraState {
                // Predictions reach back to the last measurement, but not farther than this.
                ego: EgoRotation::new(policy.motion.longest_step_s + HISTORY_S),
                exposure: ExposureEstimate::new(exposure_s, aligner.pixels_per_radian),
                response: ResponseEstimate::new(Stated::Exactly),
                parallax: None,
                stitching: None,
                lens: LensError::default(),
                readout: None,
            },
            aligner,
            background: None,
            attempts: Attempts::default(),
            ended: None,
            account: None,
        }
    }

    /// The targets, by their numbers.
    pub fn targets(&self) -> &[Target] {
        &self.targets
    }

    /// State of the camera beside its picture.
    pub(crate) fn camera(&self) -> &CameraState {
        &self.camera
    }

    /// The attempts since the last call.
    pub(crate) fn take_attempts(&mut self) -> Attempts {
        std::mem::take(&mut self.attempts)
    }

    /// The corner pass over regions of interest of one frame that have been searched. A pose waits
    /// neither for the frame's tiles nor for the frame before, because the filter sorts
    /// measurements by time.
    pub(crate) fn region_pass(
        &mut self,
        time: FrameTime,
        parts: &mut [Part],
        answered: &[AnsweredView<'_>],
        best_views: &BestViews<'_>,
        budget: TimeBudget,
    ) -> Vec<Update> {
        self.compare_with_markers(time.order, parts, answered);
        let mut tried: Vec<(usize, &[AnsweredView<'_>])> = Vec::new();
        for answer in answered {
            let Some(target) = answer.region_of() else { continue };
            let Some(part) = parts.get_mut(target) else { continue };
            // Without its view, the distance of a record's rays is not known. Once the frame is
            // complete, the assumed distance is used.
            let is_ready = self.camera.has_one_centre() || answer.view.is_some();
            let is_due = is_ready && !part.is_published();
            if is_due && !std::mem::replace(&mut part.is_region_tried, true) {
                tried.push((target, std::slice::from_ref(answer)));
            }
        }
        self.corner_pass(time, parts, &tried, best_views, Pass::Region, budget)
    }

    /// The last corner pass, once all of a frame has been searched. It gives an estimate also for
    /// tracked targets that the frame does not show.
    pub(crate) fn final_pass(
        &mut self,
        time: FrameTime,
        parts: &mut [Part],
        answered: &[AnsweredView<'_>],
        best_views: &BestViews<'_>,
        budget: TimeBudget,
    ) -> Vec<Update> {
        // The passes run as if each region's record had arrived alone, because the result must not
        // depend on the order of arrival.
        let mut updates = self.region_pass(time, parts, answered, best_views, budget);
        let left: Vec<(usize, &[AnsweredView<'_>])> =
            unpublished(parts).map(|target| (target, answered)).collect();
        updates.extend(self.corner_pass(time, parts, &left, best_views, Pass::Complete, budget));
        let missed: Vec<usize> = unpublished(parts).collect();
        for target in missed {
            let mut part = parts.get_mut(target);
            let imprecise = part.as_mut().and_then(|part| part.imprecise.take());
            let update = imprecise.and_then(|imprecise| {
                let (update, outcome) = self.take_in(time, target, part, imprecise);
                self.note(time.order, target, AccountEntry::TakenImprecise(outcome));
                update
            });
            if update.is_some() {
                updates.extend(update);
                continue;
            }
            let decoded = answered.iter().flat_map(|answer| &answer.record.markers);
            let decoded = distinct_decoded(decoded, &self.targets[target].body);
            let estimate = self
                .filter
                .and_then(|_| self.targets[target].miss(time.at_s, decoded, &self.camera.ego));
            updates.extend(estimate.map(|estimate| (target, estimate)));
        }
        updates
    }

    /// Suspends the direct pass of targets whose markers contradict its published pose.
    fn compare_with_markers(
        &mut self,
        order: FrameOrder,
        parts: &[Part],
        answered: &[AnsweredView<'_>],
    ) {
        for answer in answered {
            let Some(target) = answer.region_of() else { continue };
            let Some(known) = self.targets.get_mut(target) else { continue };
            let Some(pose) = parts.get(target).and_then(Part::direct_pose) else { continue };
            let mut rays = decoded_rays(&known.body, &answer.record.markers);
            if let Some(stitching) = &self.camera.stitching {
                let cameras = vec![stitching.of_view(answer.view); rays.len()];
                correct_rays(&mut rays, &cameras, pose.translation.vector.norm());
            }
            if contradicts(&known.body, &rays, pose) {
                known.suspend_direct_pass();
                self.note(order, target, AccountEntry::Contradicted);
            }
        }
    }

    /// Updates the track of its target with a measurement: the one place where that happens. `part`
    /// is the target's part in the frame, unless that has ended. Returns the target's estimate,
    /// `None` if the filter refuses the measurement, and the outcome.
    pub(crate) fn take_in(
        &mut self,
        time: FrameTime,
        target: usize,
        part: Option<&mut Part>,
        measurement: PoseMeasurement,
    ) -> (Option<Update>, Outcome) {
        let estimate = match self.filter {
            Some(_) => self.targets[target].update(time.at_s, &measurement, &self.camera.ego),
            None => measurement.is_usable_alone().then(|| TargetEstimate::of_frame(&measurement)),
        };
        let outcome = Outcome::of(measurement, estimate.as_ref());
        let Some(estimate) = estimate else { return (None, outcome) };
        if let Some(part) = part {
            part.status = Status::Published { direct_pose: None };
        }
        if let Some(slot) = &mut self.background {
            slot.cancel(time.order, target);
        }
        (Some((target, estimate)), outcome)
    }

    /// Ends a frame with its exposure at `at_s`, seconds. Frames end in their order.
    pub(crate) fn end_frame(&mut self, order: FrameOrder, at_s: f64, parts: &[Part]) {
        for (target, part) in self.targets.iter_mut().zip(parts) {
            target.end_frame(part.direct_pose().is_some());
        }
        self.camera.exposure.end_frame();
        self.ended = Some((order, at_s));
    }

    /// Whether a target's region of interest in the next frame need not be searched for markers.
    pub(crate) fn needs_no_markers(&self, target: usize) -> bool {
        self.targets[target].needs_no_markers(target)
    }

    /// From now on, records the decisions about a target.
    pub(crate) fn keep_account(&mut self, target: usize) {
        self.account = Some((target, Vec::new()));
    }

    /// The decisions about the target since the last call, with the frame of each.
    pub(crate) fn take_account(&mut self) -> Vec<(FrameOrder, AccountEntry)> {
        self.account.as_mut().map(|(_, entries)| std::mem::take(entries)).unwrap_or_default()
    }

    /// Records an event of a target, if it has an account. It has no effect on decisions.
    fn note(&mut self, order: FrameOrder, target: usize, entry: AccountEntry) {
        if let Some((_, entries)) = self.account.as_mut().filter(|(asked, _)| *asked == target) {
            entries.push((order, entry));
        }
    }

    /// Records a pass over a target with the outcome of its pose.
    fn note_trial(&mut self, order: FrameOrder, target: usize, trial: Trial, outcome: Outcome) {
        self.note(order, target, AccountEntry::Ran(Trial { outcome, ..trial }));
    }

    /// Ends a frame for what is learned of the camera. If that moves poses, tracks move with it.
    pub(crate) fn learn(&mut self) -> Option<Surprise> {
        if let Some(stitching) = &mut self.camera.stitching
            && let Some(before) = stitching.end_frame()
        {
            let now = *stitching.current();
            for target in &mut self.targets {
                let radius_m = target.body.radius();
                target.correct(|pose| remade(pose, radius_m, &before, &now), &self.camera.ego);
            }
        }
        self.camera.response.end_frame()
    }

    /// Records what a measurement shows of the camera.
    fn note_camera(&mut self, target: usize, trial: &Trial) {
        let Some(chosen) = trial.decision.chosen_of(&trial.hypotheses) else { return };
        if let Some(seen) = chosen.response {
            self.camera.response.note(target, seen);
        }
        if let Some((stitching, seen)) = self.camera.stitching.as_mut().zip(chosen.stitch) {
            stitching.note(target, seen);
        }
    }

    /// Handles and records the measurement of a pass over a target.
    fn take_in_trial(
        &mut self,
        time: FrameTime,
        target: usize,
        part: Option<&mut Part>,
        measurement: PoseMeasurement,
        trial: Trial,
    ) -> Option<Update> {
        let (update, outcome) = self.take_in(time, target, part, measurement);
        if update.is_some() {
            self.note_camera(target, &trial);
        }
        self.note_trial(time.order, target, trial, outcome);
        update
    }
}

mod by_background;
mod by_markers;
mod by_place;
mod by_prediction;
mod predictions;
mod resumed;
#[cfg(test)]
mod tests;
