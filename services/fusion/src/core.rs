//! The core of fusion: events with their times in, tracks and plans out. It holds no port, no clock
//! and no thread of its own.
//!
//! [`Core::on`] records an event. [`Core::step`] does the most urgent piece of work and returns its
//! output. It is called again until there is no work left.

pub(crate) mod events;
mod measuring;

pub use events::{Event, Outputs};

use std::collections::VecDeque;

use flockeye_contract::{
    DetectedMarker, FrameOrder, FrameStamp, JournalKind, Rotation, ViewHeader,
};
use flockeye_convert::{camera_turn, purpose_of, search_of, view_of};
use flockeye_geometry::search::Planner;

use crate::account::{AccountEntry, Pass, Trial};
use crate::frame::frames::Frames;
use crate::journal::Journal;
use crate::measure::FrameTime;
use crate::measurement::agrees_with_view;
use crate::notices::Notice;
use crate::output::{Outgoing, TrackMessage};
use crate::pictures::PictureReader;
use crate::planning::Planning;
use crate::policy::TimeBudget;
use crate::record::Record;
use crate::refusal::Guard;
use crate::schedule::Schedule;
use crate::snapshot::Snapshot;
use crate::stitching::StitchEstimate;
use crate::tracker::{CameraState, Tracker};
use crate::work::Work;

/// State of fusion between events. `P` is the hold on a view's pixels.
pub struct Core<P> {
    schedule: Schedule,
    pub(crate) frames: Frames<P>,
    reader: PictureReader,
    tracker: Tracker,
    planner: Planner,
    planning: Planning,
    /// Answers of the background pass, with the times from which they count, nanoseconds of a
    /// virtual clock.
    answers: VecDeque<(i64, Box<Trial>)>,
    notices: Vec<Notice>,
    /// Check of messages in flight. `None` where any frame may come.
    guard: Option<Guard>,
    /// Journal of the core's calls, so that a flight can be repeated; `None` in a replay.
    journal: Option<Journal>,
}

impl<P: AsRef<[u8]>> Core<P> {
    /// Creates a core before the first event.
    pub(crate) fn new(
        schedule: Schedule,
        frames: Frames<P>,
        reader: PictureReader,
        tracker: Tracker,
        planner: Planner,
    ) -> Self {
        Self {
            schedule,
            frames,
            reader,
            tracker,
            planning: Planning::new(&planner),
            planner,
            answers: VecDeque::new(),
            notices: Vec::new(),
            guard: None,
            journal: None,
        }
    }

    /// Refuses messages that are impossible in flight with `workers` detection workers.
    pub(crate) fn guarded(self, workers: u32) -> Self {
        Self { guard: Some(Guard::new(workers)), ..self }
    }

    /// From now on, records each event, step and message in a journal.
    pub fn journaled(self, journal: Journal) -> Self {
        Self { journal: Some(journal), ..self }
    }

    /// The journal, if one is kept.
    pub fn journal(&mut self) -> Option<&mut Journal> {
        self.journal.as_mut()
    }

    /// State for a successor.
    pub(crate) fn snapshot(&self) -> Snapshot {
        let published = |target| self.frames.last_published(target);
        let (targets, ego, exposure) = self.tracker.saved(published);
        let CameraState { response, stitching, .. } = self.tracker.camera();
        let response = response.learned();
        let lenses = stitching.as_ref().map(StitchEstimate::learned);
        let ended = self.tracker.ended.map(|(order, _)| order).max(self.frames.last_complete);
        let planning = self.planning.clone();
        Snapshot { ended, targets, ego, exposure, response, lenses, planning }
    }

    /// Continues from another process's snapshot, and returns the names of the bodies whose tracks
    /// continue. It is called before the first event. Published poses are not published again in
    /// any case.
    pub(crate) fn resume(&mut self, snapshot: Snapshot) -> Vec<String> {
        let Snapshot { ended, targets, ego, exposure, response, lenses, planning } = snapshot;
        self.frames.begin_after(ended);
        for saved in &targets {
            let mut names = self.tracker.targets().iter().map(|target| &target.body.name);
            if let Some(target) = names.position(|name| *name == saved.body) {
                self.frames.note_published_before(target, saved.published);
            }
        }
        self.planning.resume(planning);
        self.tracker.camera.response.resume(response);
        if let Some((stitching, lenses)) = self.tracker.camera.stitching.as_mut().zip(lenses) {
            stitching.resume(lenses);
        }
        self.tracker.resume(targets, ego, exposure)
    }

