//! The core of rectification: frames, plans and answers with their times in, orders to cut views and
//! frame ends out. It holds no port, no clock and no thread.
//!
//! [`Core::on`] notes an event. [`Core::step`] says what to do next; it is called again until it says
//! that there is nothing to do. The pixels stay in the core's hold `F` on a frame, which it never looks
//! into.

use std::collections::BTreeSet;
use std::time::Duration;

use flockeye_config::{Flow, Resolved};
use flockeye_contract::{
    DetectionHeader, FrameEnd, FrameHeader, FrameOrder, PlanHeader, PlannedView, StopReason,
    StopRule,
};
use flockeye_geometry::view::View;

use crate::dispatch::{Answer, Dispatcher};
use crate::frame_clock::FrameClock;
use crate::job::{Job, Next, sweep};

/// A plan older than this is not followed: fusion has died since. Nanoseconds.
const STALE_PLAN_NS: i64 = 1_000_000_000;

/// Frames held at once: one that waits for its answers, and the one that is being cut.
const MAX_HELD_FRAMES: usize = 2;

/// A frame, and the place of a view in its plan.
type ViewKey = (FrameOrder, u32);

/// What happens to rectification.
#[derive(Debug)]
pub enum Event<F> {
    /// A frame has come; `F` holds its pixels.
    Frame(FrameHeader, F),
    /// A plan has come.
    Plan(PlanHeader, Vec<PlannedView>),
    /// A worker has searched a view.
    Answer(DetectionHeader),
    /// A view that was ordered has been published.
    Published {
        /// The order.
        order: CutOrder,
        /// How long cutting took, nanoseconds.
        took_ns: i64,
    },
    /// The places of a frame's proposals were found.
    Looked {
        /// How long that took, nanoseconds.
        took_ns: i64,
    },
    /// A view that was ordered could not be cut.
    CutFailed(CutOrder),
    /// The frame that was taken up cannot be cut at all.
    Refused(FrameOrder),
}

/// A view to be cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CutOrder {
    /// The frame.
    pub frame: FrameOrder,
    /// The view's place in the plan.
    pub view_index: u32,
    /// The worker that it goes to.
    pub worker: usize,
    /// How often it was cut before.
    pub attempt: u32,
}

/// What is to be done.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Action {
    /// A frame was taken up: its likely views ([`Held::likely`]) may be worked on ahead.
    TakeUp(FrameOrder),
    /// Cut this view and publish it.
    Cut(CutOrder),
    /// Publish the end of a frame.
    End(FrameEnd),
    /// Nothing, until an event comes, or by then, nanoseconds.
    Wait(Option<i64>),
}

/// A frame that is being cut, or that waits for the answers to its views.
#[derive(Debug)]
pub struct Held<F> {
    /// The hold on its pixels.
    pub pixels: F,
    /// Its views.
    pub job: Job,
    /// Views that the back end was told of.
    pub ordered: BTreeSet<u32>,
    /// Views that will probably be cut.
    pub likely: Vec<u32>,
}

/// How a core works.
#[derive(Debug, Clone)]
pub struct Options {
    /// How frames flow.
    pub flow: Flow,
    /// How often this stage was replaced.
    pub generation: u32,
    /// How many detection workers there are.
    pub workers: usize,
    /// Views in flight for each of them.
    pub window: usize,
    /// After how long a worker's views are given to others.
    pub overdue: Duration,
}

/// What rectification keeps between events.
#[derive(Debug)]
pub struct Core<F> {
    options: Options,
    clock: FrameClock,
    dispatcher: Dispatcher<ViewKey>,
    /// Partitions of which the camera sees something, with their numbers.
    partitions: Vec<(u32, View)>,
    /// Partitions of its own sweep that were cut.
    swept: usize,
    /// Tiles that were cut of the frame that ended last.
    searched: usize,
    plan: Option<(PlanHeader, Vec<PlannedView>)>,
    waiting: Option<(FrameHeader, F)>,
    held: Vec<Held<F>>,
    last_frame_ns: i64,
}

impl<F> Core<F> {
    /// The core that a configuration asks for, at `now_ns`.
    ///
    /// # Errors
    /// A mask that cannot be read.
    pub fn of(resolved: &Resolved, generation: u32, now_ns: i64) -> anyhow::Result<Self> {
        let pipeline = &resolved.pipeline;
        let mask = resolved.mask()?;
        let views = (0..).zip(resolved.partition_views.iter().copied());
        let options = Options {
            flow: pipeline.flow(),
            generation,
            workers: pipeline.detection_workers() as usize,
            window: pipeline.rectification.window as usize,
            overdue: pipeline.view_overdue(),
        };
        let partitions = views.filter(|(_, view)| !mask.hides_view(view)).collect();
        Ok(Self::new(options, FrameClock::of(pipeline), partitions, now_ns))
    }

