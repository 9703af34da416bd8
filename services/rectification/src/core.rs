//! The core of rectification. Input: frames, plans and answers with their times. Output: orders to
//! cut views, and frame ends. It has no port, no clock and no thread.
//!
//! [`Core::on`] takes an event. [`Core::step`] returns the next action; call it until it returns
//! [`Action::Wait`]. An `F` owns a frame's pixels, which the core never reads.

mod active_frame;
mod events;

use std::time::Duration;

use flockeye_config::{Flow, Resolved};
use flockeye_contract::{
    DetectionHeader, FrameEnd, FrameHeader, FrameOrder, PlanHeader, PlannedView, StopReason,
    StopRule, Transfer, ViewHeader,
};
use flockeye_geometry::camera::Camera;
use flockeye_geometry::search::MAX_FRAMES_WITHOUT_TILE;
use flockeye_geometry::view::View;
use flockeye_imaging::proposals::Proposal;

use self::active_frame::ActiveFrame;
pub use self::events::{Action, CutOrder, Event};
use crate::dispatch::Dispatcher;
use crate::frame_clock::FrameClock;
use crate::job::{FrameJob, NextView, sweep};
use crate::proposals::ProposalChooser;

/// Age from which a plan is ignored, nanoseconds: fusion has failed since.
const STALE_PLAN_NS: i64 = 1_000_000_000;

/// Maximum number of active frames: one that waits for answers, and one that is being cut.
const MAX_ACTIVE_FRAMES: usize = 2;

/// Key of a view: the frame, and the index in its plan.
type ViewKey = (FrameOrder, u32);

/// State of rectification between events.
#[derive(Debug)]
pub struct Core<F> {
    flow: Flow,
    /// Generation: number of restarts of this stage.
    generation: u32,
    /// Number of detection workers.
    workers: usize,
    /// Timeout after which a worker's views are given to other workers.
    overdue: Duration,
    camera: Camera,
    clock: FrameClock,
    dispatcher: Dispatcher<ViewKey>,
    proposals: ProposalChooser,
    /// Tiles that are not fully masked, with their numbers.
    tiles: Vec<(u32, View)>,
    /// Position of the own sweep: number of its cut tiles.
    swept: usize,
    /// Number of cut tiles of the frame that ended last.
    searched: usize,
    /// Number of consecutive frames without a cut tile.
    frames_without_tile: u64,
    plan: Option<(PlanHeader, Vec<PlannedView>)>,
    /// The waiting frame. A lossless run receives no further frame until this one is active.
    pub(crate) waiting: Option<(FrameHeader, F)>,
    active: Vec<ActiveFrame<F>>,
    /// The view, and its worker, to cut after the proposal search.
    next_cut: Option<(ViewKey, usize)>,
    last_frame_ns: i64,
}

impl<F> Core<F> {
    /// The core for a configuration, at `now_ns`, before its first frame. Without plans it sweeps
    /// the partition's tiles.
    pub fn of(resolved: &Resolved, generation: u32, now_ns: i64) -> anyhow::Result<Self> {
        let pipeline = &resolved.pipeline;
        let mask = resolved.mask()?;
        let views = (0..).zip(resolved.partition_views.iter().copied());
        let workers = pipeline.detection_workers() as usize;
        let window = pipeline.rectification.window as usize;
        let overdue = pipeline.view_overdue();
        Ok(Self {
            flow: pipeline.flow(),
            generation,
            workers,
            overdue,
            camera: resolved.camera,
            clock: FrameClock::of(pipeline),
            dispatcher: Dispatcher::new(workers, window, overdue / 2),
            proposals: ProposalChooser::of(resolved)?,
            tiles: views.filter(|(_, view)| !mask.hides_view(view)).collect(),
            swept: 0,
            searched: 0,
            frames_without_tile: 0,
            plan: None,
            waiting: None,
            active: Vec::new(),
            next_cut: None,
            last_frame_ns: now_ns,
        })
    }

    /// Number of views in flight.
    pub(crate) fn outstanding(&self) -> usize {
        self.dispatcher.outstanding()
    }

    /// Workers with a timeout; see [`Dispatcher::silent`].
    pub(crate) fn silent_workers(&mut self) -> Vec<(usize, u64)> {
        self.dispatcher.silent()
    }

    /// The header and the pixels' owner of an active frame.
    pub fn frame(&self, frame: FrameOrder) -> Option<(&FrameHeader, &F)> {
        let active = self.active.iter().find(|active| active.order() == frame)?;
        Some((&active.job.frame, &active.pixels))
    }

    /// Time without a frame, nanoseconds.
    pub(crate) fn silence_ns(&self, now_ns: i64) -> i64 {
        if self.waiting.is_some() || !self.active.is_empty() {
            0
        } else {
            now_ns - self.last_frame_ns
        }
    }