    /// Whether the view of a record has arrived.
    pub(crate) fn has_view_of(&self, record: &Record) -> bool {
        let frame = self.frames.waiting_frame(record.header.stamp.order());
        frame.is_some_and(|frame| frame.views.contains_key(&record.header.view_index))
    }

    /// The bodies, targets and their tracks.
    pub fn tracker(&self) -> &Tracker {
        &self.tracker
    }

    /// From now on, records the decisions about a target.
    pub fn keep_account(&mut self, target: usize) {
        self.tracker.keep_account(target);
    }

    /// The decisions about the target since the last call, with the frame of each.
    pub fn take_account(&mut self) -> Vec<(FrameOrder, AccountEntry)> {
        self.tracker.take_account()
    }

    /// Whether a background pass may still have a result in an open frame.
    pub(crate) fn awaits_background(&self) -> bool {
        self.tracker.awaited().is_some_and(|order| self.frames.get(order).is_some())
    }

    /// Handles an event that arrived at `now_ns`, or returns the reason for its refusal.
    pub fn on(&mut self, event: Event<P>, now_ns: i64) -> Option<String> {
        if let Some(journal) = &mut self.journal {
            journal.note_event(&event, now_ns);
        }
        if let Some(refusal) = self.refusal(&event, now_ns) {
            self.notices.push(Notice::Refused(refusal.clone()));
            return Some(refusal);
        }
        match event {
            Event::View(header, pixels) => self.on_view(header, pixels, now_ns),
            Event::Searched(record) => self.on_record(record, now_ns),
            Event::FrameEnd(end) => self.frames.add_end(end, now_ns),
            Event::Rotation(rotation) => self.on_rotation(rotation),
            Event::Background(answer) => self.on_background(answer),
        }
        None
    }

    fn on_view(&mut self, header: ViewHeader, pixels: P, now_ns: i64) {
        self.tracker.camera.response.note_view(header.transfer, header.gamma);
        if self.frames.add_view(header, pixels, now_ns)
            && let Some(purpose) = purpose_of(&header)
        {
            self.planning.note_cut(purpose, search_of(&header));
        }
    }

    fn on_record(&mut self, mut record: Record, now_ns: i64) {
        let header = record.header;
        let (order, view_index) = (header.stamp.order(), header.view_index);
        let frame = self.frames.waiting_frame(order);
        let view = frame.and_then(|frame| frame.views.get(&view_index)).copied();
        if let Some(view) = view.as_ref().map(view_of) {
            let disagrees = |marker: &&DetectedMarker| !agrees_with_view(marker, &view);
            if let Some(marker) = record.markers.iter().find(disagrees) {
                let notice = Notice::RaysDisagree { worker: header.worker, marker: marker.id };
                self.notices.push(notice);
                record.markers.clear();
            }
        }
        let is_known = |id| {
            let mut targets = self.tracker.targets().iter();
            targets.any(|target| target.body.marker(id).is_some())
        };
        if let Some(unknown) = record.markers.iter().find(|marker| !is_known(marker.id)) {
            self.notices.push(Notice::UnknownMarker { marker: unknown.id });
        }
        let Some(frame) = self.frames.add_record(record, now_ns) else {
            self.notices.push(Notice::LateRecord);
            return;
        };
        if self.schedule.is_flight() {
            frame.searched.push(view_index);
        }
        let shows = frame.qualities(view_index, self.tracker.targets());
        self.frames.answer(order, view_index, shows, !self.schedule.is_flight());
    }

