//! The background pass: what takes several times as long as the other passes.
//!
//! A target that is not where its track predicts it may be found from rougher starts, or by a
//! search round the prediction. A target without a track may be found by trying whatever its
//! markers may mean. On two busy processors starts take 20 to 70 ms and the search 60 to 150, and
//! nobody else's pose should wait for that. So these passes run beside the others, one at a time. A
//! request is refused while another is under way, because a newer frame will ask again. Only an
//! untracked target may queue behind a tracked one: no newer frame need show anything of it for a
//! while.

use flockeye_contract::FrameOrder;
use std::collections::BTreeSet;

use flockeye_geometry::body::Body;
use flockeye_geometry::pose::CornerRay;
use flockeye_geometry::view::View;
use flockeye_imaging::align::{Motion, Picture};
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::LinearLight;
use nalgebra::Isometry3;

use super::comparison::Comparison;
use super::inputs::Inputs;
use crate::account::{Pass, Trial};
use crate::aligner::{Aligner, BestView, Sought, Start};
use crate::decide;
use crate::hypothesis::Source;
use crate::policy::TimeBudget;

/// Which target a background pass looks for, in which frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Subject {
    /// The frame.
    pub order: FrameOrder,
    /// When it was exposed, seconds.
    pub at_s: f64,
    /// The target's number.
    pub target: usize,
}

/// What a background pass found.
#[derive(Debug, Clone)]
pub struct Answer {
    /// What it looked for.
    pub subject: Subject,
    /// Whether the pose was found without the prior of a track, so that it may start one.
    pub is_independent: bool,
    /// The distance that the view's rays are right for, metres.
    pub rays_m: f64,
    /// How it was measured, with the target's pose, if it was found.
    pub trial: Box<Trial>,
}

/// Which background passes are under way, wait, or were refused. It holds no thread: whoever runs
/// [`BackgroundQueue::take_job`] gives the answer back to [`BackgroundQueue::finish`].
#[derive(Debug, Default)]
pub struct BackgroundQueue {
    under_way: Option<UnderWay>,
    /// The job that is under way, until it is taken.
    to_run: Option<Job>,
    /// The job that comes next.
    waiting: Option<Job>,
    /// The target of the last job.
    last: Option<usize>,
    /// Targets that were refused a job since.
    refused: BTreeSet<usize>,
}

#[derive(Debug)]
struct UnderWay {
    subject: Subject,
    is_untracked: bool,
    /// Whether the target was measured in that frame meanwhile.
    is_cancelled: bool,
}

impl BackgroundQueue {
    /// Asks for a pass, and says whether it is granted. It is not while another is under way, but
    /// an untracked target may queue behind a tracked one. A target that had the last pass goes
    /// behind those that were refused meanwhile.
    pub fn request(&mut self, subject: Subject, inputs: &Inputs<'_>) -> bool {
        let target = subject.target;
        if let Some(under_way) = &self.under_way {
            if under_way.subject.target != target {
                let is_untracked = inputs.prior.predicted().is_none();
                let is_own = |job: &Job| job.subject.target == target;
                if is_untracked
                    && !under_way.is_untracked
                    && self.waiting.as_ref().is_none_or(is_own)
                    && let Some(job) = Job::new(subject, inputs)
                {
                    self.waiting = Some(job);
                    return true;
                }
                self.refused.insert(target);
            }
            return false;
        }
        let had_last = self.last.take() == Some(target);
        let is_first = self.refused.is_empty() || self.refused.contains(&target);
        if had_last && !is_first {
            self.refused.clear();
            return false;
        }
        let job = Job::new(subject, inputs);
        let is_granted = job.is_some();
        job.into_iter().for_each(|job| self.start(job));
        is_granted
    }

    fn start(&mut self, job: Job) {
        let (subject, is_untracked) = (job.subject, job.is_untracked);
        self.refused.remove(&subject.target);
        self.last = Some(subject.target);
        self.under_way = Some(UnderWay { subject, is_untracked, is_cancelled: false });
        self.to_run = Some(job);
    }

    /// The job that is to be run now, once.
    pub fn take_job(&mut self) -> Option<Job> {
        self.to_run.take()
    }

    /// Cancels what is under way for a target in a frame, because the target was measured there. A
    /// job of that target that waits is dropped too: a newer frame has measured it.
    pub fn cancel(&mut self, order: FrameOrder, target: usize) {
        self.waiting.take_if(|job| job.subject.target == target);
        if let Some(under_way) = &mut self.under_way
            && (under_way.subject.order, under_way.subject.target) == (order, target)
        {
            under_way.is_cancelled = true;
        }
    }

