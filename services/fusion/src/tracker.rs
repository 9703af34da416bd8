//! All targets with their tracks: runs the measurement passes and takes in what they find.
//!
//! A measurement enters a track in one place, [`Tracker::take_in`].

use std::collections::BTreeSet;
use std::sync::Arc;

use flockeye_contract::FrameOrder;
use flockeye_geometry::body::Bodies;
use flockeye_geometry::ego_rotation::EgoRotation;
use flockeye_geometry::filter::TrackPolicy;

use crate::account::{Account, AccountEntry, Pass};
use crate::aligner::Aligner;
use crate::decide::markers::contradicts;
use crate::decide::outcome::Outcome;
use crate::exposure::Exposure;
use crate::frame::parts::{Part, Parts, Status};
use crate::measure::background::BackgroundQueue;
use crate::measure::{AnsweredView, BestViews, distinct_decoded};
use crate::measurement::{Measurement, decoded_rays};
use crate::parallax::Parallax;
use crate::policy::{DirectPassPolicy, TimeBudget};
use crate::readout::Readout;
use crate::schedule::Attempts;
use crate::target::{Target, TargetEstimate, Update};

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

/// What is known of the camera beside its model.
struct CameraState {
    /// How it has turned.
    ego: EgoRotation,
    /// How long it exposes frames.
    exposure: Exposure,
    /// `None` where all lenses lie at its centre.
    parallax: Option<Parallax>,
    /// `None` where all rows are exposed at once.
    readout: Option<Readout>,
}

/// What targets are measured with.
struct Means {
    aligner: Arc<Aligner>,
    /// See [`Bodies::radius_in_sides`].
    radius_in_sides: f64,
    threads: usize,
}