    /// Reason why an event is refused.
    fn refusal(&mut self, event: &Event<P>, now_ns: i64) -> Option<String> {
        let guard = self.guard.as_mut()?;
        let planned = |plan_id| self.frames.views_of_plan(plan_id);
        match event {
            Event::View(view, _) => guard.refuses_frame(&view.stamp, now_ns),
            Event::Searched(record) => {
                guard.refuses_record(&record.header, planned(record.header.plan_id))
            }
            Event::FrameEnd(end) => guard.refuses_end(end, planned(end.plan_id), now_ns),
            Event::Rotation(_) | Event::Background(_) => None,
        }
    }

    /// In flight a rotation counts at once. Otherwise it counts when its frame is complete, so that
    /// results do not depend on the speed of other stages.
    fn on_rotation(&mut self, rotation: Rotation) {
        match self.schedule.is_flight() {
            true => self.turn_camera(&rotation),
            false => self.frames.add_rotation(rotation),
        }
    }

    fn turn_camera(&mut self, rotation: &Rotation) {
        if let Some(turn) = camera_turn(rotation) {
            self.tracker.turn_camera(&turn);
        }
    }

    fn on_background(&mut self, answer: Box<Trial>) {
        let over_ns = match &self.schedule {
            Schedule::Virtual(clock) => clock.background_over_ns,
            Schedule::Flight | Schedule::Unlimited => i64::MIN,
        };
        self.answers.push_back((over_ns, answer));
    }

    /// Does the most urgent piece of work.
    pub fn step(&mut self, now_ns: i64) -> Outputs {
        let mut outputs =
            Outputs { notices: std::mem::take(&mut self.notices), ..Outputs::default() };
        match self.next_work(now_ns) {
            Some(work) => self.run(work, &mut outputs),
            None => outputs.is_idle = true,
        }
        self.begin_background(&mut outputs);
        if let Some(journal) = &mut self.journal
            && outputs.has_worked()
        {
            journal.note_work(JournalKind::Step, now_ns, (0, 0));
        }
        outputs
    }

    /// Records that the output of the last step is written for the time `now_ns`.
    pub fn say(&mut self, outputs: &Outputs, now_ns: i64) {
        let messages = outputs.messages();
        if let Some(journal) = &mut self.journal
            && messages != (0, 0)
        {
            journal.note_work(JournalKind::Said, now_ns, messages);
        }
    }

    /// The most urgent piece of work.
    fn next_work(&self, now_ns: i64) -> Option<Work> {
        let opening = (self.frames.newest_plan == 0).then_some(Work::OpenFlow);
        let has_answer = self.schedule.is_flight() && !self.answers.is_empty();
        let answer = has_answer.then_some(Work::TakeAnswer);
        let of_frames = self.frames.next_work(now_ns);
        [opening, answer, of_frames].into_iter().flatten().min()
    }

    fn run(&mut self, work: Work, outputs: &mut Outputs) {
        match work {
            Work::OpenFlow => self.plan(None, outputs),
            Work::MeasureRegions { order, .. } => self.measure_regions(order, outputs),
            Work::MeasureRecords { order } => {
                let frame = self.frames.get_mut(order);
                let searched = frame.map(|frame| std::mem::take(&mut frame.searched));
                self.measure(order, Pass::Region, searched, outputs);
            }
            Work::TakeAnswer => {
                let answer = self.answers.pop_front();
                answer.into_iter().for_each(|(_, answer)| self.take_answer(*answer, outputs));
            }
            Work::MeasureFrame { order } => {
                self.take_answers(outputs);
                self.measure(order, Pass::Complete, None, outputs);
                match self.frames.keeping.keeps_places {
                    true => self.frames.set_measured(order),
                    false => self.end_frame(order, outputs),
                }
            }
            Work::SearchPlaces { order } => {
                if !self.search_a_place(order, outputs) {
                    self.end_frame(order, outputs);
                }
            }
            Work::CompleteFrame { order, is_overdue } => {
                self.complete_frame(order, is_overdue, outputs);
            }
        }
    }

    /// Time budget of the passes of a frame.
    fn budget(&self, stamp: &FrameStamp) -> TimeBudget {
        self.schedule.budget(stamp, self.frames.newest.as_ref())
    }