    /// Takes an event of time `now_ns`. Returns whether a frame was dropped: in flight, a newer
    /// frame replaces the waiting one.
    pub fn on(&mut self, event: Event<F>, now_ns: i64) -> bool {
        match event {
            Event::Frame(header, pixels) => {
                self.last_frame_ns = now_ns;
                self.clock.note_arrival(&header.stamp, now_ns);
                return self.waiting.replace((header, pixels)).is_some();
            }
            Event::Plan(header, views) => self.plan = Some((header, views)),
            Event::Answer(header) => self.on_answer(&header, now_ns),
            Event::Looked { frame, found, took_ns } => self.on_looked(frame, found, took_ns),
            Event::Published { header, took_ns } => self.on_published(&header, took_ns, now_ns),
            Event::Failed(frame) => {
                self.next_cut = None;
                if let Some(active) = active_in(&mut self.active, frame) {
                    active.job.has_failed = true;
                }
            }
        }
        false
    }

    fn on_answer(&mut self, header: &DetectionHeader, now_ns: i64) {
        let key = (header.stamp.order(), header.view_index);
        let (worker, attempt) = (header.worker as usize, header.attempt);
        if self.dispatcher.note_answer(key, worker, attempt, time(now_ns))
            && let Some(ActiveFrame { job, .. }) = active_in(&mut self.active, key.0)
        {
            job.note_answer(header.view_index, header.hits > 0);
            if job.is_tile(header.view_index) {
                self.clock.note_search(header.sent_ns.saturating_sub(header.received_ns));
            }
        }
    }

    /// Assigns the found places to the frame's proposals.
    fn on_looked(&mut self, frame: FrameOrder, found: Vec<Proposal>, took_ns: i64) {
        let Some(active) = active_in(&mut self.active, frame) else { return };
        let views = active.job.proposal_indices().len();
        active.job.place_proposals(self.proposals.choose(found, views));
        self.clock.note_look(took_ns);
    }

    fn on_published(&mut self, header: &ViewHeader, took_ns: i64, now_ns: i64) {
        let (frame, index) = (header.stamp.order(), header.view_index);
        self.dispatcher.issued((frame, index), header.worker as usize, time(now_ns));
        let Some(ActiveFrame { job, .. }) = active_in(&mut self.active, frame) else { return };
        if let Some((_, planned)) = job.view(index) {
            self.clock.note_cut(&planned, took_ns);
        }
        if let Some(proposal) = job.proposal(index) {
            self.proposals.note_cut(proposal);
        }
        job.note_issued(index);
    }

    /// The next action.
    pub fn step(&mut self, now_ns: i64) -> Action {
        if let Some((key, worker)) = self.next_cut.take()
            && let Some(order) = self.cut_placed(key, worker)
        {
            return Action::Cut(order);
        }
        for (frame, index) in self.dispatcher.overdue(time(now_ns), self.overdue) {
            match active_in(&mut self.active, frame) {
                Some(active) => active.job.take_back(index),
                // The frame was replaced by a newer one: its view is not needed.
                None => self.dispatcher.retain(|(other, _)| other != frame),
            }
        }
        self.active.retain(|active| !active.job.is_done());
        if let Some(action) = self.take_up(now_ns) {
            return action;
        }
        if let Some(action) = self.cut_next(now_ns) {
            return action;
        }
        // Wake up to check the workers' timeouts.
        let overdue_ns = self.overdue.as_nanos() as i64;
        let is_awaited = !self.active.is_empty() || self.outstanding() > 0;
        Action::Wait(is_awaited.then_some(now_ns + overdue_ns / 4))
    }

    /// Makes the waiting frame active when the frame before it has been cut.
    fn take_up(&mut self, now_ns: i64) -> Option<Action> {
        let is_cutting = self.active.iter().any(|active| !active.job.has_ended());
        if is_cutting || self.waiting.is_none() {
            return None;
        }
        if self.active.len() >= MAX_ACTIVE_FRAMES {
            if self.flow == Flow::Lossless {
                return None;
            }
            // In flight, a newer frame has priority over an old frame with a view that may be lost.
            // Late answers are still counted.
            self.active.remove(0);
        }
        let (header, pixels) = self.waiting.take()?;
        self.clock.begin_frame(&header.stamp);
        let job = self.job_for(header, now_ns);
        let likely = job.likely(self.searched);
        let mut active = ActiveFrame::new(job, pixels);
        let likely = active.announce(likely, &self.camera);
        self.active.push(active);
        Some(Action::TakeUp { frame: header.stamp.order(), likely })
    }

    fn job_for(&self, mut header: FrameHeader, now_ns: i64) -> FrameJob {
        let is_live = |plan: &PlanHeader| {
            self.flow == Flow::Lossless || now_ns - plan.made_ns < STALE_PLAN_NS
        };
        if let Some((plan, views)) = self.plan.as_ref().filter(|(plan, _)| is_live(plan)) {
            if plan.gamma > 0.0 {
                (header.transfer, header.gamma) = (Transfer::Gamma.code(), plan.gamma);
            }
            // The plan was checked when it was received, so its rule is valid.
            let rule = StopRule::try_from(plan.stop_rule).unwrap_or(StopRule::Deadline);
            let budget = match self.clock.is_unlimited() {
                true => plan.view_budget as usize,
                false => usize::MAX,
            };
            return FrameJob::new(header, plan.plan_id, views.clone(), rule, budget, now_ns);
        }
        let views = sweep(&self.tiles, self.swept);
        FrameJob::new(header, 0, views, StopRule::Deadline, usize::MAX, now_ns)
    }

