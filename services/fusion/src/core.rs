//! The core of fusion: events with their times in, tracks and plans out. It holds no port, no clock and
//! no thread of its own.
//!
//! [`Core::on`] notes an event. [`Core::step`] does the most urgent piece of work and hands out what it
//! led to; it is called again until there is nothing left to do.

mod events;
mod passes;
mod refusal;

pub use events::{EndedFrame, Event, Outputs};
pub use refusal::Refusal;

use std::collections::VecDeque;

use flockeye_contract::{DetectedMarker, FrameOrder, FrameStamp, Rotation, ViewHeader};
use flockeye_convert::{camera_turn, purpose_of, search_of, view_of};
use flockeye_geometry::search::{Purpose, Search};

use self::refusal::Guard;
use crate::account::Decision;
use crate::frame_assembly::{Frame, FrameAssembly, Leave, Record};
use crate::measurement::agrees_with_view;
use crate::notices::Notice;
use crate::output::{Cause, Outgoing, TrackMessage};
use crate::passes::background::Answer;
use crate::passes::corners::records_that_count;
use crate::passes::{AnsweredView, BestViews};
use crate::pictures::{PictureReader, Pixels};
use crate::places::Places;
use crate::planning::Planning;
use crate::policy::TimeBudget;
use crate::schedule::Schedule;
use crate::snapshot::Snapshot;
use crate::target::Update;
use crate::tracker::{FrameTime, Tracker};
use crate::view_cache::{ViewCache, ViewQuality};