    /// A core that has heard of no frame yet. Without plans it sweeps `partitions`.
    pub fn new(
        options: Options,
        clock: FrameClock,
        partitions: Vec<(u32, View)>,
        now_ns: i64,
    ) -> Self {
        let dispatcher =
            Dispatcher::new(options.workers, options.window).with_probe_after(options.overdue / 2);
        Self {
            options,
            clock,
            dispatcher,
            partitions,
            swept: 0,
            searched: 0,
            plan: None,
            waiting: None,
            held: Vec::new(),
            last_frame_ns: now_ns,
        }
    }

    /// Whether a frame waits. A lossless run takes none before it is taken up.
    pub fn has_waiting(&self) -> bool {
        self.waiting.is_some()
    }

    /// The frame that waits.
    pub fn waiting(&self) -> Option<&(FrameHeader, F)> {
        self.waiting.as_ref()
    }

    /// Views in flight.
    pub fn outstanding(&self) -> usize {
        self.dispatcher.outstanding()
    }

    /// The workers that have answered nothing for too long, as [`Dispatcher::silent`] tells them.
    pub fn silent_workers(&mut self) -> Vec<(usize, u64)> {
        self.dispatcher.silent()
    }

    /// A frame that is held.
    pub fn held_mut(&mut self, frame: FrameOrder) -> Option<&mut Held<F>> {
        self.held.iter_mut().find(|held| held.job.frame.stamp.order() == frame)
    }

    /// For how long no frame has come, nanoseconds.
    pub fn silence_ns(&self, now_ns: i64) -> i64 {
        if self.waiting.is_some() || !self.held.is_empty() {
            0
        } else {
            now_ns - self.last_frame_ns
        }
    }

    /// Notes an event that came at `now_ns`, and says whether a frame was dropped: in flight a newer one
    /// takes the place of one that waits.
    pub fn on(&mut self, event: Event<F>, now_ns: i64) -> bool {
        match event {
            Event::Frame(header, pixels) => {
                self.last_frame_ns = now_ns;
                self.clock.note_arrival(&header.stamp, now_ns);
                return self.waiting.replace((header, pixels)).is_some();
            }
            Event::Plan(header, views) => self.plan = Some((header, views)),
            Event::Answer(header) => self.on_answer(&header, now_ns),
            Event::Published { order, took_ns } => self.on_published(order, took_ns, now_ns),
            Event::Looked { took_ns } => self.clock.note_look(took_ns),
            Event::CutFailed(order) => {
                if let Some(held) = self.held_mut(order.frame) {
                    held.job.fail();
                }
            }
            Event::Refused(frame) => {
                if let Some(held) = self.held_mut(frame) {
                    held.job.fail();
                }
            }
        }
        false
    }

    fn on_answer(&mut self, header: &DetectionHeader, now_ns: i64) {
        let key = (header.stamp.order(), header.view_index);
        let (worker, attempt) = (header.worker as usize, header.attempt);
        let answer = self.dispatcher.acknowledged(key, worker, attempt, time(now_ns));
        if answer == Answer::First
            && let Some(held) = self.held_mut(key.0)
        {
            held.job.note_answer(header.view_index, header.hits > 0);
            if held.job.is_tile(header.view_index) {
                self.clock.note_search(header.sent_ns.saturating_sub(header.received_ns));
            }
        }
    }

    fn on_published(&mut self, order: CutOrder, took_ns: i64, now_ns: i64) {
        let CutOrder { frame, view_index, worker, .. } = order;
        self.dispatcher.issued((frame, view_index), worker, time(now_ns));
        let held = self.held.iter_mut().find(|held| held.job.frame.stamp.order() == frame);
        let Some(held) = held else { return };
        if let Some((_, planned)) = held.job.view(view_index) {
            self.clock.note_cut(&planned, took_ns);
        }
        held.job.note_issued(view_index);
    }

    /// What to do next.
    pub fn step(&mut self, now_ns: i64) -> Action {
        for (frame, index) in self.dispatcher.overdue(time(now_ns), self.options.overdue) {
            match self.held_mut(frame) {
                Some(held) => held.job.take_back(index),
                // The frame has made room for a newer one: nobody needs its view any more.
                None => self.dispatcher.retain(|(other, _)| other != frame),
            }
        }
        self.held.retain(|held| !held.job.is_done());
        if let Some(frame) = self.take_up(now_ns) {
            return Action::TakeUp(frame);
        }
        if let Some(action) = self.cut_next(now_ns) {
            return action;
        }
        // A worker that answers nothing must be noticed.
        let overdue_ns = self.options.overdue.as_nanos() as i64;
        let is_awaited = !self.held.is_empty() || self.outstanding() > 0;
        Action::Wait(is_awaited.then_some(now_ns + overdue_ns / 4))
    }