    /// Publishes the result of a background pass if its frame is still open. Otherwise it has
    /// corrected the track, from which the next frame benefits.
    fn take_answer(&mut self, answer: Trial, outputs: &mut Outputs) {
        let frame = self.tracker.under_way().and_then(|order| self.frames.get_mut(order));
        let parts = frame.map(|frame| &mut frame.parts);
        let Some((order, update)) = self.tracker.background_answer(answer, parts) else { return };
        self.publish_updates(order, vec![update], None, outputs);
    }

    /// Closes a frame to further messages. With a virtual clock, its regions are measured now, as
    /// in flight during the search of its tiles. Then the clock advances to the time at which
    /// flight would have measured them.
    fn complete_frame(&mut self, order: FrameOrder, is_overdue: bool, outputs: &mut Outputs) {
        self.frames.complete(order);
        while let Some(rotation) = self.frames.take_rotation(order) {
            self.turn_camera(&rotation);
        }
        let Some(frame) = self.frames.get_mut(order) else { return };
        let stamp = frame.stamp;
        if is_overdue {
            outputs.notices.push(Notice::Incomplete { sequence: stamp.sequence });
        }
        let Schedule::Virtual(clock) = &mut self.schedule else { return };
        clock.begin_frame(&stamp);
        clock.spend(self.tracker.take_attempts());
        let found = frame.take_found();
        self.take_answers(outputs);
        self.publish(&stamp, found, outputs);
        self.measure(order, Pass::Region, None, outputs);
        if let Schedule::Virtual(clock) = &mut self.schedule {
            clock.complete_frame(&stamp);
        }
    }

    /// Handles the answers that are finished by a virtual clock.
    fn take_answers(&mut self, outputs: &mut Outputs) {
        let Schedule::Virtual(clock) = &self.schedule else { return };
        let clock = clock.clone();
        while let Some((over_ns, _)) = self.answers.front()
            && self.tracker.under_way().is_some_and(|order| clock.is_over(*over_ns, order))
            && let Some((_, answer)) = self.answers.pop_front()
        {
            self.take_answer(*answer, outputs);
            self.begin_background(outputs);
        }
    }

    /// Returns the background pass that was just requested. Only one runs at a time, so a step
    /// returns one at most.
    fn begin_background(&mut self, outputs: &mut Outputs) {
        let Some(job) = self.tracker.take_job() else { return };
        if let Schedule::Virtual(clock) = &mut self.schedule {
            clock.begin_background();
        }
        outputs.job = Some(job);
    }

    /// Ends a measured frame, and makes the next plan.
    fn end_frame(&mut self, order: FrameOrder, outputs: &mut Outputs) {
        let Some(frame) = self.frames.end(order) else { return };
        let at_s = frame.stamp.exposure_s();
        self.tracker.end_frame(order, at_s, &frame.parts);
        let surprise = self.tracker.learn();
        self.notices.extend(surprise.map(Notice::Response));
        // Views that arrived were already recorded.
        self.planning.end_frame(at_s, frame.purposes_without_view(), frame.first_hit());
        outputs.tracks.push(TrackMessage::last_of(frame.stamp));
        self.plan(Some(frame.stamp), outputs);
        outputs.taken_ns = frame.end.map(|end| end.taken_ns);
    }

    /// Sends estimates of a frame's targets: the one place where a pose is published.
    fn publish(&mut self, stamp: &FrameStamp, updates: Vec<Outgoing>, outputs: &mut Outputs) {
        if let Some(frame) = self.frames.get_mut(stamp.order()) {
            updates.iter().for_each(|((target, _), _)| drop(frame.held.best.remove(target)));
        }
        outputs.tracks.extend(TrackMessage::of(*stamp, updates));
    }

    fn plan(&mut self, after: Option<FrameStamp>, outputs: &mut Outputs) {
        let plan_id = self.frames.newest_plan + 1;
        let next = self.planning.next(&self.planner, plan_id, &self.tracker);
        self.frames.note_plan(next.plan_id, &next.plan);
        outputs.plan = Some((next, after));
    }
}

fn time_of(stamp: &FrameStamp) -> FrameTime {
    FrameTime { order: stamp.order(), at_s: stamp.exposure_s() }
}

#[cfg(test)]
mod tests;
