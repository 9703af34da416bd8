//! The core of rectification: frames, plans and answers with their times in, orders to cut views
//! and frame ends out. It has no port, no clock and no thread.
//!
//! [`Core::on`] takes an event. [`Core::step`] gives the next action; it is called again until
//! there is none. The core owns each frame by an `F`, whose pixels it never reads.

mod active_frame;
mod events;

use std::time::Duration;

use flockeye_config::{Flow, Resolved};
use flockeye_contract::{
    DetectionHeader, FrameEnd, FrameHeader, FrameOrder, PlanHeader, PlannedView, StopReason,
    StopRule, ViewHeader,
};
use flockeye_geometry::camera::Camera;
use flockeye_geometry::search::MAX_FRAMES_WITHOUT_TILE;
use flockeye_geometry::view::View;
use flockeye_imaging::proposals::Proposal;

use self::active_frame::ActiveFrame;
pub use self::events::{Action, CutOrder, Event};
use crate::dispatch::{Acknowledgement, Dispatcher};
use crate::frame_clock::FrameClock;
use crate::job::{FrameJob, NextView, sweep};
use crate::proposals::ProposalChooser;

/// Age from which a plan is not followed, nanoseconds: fusion has died since.
const STALE_PLAN_NS: i64 = 1_000_000_000;

/// Frames in work at once: one that waits for its answers, and the one that is being cut.
const MAX_ACTIVE_FRAMES: usize = 2;

/// A frame, and the index of a view in its plan.
type ViewKey = (FrameOrder, u32);

/// How a core works.
#[derive(Debug, Clone)]
pub(crate) struct Options {
    pub(crate) flow: Flow,
    /// How often this stage was replaced.
    pub(crate) generation: u32,
    /// How many detection workers there are.
    pub(crate) workers: usize,
    /// Views in flight for each of them.
    pub(crate) window: usize,
    /// After how long a worker's views are given to others.
    pub(crate) overdue: Duration,
    pub(crate) camera: Camera,
}

/// What rectification keeps between events.
#[derive(Debug)]
pub struct Core<F> {
    options: Options,
    clock: FrameClock,
    dispatcher: Dispatcher<ViewKey>,
    proposals: ProposalChooser,
    /// Tiles of which the camera sees something, with their numbers.
    tiles: Vec<(u32, View)>,
    /// Tiles of the own sweep that were cut.
    swept: usize,
    /// Tiles that were cut of the frame that ended last.
    searched: usize,
    /// Frames in a row of which no tile was cut.
    frames_without_tile: u64,
    plan: Option<(PlanHeader, Vec<PlannedView>)>,
    /// The frame that waits. A lossless run takes none before it is taken up.
    pub(crate) waiting: Option<(FrameHeader, F)>,
    active: Vec<ActiveFrame<F>>,
    /// The view, and its worker, that is cut once its place was found.
    next_cut: Option<(ViewKey, usize)>,
    last_frame_ns: i64,
}