/// All targets with their tracks.
pub struct Tracker {
    targets: Vec<Target>,
    filter: FilterChoice,
    camera: CameraState,
    means: Means,
    /// `None`: everything is done at once.
    background: Option<BackgroundQueue>,
    direct_policy: DirectPassPolicy,
    attempts: Attempts,
    /// The last frame that has ended, and when it was exposed, seconds.
    ended: Option<(FrameOrder, f64)>,
    /// The decisions on one target, if an account of it was asked for.
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
            camera: CameraState {
                // Predictions reach back to the last measurement, and not farther than this.
                ego: EgoRotation::new(policy.motion.longest_step_s + policy.history_s),
                exposure: Exposure::new(None, aligner.pixels_per_radian()),
                parallax: None,
                readout: None,
            },
            means: Means { aligner, radius_in_sides: bodies.radius_in_sides(), threads },
            background: None,
            direct_policy: DirectPassPolicy::default(),
            attempts: Attempts::default(),
            ended: None,
            account: None,
        }
    }

    /// Brings rays and poses to their distances, for a camera whose lenses lie off its centre.
    pub fn with_parallax(self, parallax: Option<Parallax>) -> Self {
        Self { camera: CameraState { parallax, ..self.camera }, ..self }
    }

    /// Takes into account that rows are exposed one after the other.
    pub fn with_readout(self, readout: Option<Readout>) -> Self {
        Self { camera: CameraState { readout, ..self.camera }, ..self }
    }

    /// States how long frames are exposed, seconds. Without it the blur of moving bodies shows it
    /// in time.
    pub fn with_exposure(self, known_s: Option<f64>) -> Self {
        let exposure = Exposure::new(known_s, self.means.aligner.pixels_per_radian());
        Self { camera: CameraState { exposure, ..self.camera }, ..self }
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
        self.means.threads
    }

    /// The last frame that has ended.
    pub fn last_ended(&self) -> Option<FrameOrder> {
        self.ended.map(|(order, _)| order)
    }

    /// The attempts since this was asked last.
    pub fn take_attempts(&mut self) -> Attempts {
        std::mem::take(&mut self.attempts)
    }

    /// The corner pass over regions of interest of one frame that have been searched. A pose need
    /// wait neither for the frame's tiles nor for the frame before, because the filter puts each
    /// measurement where it belongs in time.
    pub fn region_pass(
        &mut self,
        time: FrameTime,
        parts: &mut Parts,
        answered: &[AnsweredView<'_>],
        best_views: &BestViews<'_>,
        budget: TimeBudget,
    ) -> Vec<Update> {
        self.compare_with_markers(time.order, parts, answered);
        let mut tried: Vec<(usize, &[AnsweredView<'_>])> = Vec::new();
        for answer in answered {
            let Some(target) = answer.region_of() else { continue };
            let Some(part) = parts.get_mut(target) else { continue };
            // Without its view it is unknown what distance a record's rays are right for. Once the
            // frame is complete, the assumed distance has to do.
            let is_ready = self.camera.parallax.is_none() || answer.view.is_some();
            let is_due = is_ready && !part.is_published();
            if is_due && !std::mem::replace(&mut part.is_region_tried, true) {
                tried.push((target, std::slice::from_ref(answer)));
            }
        }
        self.corner_pass(time, parts, &tried, best_views, Pass::Region, budget)
    }

    /// The last corner pass, once all of a frame has been searched. It gives an estimate also for
    /// tracked targets that the frame does not show.
    pub fn final_pass(
        &mut self,
        time: FrameTime,
        parts: &mut Parts,
        answered: &[AnsweredView<'_>],
        best_views: &BestViews<'_>,
        budget: TimeBudget,
    ) -> Vec<Update> {
        // The passes run as if each region's record had come alone: the result of a frame must not
        // depend on when its parts came.
        let mut updates = self.region_pass(time, parts, answered, best_views, budget);
        let left: Vec<(usize, &[AnsweredView<'_>])> =
            parts.unpublished().map(|target| (target, answered)).collect();
        updates.extend(self.corner_pass(time, parts, &left, best_views, Pass::Complete, budget));
        let missed: Vec<usize> = parts.unpublished().collect();
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
            let estimate = match self.filter {
                FilterChoice::Tracks(_) => {
                    self.targets[target].miss(time.at_s, decoded, &self.camera.ego)
                }
                FilterChoice::None => None,
            };
            updates.extend(estimate.map(|estimate| (target, estimate)));
        }
        updates
    }

    /// Suspends the direct pass of targets whose markers contradict what it published.
    fn compare_with_markers(
        &mut self,
        order: FrameOrder,
        parts: &Parts,
        answered: &[AnsweredView<'_>],
    ) {
        for answer in answered {
            let Some(target) = answer.region_of() else { continue };
            let Some(Target { body, .. }) = self.targets.get(target) else { continue };
            let Some(pose) = parts.get(target).and_then(Part::direct_pose) else { continue };
            let rays = decoded_rays(body, &answer.record.markers);
            if contradicts(body, &rays, pose) {
                self.direct_policy.suspend(target);
                self.note(order, target, AccountEntry::Contradicted);
            }
        }
    }

    /// Takes a measurement into the track of its target: the one place where that happens. `part`
    /// is the target's part in the frame, unless that has ended. Returns what is known of the target
    /// then, `None` where the filter refuses the measurement, and what became of it.
    pub(crate) fn take_in(
        &mut self,
        time: FrameTime,
        target: usize,
        part: Option<&mut Part>,
        measurement: Measurement,
    ) -> (Option<Update>, Outcome) {
        let estimate = match self.filter {
            FilterChoice::Tracks(_) => {
                self.targets[target].update(time.at_s, &measurement, &self.camera.ego)
            }
            FilterChoice::None => {
                measurement.is_precise.then(|| TargetEstimate::of_frame(&measurement))
            }
        };
        let is_measured = estimate.as_ref().map(|estimate| estimate.measured.is_some());
        let outcome = Outcome::of(measurement, is_measured);
        let Some(estimate) = estimate else { return (None, outcome) };
        if let Some(part) = part {
            part.status = Status::Published { direct_pose: None };
        }
        if let Some(queue) = &mut self.background {
            queue.cancel(time.order, target);
        }
        (Some((target, estimate)), outcome)
    }

    /// Ends a frame that was exposed at `at_s`, seconds. Frames end in their order.
    pub fn end_frame(&mut self, order: FrameOrder, at_s: f64, parts: &Parts) {
        let direct: BTreeSet<usize> = parts.measured_directly().collect();
        self.direct_policy.end_frame(&direct);
        self.camera.exposure.end_frame();
        self.ended = Some((order, at_s));
    }

    /// Whether a target's region of interest in the next frame need not be searched for markers.
    pub fn needs_no_markers(&self, target: usize) -> bool {
        self.direct_policy.needs_no_markers(target)
    }
}

mod accounting;
mod by_background;
mod by_markers;
mod by_place;
mod by_prediction;
mod predictions;
mod resumed;
#[cfg(test)]
mod tests;
