//! The background pass: rough starts, beside the other passes.
//!
//! A target that is not at its predicted place may be found from rougher starts. Other poses should
//! not wait for them. So these passes run beside the others, one at a time. A request is refused
//! while another runs, because a newer frame will repeat it.

use flockeye_contract::FrameOrder;
use std::collections::BTreeSet;

use flockeye_geometry::body::Body;
use flockeye_geometry::camera::Stitch;
use flockeye_geometry::pose::{CornerRay, PoseEstimate};
use flockeye_geometry::view::View;
use flockeye_imaging::align::{Motion, Picture};
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::LinearLight;
use nalgebra::Isometry3;

use super::FrameTime;
use super::inputs::PassInputs;
use crate::account::{Pass, Trial};
use crate::aligner::{Aligner, BestView, Sought, Start};
use crate::decide::markers::supports;
use crate::hypothesis::StartSource;
use crate::policy::TimeBudget;

/// The background pass that runs, and the targets that were refused one. It holds no thread: the
/// caller of [`BackgroundSlot::take_job`] returns the answer to [`BackgroundSlot::finish`].
#[derive(Debug, Default)]
pub(crate) struct BackgroundSlot {
    pub(crate) under_way: Option<UnderWay>,
    /// The job that was granted, until it is taken.
    to_run: Option<Job>,
    /// The target of the last job.
    last: Option<usize>,
    /// Targets that were refused a job since.
    refused: BTreeSet<usize>,
}

/// The one running background pass.
#[derive(Debug)]
pub(crate) struct UnderWay {
    pub(crate) time: FrameTime,
    pub(crate) target: usize,
    /// Distance for which the view's rays are exact, metres.
    pub(crate) rays_m: f64,
    /// The lenses of a stitched camera, as they are known in that frame.
    pub(crate) stitch: Option<Stitch>,
    /// Whether the target was measured in that frame meanwhile.
    pub(crate) is_cancelled: bool,
}

impl BackgroundSlot {
    /// Requests a pass, and returns whether it is granted. It is refused while another runs. A
    /// target that had the last pass goes behind those that were refused meanwhile.
    pub(crate) fn request(&mut self, time: FrameTime, inputs: &PassInputs<'_>) -> bool {
        let target = inputs.target;
        if let Some(under_way) = &self.under_way {
            if under_way.target != target {
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
        let Some(job) = Job::new(inputs) else { return false };
        self.refused.remove(&target);
        self.last = Some(target);
        let (rays_m, stitch) = (job.view.rays_m, job.view.stitch);
        self.under_way = Some(UnderWay { time, target, rays_m, stitch, is_cancelled: false });
        self.to_run = Some(job);
        true
    }

    /// Returns the job to run now, once.
    pub(crate) fn take_job(&mut self) -> Option<Job> {
        self.to_run.take()
    }

    /// Cancels the running pass for a target in a frame, because the target was measured there.
    pub(crate) fn cancel(&mut self, order: FrameOrder, target: usize) {
        if let Some(under_way) = &mut self.under_way
            && (under_way.time.order, under_way.target) == (order, target)
        {
            under_way.is_cancelled = true;
        }
    }

    /// The frame of the running pass that is not cancelled.
    pub(crate) fn awaited(&self) -> Option<FrameOrder> {
        let under_way = self.under_way.as_ref().filter(|under_way| !under_way.is_cancelled)?;
        Some(under_way.time.order)
    }

    /// Whether a pass over a frame runs, cancelled or not.
    pub(crate) fn is_about(&self, order: FrameOrder) -> bool {
        self.under_way.as_ref().is_some_and(|under_way| under_way.time.order == order)
    }

    /// Ends the running job.
    pub(crate) fn finish(&mut self) -> Option<UnderWay> {
        self.under_way.take()
    }
}

/// All inputs of a background pass, copied, so that its view can be released.
#[derive(Debug)]
pub struct Job {
    target: usize,
    body: Body,
    /// The trial, before the pass.
    trial: Box<Trial>,
    view: CopiedView,
    decoded: Vec<CornerRay>,
    starts: Vec<(StartSource, Start)>,
    /// The prediction of a confirmed track.
    confirmed: Option<PoseEstimate>,
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
    response_sigma: f64,
    stitch: Option<Stitch>,
    rays_m: f64,
}

impl CopiedView {
    fn of(best: &BestView<'_>) -> Self {
        let Picture { image, view, light, pixels_per_radian, motion, response_sigma, stitch } =
            best.picture;
        let mut pixels = Vec::with_capacity(image.width() * image.height());
        (0..image.height()).for_each(|y| pixels.extend_from_slice(image.row(y)));
        let (size, light) = ((image.width(), image.height()), light.clone());
        let rays_m = best.rays_m;
        Self {
            pixels,
            size,
            view,
            light,
            pixels_per_radian,
            motion,
            response_sigma,
            stitch,
            rays_m,
        }
    }

    fn picture(&self) -> Option<Picture<'_>> {
        let (width, height) = self.size;
        Some(Picture {
            image: LumaImage::new(&self.pixels, width, height, width).ok()?,
            view: self.view,
            light: &self.light,
            pixels_per_radian: self.pixels_per_radian,
            motion: self.motion,
            response_sigma: self.response_sigma,
            stitch: self.stitch,
        })
    }
}

impl Job {
    /// `None` where there is no view.
    fn new(inputs: &PassInputs<'_>) -> Option<Self> {
        Some(Self {
            target: inputs.target,
            body: inputs.body.clone(),
            trial: Box::new(Trial { pass: Pass::Background, ..inputs.trial.clone() }),
            view: CopiedView::of(inputs.best_view.as_ref()?),
            decoded: inputs.decoded.clone(),
            starts: inputs.background_starts(),
            confirmed: inputs.prior.confirmed().copied(),
        })
    }

    /// Runs the pass, and returns its result.
    pub(crate) fn run(mut self, aligner: &Aligner) -> Box<Trial> {
        let mut tried = Vec::new();
        let picture = self.view.picture();
        let decision = picture.as_ref().map(|picture| {
            let (target, starts, budget) = (self.target, &self.starts, TimeBudget::OneFrame);
            let sought = Sought { target, picture, starts, budget };
            let is_marked = |pose: &Isometry3<f64>| supports(&self.body, &self.decoded, pose);
            aligner.find(&sought, is_marked, self.confirmed.as_ref(), &mut tried)
        });
        let decision = decision.unwrap_or_default();
        (self.trial.decision, self.trial.hypotheses) = (decision, tried);
        self.trial
    }
}

#[cfg(test)]
mod tests;