impl<F> Core<F> {
    /// The core that a configuration asks for, at `now_ns`.
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
            camera: resolved.camera,
        };
        let tiles = views.filter(|(_, view)| !mask.hides_view(view)).collect();
        let proposals = ProposalChooser::of(resolved)?;
        Ok(Self::new(options, FrameClock::of(pipeline), tiles, proposals, now_ns))
    }

    /// A core before its first frame. Without plans it sweeps `tiles`.
    pub(crate) fn new(
        options: Options,
        clock: FrameClock,
        tiles: Vec<(u32, View)>,
        proposals: ProposalChooser,
        now_ns: i64,
    ) -> Self {
        let dispatcher = Dispatcher::new(options.workers, options.window, options.overdue / 2);
        Self {
            options,
            clock,
            dispatcher,
            proposals,
            tiles,
            swept: 0,
            searched: 0,
            frames_without_tile: 0,
            plan: None,
            waiting: None,
            active: Vec::new(),
            next_cut: None,
            last_frame_ns: now_ns,
        }
    }

    /// Views in flight.
    pub(crate) fn outstanding(&self) -> usize {
        self.dispatcher.outstanding()
    }

    /// The workers that have answered nothing for too long, as [`Dispatcher::silent`] gives them.
    pub(crate) fn silent_workers(&mut self) -> Vec<(usize, u64)> {
        self.dispatcher.silent()
    }

    /// The header and the owner of a frame in work.
    pub fn frame(&self, frame: FrameOrder) -> Option<(&FrameHeader, &F)> {
        let active = self.active.iter().find(|active| active.order() == frame)?;
        Some((&active.job.frame, &active.pixels))
    }

    /// For how long no frame has come, nanoseconds.
    pub(crate) fn silence_ns(&self, now_ns: i64) -> i64 {
        if self.waiting.is_some() || !self.active.is_empty() {
            0
        } else {
            now_ns - self.last_frame_ns
        }
    }

    /// Takes an event that came at `now_ns`. Returns whether a frame was dropped: in flight a newer
    /// one replaces the one that waits.
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
        let answer = self.dispatcher.acknowledged(key, worker, attempt, time(now_ns));
        if answer == Acknowledgement::First
            && let Some(ActiveFrame { job, .. }) = active_in(&mut self.active, key.0)
        {
            job.note_answer(header.view_index, header.hits > 0);
            if job.is_tile(header.view_index) {
                self.clock.note_search(header.sent_ns.saturating_sub(header.received_ns));
            }
        }
    }

    /// Gives the frame's proposals the places that were found.
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

    /// What to do next.
    pub fn step(&mut self, now_ns: i64) -> Action {
        if let Some((key, worker)) = self.next_cut.take()
            && let Some(order) = self.cut_placed(key, worker)
        {
            return Action::Cut(order);
        }
        for (frame, index) in self.dispatcher.overdue(time(now_ns), self.options.overdue) {
            match active_in(&mut self.active, frame) {
                Some(active) => active.job.take_back(index),
                // The frame has made room for a newer one: nobody needs its view any more.
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
        // A worker that answers nothing must be noticed.
        let overdue_ns = self.options.overdue.as_nanos() as i64;
        let is_awaited = !self.active.is_empty() || self.outstanding() > 0;
        Action::Wait(is_awaited.then_some(now_ns + overdue_ns / 4))
    }

    /// Takes up the frame that waits, once the one before has been cut.
    fn take_up(&mut self, now_ns: i64) -> Option<Action> {
        let is_cutting = self.active.iter().any(|active| !active.job.has_ended());
        if is_cutting || self.waiting.is_none() {
            return None;
        }
        if self.active.len() >= MAX_ACTIVE_FRAMES {
            if self.options.flow == Flow::Lossless {
                return None;
            }
            // In flight a newer frame is worth more than a view of an old one that its worker may
            // have lost. Its late answers are counted all the same.
            self.active.remove(0);
        }
        let (header, pixels) = self.waiting.take()?;
        self.clock.begin_frame(&header.stamp);
        let job = self.job_for(header, now_ns);
        let likely = job.likely(self.searched);
        let mut active = ActiveFrame::new(job, pixels);
        let likely = active.announce(likely, &self.options.camera);
        self.active.push(active);
        Some(Action::TakeUp { frame: header.stamp.order(), likely })
    }

    fn job_for(&self, header: FrameHeader, now_ns: i64) -> FrameJob {
        let is_live = |plan: &PlanHeader| {
            self.options.flow == Flow::Lossless || now_ns - plan.made_ns < STALE_PLAN_NS
        };
        if let Some((plan, views)) = self.plan.as_ref().filter(|(plan, _)| is_live(plan)) {
            // The plan was checked when it was received, so its rule is known.
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

    /// The next view to be cut, or a frame's end. `None` if there is nothing to do before an event.
    fn cut_next(&mut self, now_ns: i64) -> Option<Action> {
        for position in 0..self.active.len() {
            let job = &self.active[position].job;
            let is_newer_waiting = self.waiting.is_some();
            let next = job.upcoming();
            // A frame that has come to no tile yet, as those before it, has time for one, and for
            // nothing else: the plan has a tile before its proposals then.
            let is_tile_due = job.searched() == 0
                && self.frames_without_tile >= MAX_FRAMES_WITHOUT_TILE
                && next.is_some_and(|next| next.view.is_tile());
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
                    let (outstanding, workers) = (self.outstanding(), self.options.workers);
                    if is_yielding && !self.clock.has_room_for_tile(outstanding, workers, now_ns) {
                        continue;
                    }
                    return self.cut(position, index, worker);
                }
            }
        }
        None
    }

    /// Cuts a view for a worker. Searches the frame for the places of its proposals before the
    /// first of them is cut: tracked neighbours' views are cut before, and no pose waits for it.
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

    /// The order to cut the first of a frame's proposals, whose places were found.
    fn cut_placed(&mut self, key: ViewKey, worker: usize) -> Option<CutOrder> {
        let active = active_in(&mut self.active, key.0)?;
        let ahead = active.announce(active.job.proposal_indices(), &self.options.camera);
        let order = self.cut_order(key, worker)?;
        Some(CutOrder { ahead, ..order })
    }

    fn cut_order(&mut self, (frame, index): ViewKey, worker: usize) -> Option<CutOrder> {
        let attempt = self.dispatcher.next_attempt((frame, index));
        let Options { generation, camera, .. } = self.options;
        let order = active_in(&mut self.active, frame)?.cut_order(index, &camera)?;
        let header = ViewHeader { worker: worker as u32, attempt, generation, ..order.header };
        Some(CutOrder { header, ..order })
    }

    /// Ends a frame. `None` if its end is out already, and a view of it could not be cut again.
    fn end(&mut self, position: usize, reason: StopReason, now_ns: i64) -> Option<FrameEnd> {
        let job = &mut self.active[position].job;
        if job.has_ended() {
            // The answer is not waited for.
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
        Some(ended(job, reason, self.options.generation, now_ns))
    }

    /// The ends of all frames that have none, because the stage stops.
    pub(crate) fn shut_down(&mut self, now_ns: i64) -> Vec<FrameEnd> {
        let open = self.active.iter_mut().filter(|active| !active.job.has_ended());
        let generation = self.options.generation;
        open.map(|active| ended(&mut active.job, StopReason::Shutdown, generation, now_ns))
            .collect()
    }
}

/// One of the frames in work.
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
