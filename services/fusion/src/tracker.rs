//! All targets with their tracks: runs the measurement passes and takes in what they find.
//!
//! A measurement enters a track in one place, [`Tracker::take_in`].

use std::collections::BTreeSet;
use std::sync::Arc;

use flockeye_contract::{FrameOrder, ViewHeader};
use flockeye_geometry::body::Bodies;
use flockeye_geometry::ego_rotation::EgoRotation;
use flockeye_geometry::filter::TrackPolicy;
use flockeye_geometry::search::{Purpose, StopRule};

use crate::account::{Account, Decision};
use crate::exposure::Exposure;
use crate::frame_assembly::{Frame, Record};
use crate::hypothesis::Aligner;
use crate::measurement::{Measurement, contradicts, decoded_rays};
use crate::parallax::Parallax;
use crate::passes::background::BackgroundQueue;
use crate::passes::corners::{Moment, distinct_decoded};
use crate::passes::{AnsweredView, BestViews};
use crate::policy::{DirectPassPolicy, TimeBudget};
use crate::readout::Readout;
use crate::schedule::Attempts;
use crate::target::{Status, Target, TargetEstimate, Update, outcome_of};
use crate::view_cache::ViewQuality;

/// How poses are carried from frame to frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum FilterChoice {
    /// A track for each target.
    Tracks(TrackPolicy),
    /// Each frame for itself.
    None,
}

/// Where a frame is in time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameTime {
    /// Its place among all frames.
    pub order: FrameOrder,
    /// When it was exposed, seconds.
    pub at_s: f64,
    /// How many frames had ended before.
    pub number: u64,
}

/// All targets with their tracks.
pub struct Tracker {
    targets: Vec<Target>,
    filter: FilterChoice,
    ego: EgoRotation,
    parallax: Option<Parallax>,
    readout: Option<Readout>,
    aligner: Arc<Aligner>,
    /// See [`Bodies::radius_in_sides`].
    radius_in_sides: f64,
    threads: usize,
    /// `None`: everything is done at once.
    background: Option<BackgroundQueue>,
    direct_policy: DirectPassPolicy,
    exposure: Exposure,
    attempts: Attempts,
    /// The last frame that has ended, and when it was exposed, seconds.
    ended: Option<(FrameOrder, f64)>,
    /// What is decided of one target, where somebody asks.
    account: Option<Account>,
}

impl Tracker {
    /// Targets that were never seen. Those of one frame are measured on up to `threads` threads.
    pub fn new(
        bodies: &Bodies,
        filter: FilterChoice,
        aligner: Arc<Aligner>,
        threads: usize,
    ) -> Self {
        let policy = match filter {
            FilterChoice::Tracks(policy) => policy,
            FilterChoice::None => TrackPolicy::default(),
        };
        Self {
            targets: bodies.iter().map(|body| Target::new(body.clone(), policy)).collect(),
            filter,
            // Predictions reach back to the last measurement, and not farther than this.
            ego: EgoRotation::new(policy.motion.longest_step_s + policy.history_s),
            parallax: None,
            readout: None,
            exposure: Exposure::new(None, aligner.pixels_per_radian()),
            aligner,
            radius_in_sides: bodies.radius_in_sides(),
            threads,
            background: None,
            direct_policy: DirectPassPolicy::default(),
            attempts: Attempts::default(),
            ended: None,
            account: None,
        }
    }

    /// Brings rays and poses to their distances, for a camera whose lenses lie off its centre.
    pub fn with_parallax(self, parallax: Option<Parallax>) -> Self {
        Self { parallax, ..self }
    }

    /// Takes into account that rows are exposed one after the other.
    pub fn with_readout(self, readout: Option<Readout>) -> Self {
        Self { readout, ..self }
    }

    /// States how long frames are exposed, seconds. Without it the blur of moving bodies shows it in time.
    pub fn with_exposure(self, known_s: Option<f64>) -> Self {
        let exposure = Exposure::new(known_s, self.aligner.pixels_per_radian());
        Self { exposure, ..self }
    }

    /// Leaves what takes long to the background pass, whose jobs [`Tracker::take_job`] hands out.
    pub fn with_background(self) -> Self {
        Self { background: Some(BackgroundQueue::default()), ..self }
    }

    /// The targets, by their numbers.
    pub fn targets(&self) -> &[Target] {
        &self.targets
    }

    /// How many threads targets are measured on.
    pub fn threads(&self) -> usize {
        self.threads
    }

    /// The last frame that has ended.
    pub fn last_ended(&self) -> Option<FrameOrder> {
        self.ended.map(|(order, _)| order)
    }

    /// The attempts since this was asked last.
    pub fn take_attempts(&mut self) -> Attempts {
        std::mem::take(&mut self.attempts)
    }

    /// How well a view shows the targets that it is the region of, or shows markers of. Targets whose
    /// pose in the frame has left need no view.
    pub fn shown(
        &self,
        record: &Record,
        purpose: Option<Purpose>,
        view: Option<&ViewHeader>,
        stop_rule: StopRule,
    ) -> Vec<(usize, ViewQuality)> {
        let Some(view) = view else { return Vec::new() };
        self.unpublished(record.header.stamp.order())
            .filter_map(|target| {
                let is_own = purpose == Some(Purpose::Gaze(target));
                let (body, is_tracked) =
                    (&self.targets[target].body, self.targets[target].is_tracked());
                let quality = ViewQuality::of(record, view, body, is_own, is_tracked, stop_rule)?;
                Some((target, quality))
            })
            .collect()
    }