    /// The next view to cut, or a frame's end. `None` if the next action needs an event.
    fn cut_next(&mut self, now_ns: i64) -> Option<Action> {
        for position in 0..self.active.len() {
            let job = &self.active[position].job;
            let is_newer_waiting = self.waiting.is_some();
            let next = job.upcoming();
            // After several frames without a tile, one tile is cut without a time limit. Plans then
            // have a tile before the proposals.
            let is_tile_due = job.searched() == 0
                && self.frames_without_tile >= MAX_FRAMES_WITHOUT_TILE
                && next.is_some_and(|(view, _)| view.is_tile());
            let why_over = self.clock.why_over(next, is_newer_waiting, now_ns);
            let why_over = why_over.filter(|_| !is_tile_due);
            match job.next(why_over) {
                NextView::Wait => {}
                NextView::End(reason) => {
                    if let Some(end) = self.end(position, reason, now_ns) {
                        return Some(Action::End(end));
                    }
                    return self.cut_next(now_ns);
                }
                NextView::Cut { index, is_yielding } => {
                    let Some(worker) = self.dispatcher.next_worker(time(now_ns)) else { continue };
                    let (outstanding, workers) = (self.outstanding(), self.workers);
                    if is_yielding && !self.clock.has_room_for_tile(outstanding, workers, now_ns) {
                        continue;
                    }
                    return self.cut(position, index, worker);
                }
            }
        }
        None
    }

    /// Cuts a view for a worker. The proposal search comes before the first proposal's cut. Views
    /// of tracked neighbours are cut before, so no pose waits for it.
    fn cut(&mut self, position: usize, index: u32, worker: usize) -> Option<Action> {
        let active = &self.active[position];
        let (frame, job) = (active.order(), &active.job);
        if job.awaits_places() && job.proposal(index).is_some() {
            match self.proposals.search(job.proposal_indices().len()) {
                Some(search) => {
                    self.next_cut = Some(((frame, index), worker));
                    return Some(Action::Look { frame, search });
                }
                None => self.on_looked(frame, Vec::new(), 0),
            }
        }
        self.cut_order((frame, index), worker).map(Action::Cut)
    }

    /// The order to cut a frame's first proposal, after the proposal search.
    fn cut_placed(&mut self, key: ViewKey, worker: usize) -> Option<CutOrder> {
        let active = active_in(&mut self.active, key.0)?;
        let ahead = active.announce(active.job.proposal_indices(), &self.camera);
        let order = self.cut_order(key, worker)?;
        Some(CutOrder { ahead, ..order })
    }

    fn cut_order(&mut self, (frame, index): ViewKey, worker: usize) -> Option<CutOrder> {
        let attempt = self.dispatcher.next_attempt((frame, index));
        let generation = self.generation;
        let order = active_in(&mut self.active, frame)?.cut_order(index, &self.camera)?;
        let header = ViewHeader { worker: worker as u32, attempt, generation, ..order.header };
        Some(CutOrder { header, ..order })
    }

    /// Ends a frame. `None` if its end was sent before, and a repeated cut has failed.
    fn end(&mut self, position: usize, reason: StopReason, now_ns: i64) -> Option<FrameEnd> {
        let job = &mut self.active[position].job;
        if job.has_ended() {
            // Give up the missing answers.
            let given_up = job.frame.stamp.order();
            self.dispatcher.retain(|(frame, _)| frame != given_up);
            self.active.remove(position);
            return None;
        }
        self.searched = job.searched();
        self.frames_without_tile = match self.searched {
            0 => self.frames_without_tile.saturating_add(1),
            _ => 0,
        };
        if job.plan_id == 0 {
            self.swept = (self.swept + job.tally().0 as usize) % self.tiles.len().max(1);
        }
        Some(ended(job, reason, self.generation, now_ns))
    }

    /// The ends of all open frames, because the stage stops.
    pub(crate) fn shut_down(&mut self, now_ns: i64) -> Vec<FrameEnd> {
        let open = self.active.iter_mut().filter(|active| !active.job.has_ended());
        let generation = self.generation;
        open.map(|active| ended(&mut active.job, StopReason::Shutdown, generation, now_ns))
            .collect()
    }
}

/// The active frame with this order.
fn active_in<F>(active: &mut [ActiveFrame<F>], frame: FrameOrder) -> Option<&mut ActiveFrame<F>> {
    active.iter_mut().find(|active| active.order() == frame)
}

fn ended(job: &mut FrameJob, reason: StopReason, generation: u32, now_ns: i64) -> FrameEnd {
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