    /// Takes up the frame that waits, once the one before has been cut.
    fn take_up(&mut self, now_ns: i64) -> Option<FrameOrder> {
        let is_cutting = self.held.iter().any(|held| !held.job.has_ended());
        if is_cutting || self.waiting.is_none() {
            return None;
        }
        if self.held.len() >= MAX_HELD_FRAMES {
            if self.options.flow == Flow::Lossless {
                return None;
            }
            // In flight a newer frame is worth more than a view of an old one that its worker may have lost.
            // Answers that still come are heard all the same.
            self.held.remove(0);
        }
        let (header, pixels) = self.waiting.take()?;
        self.clock.begin_frame(&header.stamp);
        let job = self.job_for(header, now_ns);
        let likely = job.likely(self.searched);
        self.held.push(Held { pixels, job, ordered: BTreeSet::new(), likely });
        Some(header.stamp.order())
    }

    fn job_for(&self, header: FrameHeader, now_ns: i64) -> Job {
        let is_live = |plan: &PlanHeader| {
            self.options.flow == Flow::Lossless || now_ns - plan.made_ns < STALE_PLAN_NS
        };
        if let Some((plan, views)) = self.plan.as_ref().filter(|(plan, _)| is_live(plan)) {
            // It was checked when it was received, so its rule is known.
            let rule = StopRule::try_from(plan.stop_rule).unwrap_or(StopRule::Deadline);
            let budget = match self.clock.is_unlimited() {
                true => plan.view_budget as usize,
                false => usize::MAX,
            };
            return Job::new(header, plan.plan_id, views.clone(), rule, budget, now_ns);
        }
        let views = sweep(&self.partitions, self.swept);
        Job::new(header, 0, views, StopRule::Deadline, usize::MAX, now_ns)
    }

    /// The next view to be cut, or a frame's end. `None` if there is nothing to do before something comes.
    fn cut_next(&mut self, now_ns: i64) -> Option<Action> {
        for position in 0..self.held.len() {
            let job = &self.held[position].job;
            let is_newer_waiting = self.waiting.is_some();
            let why_over =
                self.clock.why_over(job.upcoming(), job.searched(), is_newer_waiting, now_ns);
            match job.next(why_over) {
                Next::Wait => {}
                Next::End(reason) => {
                    if let Some(end) = self.end(position, reason, now_ns) {
                        return Some(Action::End(end));
                    }
                    return self.cut_next(now_ns);
                }
                Next::Cut { index, is_yielding } => {
                    let Some(worker) = self.dispatcher.next_worker(time(now_ns)) else { continue };
                    let (outstanding, workers) = (self.outstanding(), self.options.workers);
                    if is_yielding && !self.clock.has_room_for_tile(outstanding, workers, now_ns) {
                        continue;
                    }
                    let frame = job.frame.stamp.order();
                    let attempt = self.dispatcher.next_attempt((frame, index));
                    return Some(Action::Cut(CutOrder {
                        frame,
                        view_index: index,
                        worker,
                        attempt,
                    }));
                }
            }
        }
        None
    }

    /// Ends a frame. `None` if its end is out already, and a view of it could not be cut again.
    fn end(&mut self, position: usize, reason: StopReason, now_ns: i64) -> Option<FrameEnd> {
        let job = &mut self.held[position].job;
        if job.has_ended() {
            // Nobody needs to wait for the answer.
            let given_up = job.frame.stamp.order();
            self.dispatcher.retain(|(frame, _)| frame != given_up);
            self.held.remove(position);
            return None;
        }
        self.searched = job.searched();
        self.clock.end_frame(self.searched);
        if job.plan_id == 0 {
            self.swept = (self.swept + job.tally().0 as usize) % self.partitions.len().max(1);
        }
        Some(ended(job, reason, self.options.generation, now_ns))
    }

    /// The ends of all frames that have none, because the stage stops.
    pub fn shut_down(&mut self, now_ns: i64) -> Vec<FrameEnd> {
        let open = self.held.iter_mut().filter(|held| !held.job.has_ended());
        let generation = self.options.generation;
        open.map(|held| ended(&mut held.job, StopReason::Shutdown, generation, now_ns)).collect()
    }
}

fn ended(job: &mut Job, reason: StopReason, generation: u32, now_ns: i64) -> FrameEnd {
    let (views_issued, views_abandoned) = job.tally();
    job.note_end(reason);
    FrameEnd {
        stamp: job.frame.stamp,
        plan_id: job.plan_id,
        taken_ns: job.taken_ns,
        ended_ns: now_ns,
        views_issued,
        views_abandoned,
        reason: reason.code(),
        generation,
    }
}

fn time(now_ns: i64) -> Duration {
    Duration::from_nanos(now_ns.unsigned_abs())
}

#[cfg(test)]
mod tests;