    /// The corner pass over regions of interest of one frame that have been searched. A pose need wait
    /// neither for the frame's tiles nor for the frame before, because the filter puts each measurement
    /// where it belongs in time.
    pub fn region_pass(
        &mut self,
        time: FrameTime,
        answered: &[AnsweredView<'_>],
        best_views: &BestViews<'_>,
        budget: TimeBudget,
    ) -> Vec<Update> {
        self.compare_with_markers(time.order, answered);
        let mut tried: Vec<(usize, &[AnsweredView<'_>])> = Vec::new();
        for answer in answered {
            let Some(target) = answer.region_of().filter(|&target| target < self.targets.len())
            else {
                continue;
            };
            // Without its view nobody knows what distance a record's rays are right for. Once the frame
            // is complete, the assumed distance has to do.
            let is_ready = self.parallax.is_none() || answer.view.is_some();
            let is_published = self.targets[target].is_published(time.order);
            let in_frame = self.targets[target].in_frame_mut(time.order);
            if is_ready && !is_published && !std::mem::replace(&mut in_frame.is_region_tried, true)
            {
                tried.push((target, std::slice::from_ref(answer)));
            }
        }
        self.corner_pass(time, &tried, best_views, Moment::RegionSearched, budget)
    }

    /// The last corner pass, once all of a frame has been searched. It gives an estimate also for tracked
    /// targets that the frame does not show.
    pub fn final_pass(
        &mut self,
        time: FrameTime,
        answered: &[AnsweredView<'_>],
        best_views: &BestViews<'_>,
        budget: TimeBudget,
    ) -> Vec<Update> {
        // The same passes as if each region's record had come alone: what a frame says must not depend
        // on when its parts came.
        let mut updates = self.region_pass(time, answered, best_views, budget);
        let left: Vec<(usize, &[AnsweredView<'_>])> =
            self.unpublished(time.order).map(|target| (target, answered)).collect();
        updates.extend(self.corner_pass(time, &left, best_views, Moment::FrameComplete, budget));
        let missed: Vec<usize> = self.unpublished(time.order).collect();
        for target in missed {
            let imprecise = self.targets[target].in_frame_mut(time.order).imprecise.take();
            let update = imprecise.and_then(|imprecise| {
                let update = self.take_in(time, target, &imprecise);
                let outcome = || outcome_of(imprecise, update.as_ref());
                self.note(time.order, target, || Decision::TakenImprecise(outcome()));
                update
            });
            if update.is_some() {
                updates.extend(update);
                continue;
            }
            let decoded = answered.iter().flat_map(|answer| &answer.record.markers);
            let decoded = distinct_decoded(decoded, &self.targets[target].body);
            let estimate = match self.filter {
                FilterChoice::Tracks(_) => self.targets[target].miss(time.at_s, decoded, &self.ego),
                FilterChoice::None => None,
            };
            updates.extend(estimate.map(|estimate| (target, estimate)));
        }
        updates
    }

    /// Suspends the direct pass of targets whose markers contradict what it published.
    fn compare_with_markers(&mut self, order: FrameOrder, answered: &[AnsweredView<'_>]) {
        for answer in answered {
            let Some(target) = answer.region_of() else { continue };
            let Some(Target { body, .. }) = self.targets.get(target) else { continue };
            let Some(pose) = self.targets[target].direct_pose(order) else { continue };
            let rays = decoded_rays(body, &answer.record.markers);
            if contradicts(body, &rays, pose) {
                self.direct_policy.suspend(target);
                self.note(order, target, || Decision::Contradicted);
            }
        }
    }

    /// Takes a measurement into the track of its target: the one place where that happens. `None` where
    /// the filter refuses it.
    pub(crate) fn take_in(
        &mut self,
        time: FrameTime,
        target: usize,
        measurement: &Measurement,
    ) -> Option<Update> {
        let estimate = match self.filter {
            FilterChoice::Tracks(_) => {
                self.targets[target].update(time.at_s, measurement, &self.ego)
            }
            FilterChoice::None => {
                measurement.is_precise.then(|| TargetEstimate::of_frame(measurement))
            }
        }?;
        let status = Status::Published { direct_pose: None };
        self.targets[target].in_frame_mut(time.order).status = status;
        if let Some(queue) = &mut self.background {
            queue.cancel(time.order, target);
        }
        Some((target, estimate))
    }

    /// Numbers of the targets whose pose in a frame has not left.
    fn unpublished(&self, order: FrameOrder) -> impl Iterator<Item = usize> {
        (0..self.targets.len()).filter(move |&target| !self.targets[target].is_published(order))
    }

    /// Ends a frame. Frames end in their order.
    pub fn end_frame(&mut self, frame: &Frame, at_s: f64) {
        let order = frame.stamp.order();
        let is_direct = |target: &usize| self.targets[*target].direct_pose(order).is_some();
        let direct: BTreeSet<usize> = (0..self.targets.len()).filter(is_direct).collect();
        self.direct_policy.end_frame(&direct);
        self.exposure.end_frame();
        self.ended = Some((order, at_s));
        self.targets.iter_mut().for_each(|target| target.end_frame(order));
    }

    /// Whether a target's region of interest in the next frame need not be searched for markers.
    pub fn needs_no_markers(&self, target: usize) -> bool {
        self.direct_policy.needs_no_markers(target)
    }
}

mod accounting;
mod corner_passes;
mod direct_passes;
mod late_answers;
mod place_passes;
mod predictions;
mod resumed;
#[cfg(test)]
mod tests;