    /// The frame of the pass that is under way and not cancelled.
    pub fn awaited(&self) -> Option<FrameOrder> {
        let under_way = self.under_way.as_ref().filter(|under_way| !under_way.is_cancelled)?;
        Some(under_way.subject.order)
    }

    /// Whether a pass over a frame is under way or waits, cancelled or not.
    pub fn is_about(&self, order: FrameOrder) -> bool {
        let under_way = self.under_way.iter().map(|under_way| under_way.subject);
        let mut subjects = under_way.chain(self.waiting.iter().map(|job| job.subject));
        subjects.any(|subject| subject.order == order)
    }

    /// Ends the job that was under way, and starts the one that waits. Returns whether the answer is
    /// wanted: not where the pass was cancelled meanwhile.
    pub fn finish(&mut self) -> bool {
        let is_cancelled = self.under_way.take().is_none_or(|under_way| under_way.is_cancelled);
        if let Some(next) = self.waiting.take() {
            self.start(next);
        }
        !is_cancelled
    }
}

/// All that a background pass needs, copied, so that its view can be released.
#[derive(Debug)]
pub struct Job {
    subject: Subject,
    is_untracked: bool,
    body: Body,
    /// The trial, before it.
    trial: Box<Trial>,
    view: CopiedView,
    decoded: Vec<CornerRay>,
    starts: Vec<(Source, Start)>,
    /// The prediction of a confirmed track.
    confirmed: Option<Isometry3<f64>>,
    /// The prediction that is searched round if no start leads to the body.
    search_round: Option<Isometry3<f64>>,
}

/// A view with its pixels.
#[derive(Debug)]
struct CopiedView {
    pixels: Vec<u8>,
    size: (usize, usize),
    view: View,
    light: LinearLight,
    pixels_per_radian: f64,
    motion: Motion,
    rays_m: f64,
}

impl CopiedView {
    fn of(best: &BestView<'_>) -> Self {
        let Picture { image, view, light, pixels_per_radian, motion } = best.picture;
        let mut pixels = Vec::with_capacity(image.width() * image.height());
        (0..image.height()).for_each(|y| pixels.extend_from_slice(image.row(y)));
        let (size, light) = ((image.width(), image.height()), light.clone());
        Self { pixels, size, view, light, pixels_per_radian, motion, rays_m: best.rays_m }
    }

    fn picture(&self) -> Option<Picture<'_>> {
        let (width, height) = self.size;
        Some(Picture {
            image: LumaImage::new(&self.pixels, width, height, width).ok()?,
            view: self.view,
            light: &self.light,
            pixels_per_radian: self.pixels_per_radian,
            motion: self.motion,
        })
    }
}

impl Job {
    /// `None` where there is no view.
    fn new(subject: Subject, inputs: &Inputs<'_>) -> Option<Self> {
        let predicted = inputs.prior.predicted().copied();
        Some(Self {
            subject,
            is_untracked: predicted.is_none(),
            body: inputs.body.clone(),
            trial: Box::new(inputs.trial(Pass::Background)),
            view: CopiedView::of(inputs.best_view.as_ref()?),
            decoded: inputs.decoded.clone(),
            starts: inputs.background_starts(),
            confirmed: inputs.prior.confirmed().map(|prior| prior.camera_from_markers),
            search_round: predicted.filter(|_| inputs.permit.may_search),
        })
    }

    /// Runs the pass.
    pub fn run(mut self, aligner: &Aligner) -> Answer {
        let mut tried = Vec::new();
        let picture = self.view.picture();
        let comparison = picture.as_ref().map(|picture| self.comparison(picture));
        let decision = comparison.map(|comparison| comparison.run(aligner, &mut tried));
        let decision = decision.unwrap_or_default();
        let is_independent = decide::is_independent(&decision, &tried, self.confirmed.is_some());
        (self.trial.decision, self.trial.hypotheses) = (decision, tried);
        let (subject, rays_m, trial) = (self.subject, self.view.rays_m, self.trial);
        Answer { subject, is_independent, rays_m, trial }
    }

    fn comparison<'s>(&'s self, picture: &'s Picture<'s>) -> Comparison<'s> {
        let (target, starts, budget) = (self.subject.target, &self.starts, TimeBudget::OneFrame);
        Comparison {
            sought: Sought { target, picture, starts, budget },
            body: &self.body,
            decoded: &self.decoded,
            confirmed: self.confirmed.as_ref(),
            needs_facets: false,
            round: self.search_round.as_ref(),
        }
    }
}

#[cfg(test)]
mod tests;