/// A pass over the records of a frame: [`Tracker::region_pass`] or [`Tracker::final_pass`].
type Pass =
    fn(&mut Tracker, FrameTime, &[AnsweredView<'_>], &BestViews<'_>, TimeBudget) -> Vec<Update>;

/// What the view at this place in a frame's plan shows: targets, and how well.
type Shown = (FrameOrder, u32, Vec<(usize, ViewQuality)>);

/// Rotations that wait for their frames, at most; a lossless source has one frame under way.
const MAX_ROTATIONS: usize = 64;

/// What fusion keeps between events. `P` is the hold on a view's pixels.
pub struct Core<P> {
    schedule: Schedule,
    /// Whether the pixels of views are used.
    aligns: bool,
    assembly: FrameAssembly,
    cache: ViewCache<P>,
    reader: PictureReader,
    tracker: Tracker,
    planning: Planning,
    /// Views of places that look like a body; `None` where they are not searched.
    places: Option<Places>,
    /// Regions of interest that have come, for the direct pass.
    cut_regions: Vec<(FrameOrder, u32)>,
    /// What direct passes found in a frame that is published when it is complete.
    found: Vec<Outgoing>,
    /// Records that have come, for the corner pass.
    searched: Vec<Record>,
    /// Records whose views still wait for the direct pass.
    shown: Vec<Shown>,
    /// Answers of the background pass, and from when on they count, nanoseconds of a virtual clock.
    answers: VecDeque<(i64, Answer)>,
    /// How the camera has turned, for frames that are not complete.
    rotations: VecDeque<Rotation>,
    /// A complete frame whose regions have been measured.
    complete: Option<Frame>,
    /// A complete frame of which all but its places is measured.
    measured: Option<Frame>,
    /// The newest frame of which a view has come.
    newest: Option<FrameStamp>,
    notices: Vec<Notice>,
    /// `None` where any frame may come.
    guard: Option<Guard>,
}

impl<P: Pixels> Core<P> {
    /// A core that has heard of no frame yet.
    pub fn new(
        schedule: Schedule,
        aligns: bool,
        assembly: FrameAssembly,
        cache: ViewCache<P>,
        reader: PictureReader,
        tracker: Tracker,
        planning: Planning,
    ) -> Self {
        Self {
            schedule,
            aligns,
            assembly,
            cache,
            reader,
            tracker,
            planning,
            places: None,
            cut_regions: Vec::new(),
            found: Vec::new(),
            searched: Vec::new(),
            shown: Vec::new(),
            answers: VecDeque::new(),
            rotations: VecDeque::new(),
            complete: None,
            measured: None,
            newest: None,
            notices: Vec::new(),
            guard: None,
        }
    }

    /// Refuses what cannot be true in flight with so many detection workers.
    pub fn guarded(self, workers: u32) -> Self {
        Self { guard: Some(Guard::new(workers)), ..self }
    }

    /// Searches places that look like a body for targets of which nothing else is known.
    pub fn searching_places(self) -> Self {
        Self { places: Some(Places::default()), ..self }
    }

    /// What a successor needs to go on.
    pub fn snapshot(&self) -> Snapshot {
        let (targets, ego, exposure) = self.tracker.saved();
        let ended = self.tracker.last_ended().max(self.assembly.last_left());
        Snapshot { ended, targets, ego, exposure, planning: self.planning.saved() }
    }

    /// Goes on from another process's snapshot, and returns the names of the bodies whose tracks go on. It is
    /// called before the first event.
    pub fn resume(&mut self, snapshot: Snapshot) -> Vec<String> {
        let Snapshot { ended, targets, ego, exposure, planning } = snapshot;
        self.assembly.begin_after(ended);
        self.planning.resume(planning);
        self.tracker.resume(targets, ego, exposure)
    }

    /// Whether one more view would release the oldest that waits for its record.
    pub fn is_full(&self) -> bool {
        self.cache.is_full()
    }

    /// Whether the view of a record has come.
    pub fn has_view_of(&self, record: &Record) -> bool {
        let frame = self.assembly.open_frame(&record.header.stamp);
        frame.is_some_and(|frame| frame.views.contains_key(&record.header.view_index))
    }

    /// Whether a frame has ended, or a newer one.
    pub fn has_ended(&self, stamp: &FrameStamp) -> bool {
        self.assembly.has_left(stamp)
    }

    /// How many frames are open.
    pub fn open_frames(&self) -> usize {
        self.assembly.open_frames()
    }

    /// How many plans were made.
    pub fn plans(&self) -> u64 {
        self.planning.plans()
    }

    /// The bodies, targets and their tracks.
    pub fn tracker(&self) -> &Tracker {
        &self.tracker
    }

    /// Notes from now on what is decided of a target.
    pub fn keep_account(&mut self, target: usize) {
        self.tracker.keep_account(target);
    }

    /// What was decided of the target since this was asked last, with the frame of each decision.
    pub fn take_account(&mut self) -> Vec<(FrameOrder, Decision)> {
        self.tracker.take_account()
    }

    /// When the oldest frame will be overdue, nanoseconds.
    pub fn next_deadline_ns(&self) -> Option<i64> {
        self.assembly.next_deadline_ns()
    }

    /// Whether a background pass may still find something in a frame that is open.
    pub fn awaits_background(&self) -> bool {
        self.tracker.awaited().is_some_and(|order| self.assembly.of_order(order).is_some())
    }

    /// Notes an event that came at `now_ns`, or says why it is refused.
    pub fn on(&mut self, event: Event<P>, now_ns: i64) -> Option<Refusal> {
        if let Some(refusal) = self.refusal(&event, now_ns) {
            self.notices.push(Notice::Refused(refusal));
            return Some(refusal);
        }
        match event {
            Event::View(header, pixels) => self.on_view(header, pixels, now_ns),
            Event::Searched(record) => self.on_record(record, now_ns),
            Event::FrameEnd(end) => self.assembly.add_end(end, now_ns),
            Event::Rotation(rotation) => self.on_rotation(rotation),
            Event::Background(answer) => self.on_background(answer),
        }
        None
    }

    fn on_view(&mut self, header: ViewHeader, pixels: P, now_ns: i64) {
        if !self.assembly.add_view(header, now_ns) {
            return;
        }
        if self.newest.is_none_or(|newest| !header.stamp.is_late_beside(&newest)) {
            self.newest = Some(header.stamp);
        }
        let purpose = purpose_of(&header);
        if let Some(purpose) = purpose {
            self.planning.note_cut(purpose, search_of(&header));
        }
        if self.aligns {
            // A proposal for which there was no place is not searched.
            let has_place = search_of(&header) != Search::Nothing;
            if let (Some(places), Some(Purpose::Proposal), true) =
                (&mut self.places, purpose, has_place)
            {
                places.add(header, pixels.pixels());
            }
            self.cache.add(header, pixels);
            if self.schedule.has_direct_pass() && matches!(purpose, Some(Purpose::Gaze(_))) {
                self.cut_regions.push((header.stamp.order(), header.view_index));
            }
        }
    }

    fn on_record(&mut self, mut record: Record, now_ns: i64) {
        let header = record.header;
        let frame = self.assembly.open_frame(&header.stamp);
        let view = frame.and_then(|frame| frame.views.get(&header.view_index)).copied();
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
        if !self.assembly.add_record(record.clone(), now_ns) {
            self.notices.push(Notice::LateRecord);
            return;
        }
        let purpose = self.planning.purpose_of(header.plan_id, header.view_index, view.as_ref());
        let stop_rule = self.planning.stop_rule_of(header.plan_id);
        let shows = self.tracker.shown(&record, purpose, view.as_ref(), stop_rule);
        let view = (header.stamp.order(), header.view_index);
        // A region stays until the direct pass has seen it.
        if !self.schedule.is_flight() && self.cut_regions.contains(&view) {
            self.shown.push((view.0, view.1, shows));
        } else {
            self.cache.answered(view.0, view.1, &shows);
        }
        if self.schedule.is_flight() {
            self.searched.push(record);
        }
    }

    /// Why an event is refused.
    fn refusal(&mut self, event: &Event<P>, now_ns: i64) -> Option<Refusal> {
        let guard = self.guard.as_mut()?;
        match event {
            Event::View(view, _) => guard.refuses_view(view, now_ns),
            Event::Searched(record) => guard.refuses_record(&record.header, &self.planning),
            Event::FrameEnd(end) => guard.refuses_end(end, &self.planning, now_ns),
            Event::Rotation(_) | Event::Background(_) => None,
        }
    }

    /// In flight a rotation counts at once. Otherwise it counts when its frame is complete: what a frame
    /// says must not depend on who is faster.
    fn on_rotation(&mut self, rotation: Rotation) {
        match self.schedule.is_flight() {
            true => self.turn_camera(&rotation),
            false => {
                self.rotations.push_back(rotation);
                if self.rotations.len() > MAX_ROTATIONS {
                    self.rotations.pop_front();
                }
            }
        }
    }

    fn turn_camera(&mut self, rotation: &Rotation) {
        if let Some(turn) = camera_turn(rotation) {
            self.tracker.turn_camera(&turn);
        }
    }

    fn on_background(&mut self, answer: Answer) {
        let over_ns = match &self.schedule {
            Schedule::Virtual(clock) => clock.background_over_ns(),
            Schedule::Flight | Schedule::Unlimited => i64::MIN,
        };
        self.answers.push_back((over_ns, answer));
    }

    /// Does the most urgent piece of work: the first plan, then direct passes over some regions, corner
    /// passes over one frame's records, an answer of the background pass, some places of a complete frame, the
    /// end of one frame.
    pub fn step(&mut self, now_ns: i64) -> Outputs {
        let mut outputs =
            Outputs { notices: std::mem::take(&mut self.notices), ..Outputs::default() };
        if self.planning.plans() == 0 {
            // The first plan opens the flow: rectification has something to follow, and a lossless source
            // its first credit.
            self.plan(None, &mut outputs);
        } else if !self.cut_regions.is_empty() {
            self.direct_pass(&mut outputs);
        } else if !self.searched.is_empty() {
            self.region_pass(&mut outputs);
        } else if self.schedule.is_flight()
            && let Some((_, answer)) = self.answers.pop_front()
        {
            self.take_answer(answer, &mut outputs);
        } else if self.complete.is_some() {
            self.take_answers(&mut outputs);
            if let Some(frame) = self.complete.take() {
                self.measure(&frame, &mut outputs, Tracker::final_pass);
                match self.places.is_some() {
                    true => self.measured = Some(frame),
                    false => self.end_frame(&frame, &mut outputs),
                }
            }
        } else if let Some(frame) = self.measured.take() {
            match self.search_a_place(&frame, &mut outputs) {
                true => self.measured = Some(frame),
                false => self.end_frame(&frame, &mut outputs),
            }
        } else if let Some((frame, leave)) = self.assembly.take(now_ns) {
            if leave == Leave::Overdue {
                outputs.notices.push(Notice::Incomplete { sequence: frame.stamp.sequence });
            }
            self.complete_frame(&frame, &mut outputs);
            self.complete = Some(frame);
        } else {
            outputs.is_idle = true;
        }
        self.begin_background(&mut outputs);
        outputs
    }

    /// How much time the passes of a frame may take.
    fn budget(&self, stamp: &FrameStamp) -> TimeBudget {
        self.schedule.budget(stamp, self.newest.as_ref())
    }

    /// Publishes what a background pass found, if its frame is still open. Otherwise it has corrected the
    /// track, from which the next frame benefits.
    fn take_answer(&mut self, answer: Answer, outputs: &mut Outputs) {
        let Some((order, update)) = self.tracker.background_answer(answer) else { return };
        let complete = self.complete.as_ref().filter(|frame| frame.stamp.order() == order);
        let Some(frame) = self.assembly.of_order(order).or(complete) else { return };
        let stamp = frame.stamp;
        let records: Vec<&Record> = frame.records.values().collect();
        let updates = self.caused_by(vec![update], &records);
        self.publish(&stamp, updates, outputs);
    }

    /// A frame is complete. By a virtual clock, its regions are measured now, as in flight while its tiles
    /// are searched, and then it is the time at which flight would be done with them.
    fn complete_frame(&mut self, frame: &Frame, outputs: &mut Outputs) {
        let is_due = |rotation: &Rotation| rotation.stamp.order() <= frame.stamp.order();
        while self.rotations.front().is_some_and(is_due)
            && let Some(rotation) = self.rotations.pop_front()
        {
            self.turn_camera(&rotation);
        }
        let Schedule::Virtual(clock) = &mut self.schedule else { return };
        clock.begin_frame(&frame.stamp);
        clock.spend(self.tracker.take_attempts());
        self.take_answers(outputs);
        let mut found = std::mem::take(&mut self.found);
        found.sort_by_key(|((target, _), _)| *target);
        self.publish(&frame.stamp, found, outputs);
        self.measure(frame, outputs, Tracker::region_pass);
        if let Schedule::Virtual(clock) = &mut self.schedule {
            clock.complete_frame(&frame.stamp);
        }
    }

    /// Takes in the answers that are over by a virtual clock.
    fn take_answers(&mut self, outputs: &mut Outputs) {
        let Schedule::Virtual(clock) = &self.schedule else { return };
        let clock = clock.clone();
        let is_over =
            |(over_ns, answer): &(i64, Answer)| clock.is_over(*over_ns, answer.subject.order);
        while self.answers.front().is_some_and(is_over)
            && let Some((_, answer)) = self.answers.pop_front()
        {
            self.take_answer(answer, outputs);
            self.begin_background(outputs);
        }
    }

    /// Hands out the background pass that was asked for just now. One is under way at a time, so a step hands out one at
    /// most.
    fn begin_background(&mut self, outputs: &mut Outputs) {
        let Some(job) = self.tracker.take_job() else { return };
        if let Schedule::Virtual(clock) = &mut self.schedule {
            clock.begin_background();
        }
        outputs.job = Some(job);
    }

    /// Ends a frame of which all is measured, and makes the next plan.
    fn end_frame(&mut self, frame: &Frame, outputs: &mut Outputs) {
        let (purposes, stop_rule) = self.planning.purposes_of(frame);
        let counted = records_that_count(frame, stop_rule);
        self.tracker.end_frame(frame, frame.stamp.exposure_s());
        self.planning.end_frame(frame, &counted, &purposes);
        self.cache.release_until(frame.stamp.order());
        self.places.iter_mut().for_each(|places| places.release_until(frame.stamp.order()));
        outputs.tracks.push(TrackMessage::last_of(frame.stamp));
        self.plan(Some(frame.stamp), outputs);
        outputs.ended = Some(EndedFrame { taken_ns: frame.end.map(|end| end.taken_ns) });
    }

    fn caused_by(&self, updates: Vec<Update>, records: &[&Record]) -> Vec<Outgoing> {
        updates
            .into_iter()
            .map(|update| {
                let cause = Cause::of_records(records, &self.tracker.targets()[update.0].body);
                (update, cause)
            })
            .collect()
    }

    /// Sends estimates of a frame's targets: the one place where a pose leaves.
    fn publish(&mut self, stamp: &FrameStamp, updates: Vec<Outgoing>, outputs: &mut Outputs) {
        for ((target, _), _) in &updates {
            self.cache.release(stamp.order(), *target);
        }
        outputs.tracks.extend(TrackMessage::of(*stamp, updates));
    }

    fn plan(&mut self, after: Option<FrameStamp>, outputs: &mut Outputs) {
        let next = self.planning.next(&self.tracker);
        self.assembly.planned(next.plan_id);
        outputs.plan = Some((next, after));
    }
}

fn time_of(planning: &Planning, stamp: &FrameStamp) -> FrameTime {
    FrameTime { order: stamp.order(), at_s: stamp.exposure_s(), number: planning.frames() }
}

#[cfg(test)]
mod tests;
