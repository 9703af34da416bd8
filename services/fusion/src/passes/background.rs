//! The background pass: what takes several times as long as the other passes.
//!
//! A target that is not where its track predicts it may be found from rougher starts, or by a search
//! round the prediction. A target without a track may be found by trying whatever its markers may mean.
//! On two busy processors starts take 20 to 70 ms and the search 60 to 150, and nobody else's pose
//! should wait for that. So these passes run beside the others, one at a time. A request is refused
//! while another is under way, because a newer frame will ask again. Only an untracked target may queue
//! behind a tracked one: no newer frame need show anything of it for a while.

use flockeye_contract::FrameOrder;
use std::collections::BTreeSet;

use flockeye_geometry::body::Body;
use flockeye_geometry::pose::CornerRay;
use flockeye_geometry::view::View;
use flockeye_imaging::align::{Motion, Picture};
use flockeye_imaging::image::LumaImage;
use flockeye_imaging::light::LinearLight;
use nalgebra::Isometry3;

use super::inputs::{Inputs, searched};
use crate::account::{Notes, Pass, Source, Trial};
use crate::hypothesis::{Aligner, Sought, Start, precise_or_else};
use crate::measurement::{Measurement, distinct_markers, supports};
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
    /// The target's pose, if it was found.
    pub measurement: Option<Measurement>,
    /// Whether it was found without the prior of a track, so that it may start one.
    pub is_independent: bool,
    /// The distance that the view's rays are right for, metres.
    pub rays_m: f64,
    /// How it was measured, where somebody asks.
    pub trial: Option<Box<Trial>>,
}

/// Which background passes are under way, wait, or were refused. It holds no thread: whoever runs
/// [`BackgroundQueue::take_job`] gives the answer back to [`BackgroundQueue::finish`].
#[derive(Debug, Default)]
pub struct BackgroundQueue {
    under_way: Option<UnderWay>,
    /// The target whose passes are to be accounted for.
    noted: Option<usize>,
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
    /// Asks for a pass, and says whether it is granted. It is not while another is under way, but an
    /// untracked target may queue behind a tracked one. A target that had the last pass goes behind those
    /// that were refused meanwhile.
    pub fn request(&mut self, subject: Subject, inputs: &Inputs<'_>) -> bool {
        let target = subject.target;
        if let Some(under_way) = &self.under_way {
            if under_way.subject.target != target {
                let is_untracked = inputs.prior.predicted().is_none();
                if is_untracked && !under_way.is_untracked && self.waiting.is_none() {
                    self.waiting = self.job(subject, inputs);
                    return self.waiting.is_some();
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
        let job = self.job(subject, inputs);
        let is_granted = job.is_some();
        job.into_iter().for_each(|job| self.start(job));
        is_granted
    }

    fn job(&self, subject: Subject, inputs: &Inputs<'_>) -> Option<Job> {
        let mut job = Job::new(subject, inputs)?;
        if self.noted == Some(subject.target) {
            job.trial = Some(Box::new(inputs.trial(Pass::Background)));
        }
        Some(job)
    }

    /// Has the passes of a target say what they do.
    pub fn keep_account(&mut self, target: usize) {
        self.noted = Some(target);
    }

    fn start(&mut self, job: Job) {
        let (subject, is_untracked) = (job.subject, job.is_untracked);
        self.refused.remove(&subject.target);
        self.last = Some(subject.target);
        self.under_way = Some(UnderWay { subject, is_untracked, is_cancelled: false });
        self.to_run = Some(job);
    }

    /// Whether a job is to be run now.
    pub fn has_job(&self) -> bool {
        self.to_run.is_some()
    }

    /// The job that is to be run now, once.
    pub fn take_job(&mut self) -> Option<Job> {
        self.to_run.take()
    }

    /// Cancels what is under way for a target in a frame, because the target was measured there. A job
    /// of that target that waits is dropped too: it waited because the target had no track.
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

    /// Takes the answer to the job that was under way, and starts the one that waits. `None` if the pass
    /// was cancelled meanwhile.
    pub fn finish(&mut self, answer: Answer) -> Option<Answer> {
        let is_cancelled = self.under_way.take().is_none_or(|under_way| under_way.is_cancelled);
        if let Some(next) = self.waiting.take() {
            self.start(next);
        }
        (!is_cancelled).then_some(answer)
    }
}

/// All that a background pass needs, copied, so that its view can be released.
#[derive(Debug)]
pub struct Job {
    subject: Subject,
    is_untracked: bool,
    body: Body,
    decoded: Vec<CornerRay>,
    starts: Vec<(Source, Start)>,
    /// Where its passes are accounted for.
    trial: Option<Box<Trial>>,
    /// The prediction of a confirmed track.
    confirmed: Option<Isometry3<f64>>,
    /// The prediction that is searched round if no start leads to the body.
    search_round: Option<Isometry3<f64>>,
    pixels: Vec<u8>,
    size: (usize, usize),
    view: View,
    light: LinearLight,
    pixels_per_radian: f64,
    motion: Motion,
    rays_m: f64,
}

impl Job {
    /// `None` where there is no view.
    fn new(subject: Subject, inputs: &Inputs<'_>) -> Option<Self> {
        let best = inputs.best_view?;
        let image = best.picture.image;
        let mut pixels = Vec::with_capacity(image.width() * image.height());
        (0..image.height()).for_each(|y| pixels.extend_from_slice(image.row(y)));
        let predicted = inputs.prior.predicted().copied();
        Some(Self {
            subject,
            is_untracked: predicted.is_none(),
            body: inputs.body.clone(),
            decoded: inputs.decoded.clone(),
            starts: inputs.background_starts(),
            trial: None,
            confirmed: inputs.prior.confirmed().map(|prior| prior.camera_from_markers),
            search_round: predicted.filter(|_| inputs.permit.may_search),
            pixels,
            size: (image.width(), image.height()),
            view: best.picture.view,
            light: best.picture.light.clone(),
            pixels_per_radian: best.picture.pixels_per_radian,
            motion: best.picture.motion,
            rays_m: best.rays_m,
        })
    }

    /// Runs the pass.
    pub fn run(mut self, aligner: &Aligner) -> Answer {
        let mut trial = self.trial.take();
        let notes = Notes::into_list(trial.as_mut().map(|trial| &mut trial.hypotheses));
        let (measurement, is_independent) = self.measure(aligner, notes).unzip();
        Answer {
            subject: self.subject,
            measurement,
            is_independent: is_independent.unwrap_or_default(),
            rays_m: self.rays_m,
            trial,
        }
    }

    /// The target's pose, and whether it was found without the prior of a track.
    fn measure(&self, aligner: &Aligner, mut notes: Notes<'_>) -> Option<(Measurement, bool)> {
        let (width, height) = self.size;
        let picture = Picture {
            image: LumaImage::new(&self.pixels, width, height, width).ok()?,
            view: self.view,
            light: &self.light,
            pixels_per_radian: self.pixels_per_radian,
            motion: self.motion,
        };
        let (target, starts, budget) = (self.subject.target, &self.starts, TimeBudget::OneFrame);
        let sought = Sought { target, picture: &picture, starts, budget };
        let is_marked = |pose: &Isometry3<f64>| supports(&self.body, &self.decoded, pose);
        let found = match &self.confirmed {
            Some(predicted) => aligner.confirm(&sought, predicted, is_marked, &mut notes),
            None => aligner.initiate(&sought, is_marked, &mut notes),
        };
        let is_independent = self.confirmed.is_none() && found.is_some();
        let search = || {
            let found = aligner.reacquire(target, &picture, self.search_round.as_ref()?);
            notes.note(|| searched(found.clone()));
            found
        };
        let found = precise_or_else(found, search)?;
        Some((Measurement::aligned(&found, distinct_markers(&self.decoded)), is_independent))
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use crate::hypothesis::BestView;
    use crate::passes::inputs::{Earlier, Permit};
    use crate::track_prior::TrackPrior;
    use flockeye_geometry::body::squares;
    use flockeye_geometry::pose::PosePrior;
    use flockeye_imaging::light::{CodeRange, TransferCurve};
    use nalgebra::{Matrix6, Vector3};

    /// Requests passes over an empty picture, for a tracked target or an untracked one.
    fn with_requests(
        by: impl FnOnce(&mut BackgroundQueue, &dyn Fn(&mut BackgroundQueue, usize, bool) -> bool),
    ) {
        let body = squares("alpha", 0.0625, 0.05, 0);
        let (pixels, light) =
            ([128; 64 * 64], LinearLight::new(TransferCurve::Srgb, CodeRange::Full).unwrap());
        let image = LumaImage::new(&pixels, 64, 64, 64).unwrap();
        let view = View::looking_at(&Vector3::x_axis(), 0.5, 64);
        let picture = Picture::still(image, view, &light, 611.0);
        let camera_from_markers = Isometry3::translation(1.0, 0.0, 0.0);
        let covariance = Matrix6::identity();
        let request = |queue: &mut BackgroundQueue, target: usize, is_tracked: bool| {
            let inputs = Inputs {
                target,
                body: &body,
                decoded: Vec::new(),
                candidates: Vec::new(),
                rays_m: f64::INFINITY,
                prior: match is_tracked {
                    true => TrackPrior::Confirmed(PosePrior { camera_from_markers, covariance }),
                    false => TrackPrior::Untracked,
                },
                best_view: Some(BestView {
                    picture,
                    view_index: 0,
                    agreeing: 0,
                    rays_m: f64::INFINITY,
                }),
                permit: Permit {
                    budget: TimeBudget::OneFrame,
                    is_deferred: true,
                    may_search: false,
                    min_markers: 1,
                },
                earlier: Earlier::default(),
            };
            queue.request(subject(target), &inputs)
        };
        by(&mut BackgroundQueue::default(), &request);
    }

    fn subject(target: usize) -> Subject {
        Subject { order: (0, 0, 0), at_s: 0.0, target }
    }

    fn nothing_found(subject: Subject) -> Answer {
        let rays_m = f64::INFINITY;
        Answer { subject, measurement: None, is_independent: false, rays_m, trial: None }
    }

    /// Ends what is under way without having found anything.
    fn finish(queue: &mut BackgroundQueue) {
        let subject = queue.take_job().expect("a job is under way").subject;
        drop(queue.finish(nothing_found(subject)));
    }

    fn under_way(queue: &BackgroundQueue) -> Option<Subject> {
        queue.under_way.as_ref().map(|under_way| under_way.subject)
    }

    #[test]
    fn passes_run_one_at_a_time_and_refused_targets_go_first() {
        with_requests(|queue, request| {
            let request = |queue: &mut BackgroundQueue, target| request(queue, target, true);
            assert!(request(queue, 0));
            assert!(!request(queue, 1) && !request(queue, 0), "one is under way");
            finish(queue);
            assert!(!request(queue, 0), "1 goes first");
            assert!(request(queue, 1));
            finish(queue);
            assert!(request(queue, 1), "nobody else asked");
            assert!(!request(queue, 0));
            finish(queue);
            assert!(!request(queue, 1));
            assert!(request(queue, 1), "0 was left the place once and did not take it");
        });
    }

    #[test]
    fn an_untracked_target_queues_behind_a_tracked_one() {
        with_requests(|queue, request| {
            assert!(request(queue, 0, true));
            assert!(request(queue, 1, false), "there is a place for one");
            assert!(!request(queue, 2, false) && !request(queue, 3, true));
            finish(queue);
            assert_eq!(under_way(queue), Some(subject(1)));
            finish(queue);
            // Untracked targets do not queue behind each other: a tracked one would never get a turn.
            assert!(request(queue, 2, false));
            assert!(!request(queue, 1, false) && !request(queue, 3, true));
            finish(queue);
            // Another frame measured it before its turn came.
            assert!(request(queue, 3, true));
            assert!(request(queue, 1, false));
            queue.cancel((0, 0, 1), 1);
            finish(queue);
            assert_eq!(under_way(queue), None);
        });
    }

    #[test]
    fn the_answer_of_a_cancelled_pass_is_dropped() {
        with_requests(|queue, request| {
            assert!(request(queue, 0, true));
            let answer = |queue: &mut BackgroundQueue| {
                nothing_found(queue.take_job().expect("a job").subject)
            };
            let first = answer(queue);
            assert!(queue.take_job().is_none(), "a job is run once");
            queue.cancel((0, 0, 0), 0);
            assert_eq!(queue.awaited(), None);
            assert!(queue.finish(first).is_none());
            assert!(request(queue, 0, true));
            let second = answer(queue);
            queue.cancel((0, 0, 7), 0);
            assert!(queue.finish(second).is_some(), "it was measured in another frame");
        });
    }
}
