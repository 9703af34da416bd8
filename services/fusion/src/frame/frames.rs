//! All open frames, in the order of their exposure.
//!
//! Messages about a frame arrive in any order. It is complete when rectification has ended it and
//! every issued view is answered. A stage that died would leave it open for ever, so it is
//! completed after a deadline. A frame without a plan of this process was under way when the
//! process began, so earlier messages are missing. It is completed as soon as a newer frame is
//! whole.

use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;

use flockeye_contract::{FrameEnd, FrameOrder, FrameStamp, Rotation, ViewHeader};
use flockeye_convert::{purpose_of, search_of};
use flockeye_geometry::search::{Plan, Purpose, Search};

use super::parts::{is_published, parts_of};
use super::views::ViewQuality;
use super::{OpenFrame, Phase};
use crate::record::Record;
use crate::work::Work;

/// Most open frames; beyond it the oldest is completed.
const MAX_OPEN_FRAMES: usize = 8;
/// Most views of places that are kept, of all frames.
const MAX_PLACES: usize = 128;
/// Number of plans that are kept, for frames that still follow them.
const REMEMBERED_PLANS: usize = 16;
/// Most rotations that wait for their frames; a lossless source has one frame under way.
const MAX_ROTATIONS: usize = 64;

/// Limits and options of the open frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Keeping {
    /// Longest time for which a frame stays open, nanoseconds.
    pub(crate) deadline_ns: i64,
    /// Most held views without a record, of all frames.
    pub(crate) max_unanswered: usize,
    /// Most held best views of targets, of all frames.
    pub(crate) max_best: usize,
    /// Whether the pixels of views are used.
    pub(crate) keeps_pixels: bool,
    /// Whether regions of interest are measured before they are searched.
    pub(crate) keeps_regions: bool,
    /// Whether places that look like a body are searched for targets that were not measured.
    pub(crate) keeps_places: bool,
}

#[derive(Debug)]
pub(crate) struct Frames<P> {
    pub(crate) keeping: Keeping,
    frames: BTreeMap<FrameOrder, OpenFrame<P>>,
    /// The last plans of this process, which numbers them from 1.
    plans: BTreeMap<u64, Rc<Plan>>,
    /// Number of the last one, equal to the number of plans made.
    pub(crate) newest_plan: u64,
    /// The last complete frame. It and all before it accept nothing more.
    pub(crate) last_complete: Option<FrameOrder>,
    /// The newest frame with a view.
    pub(crate) newest: Option<FrameStamp>,
    /// The newest frame in which each target's pose was published by the previous process.
    published_before: Vec<Option<FrameOrder>>,
    /// Rotations of the camera for frames that are not complete.
    rotations: VecDeque<Rotation>,
    /// Number of regions of interest that have arrived.
    arrivals: u64,
}

impl<P: AsRef<[u8]>> Frames<P> {
    /// Creates the state without an open frame, for `targets` targets.
    pub(crate) fn new(keeping: Keeping, targets: usize) -> Self {
        Self {
            keeping,
            frames: BTreeMap::new(),
            plans: BTreeMap::new(),
            newest_plan: 0,
            last_complete: None,
            newest: None,
            published_before: vec![None; targets],
            rotations: VecDeque::new(),
            arrivals: 0,
        }
    }

    /// Records a plan of this process.
    pub(crate) fn note_plan(&mut self, plan_id: u64, plan: &Plan) {
        self.newest_plan = plan_id;
        self.plans.insert(plan_id, Rc::new(plan.clone()));
        while self.plans.len() > REMEMBERED_PLANS {
            self.plans.pop_first();
        }
    }

    /// Number of views in a plan, if it is still kept.
    pub(crate) fn views_of_plan(&self, plan_id: u64) -> Option<usize> {
        self.plans.get(&plan_id).map(|plan| plan.views.len())
    }

    /// Marks this frame, and all before it, as complete: another process has ended them.
    pub(crate) fn begin_after(&mut self, ended: Option<FrameOrder>) {
        self.last_complete = self.last_complete.max(ended);
    }

    /// Records that the previous process has published a target's pose in this frame. Its earlier
    /// poses are not known, so no earlier frame is published again.
    pub(crate) fn note_published_before(&mut self, target: usize, order: Option<FrameOrder>) {
        if let Some(before) = self.published_before.get_mut(target) {
            *before = (*before).max(order);
        }
    }

    /// The newest frame in which a target's pose was published, if such frames may still be open.
    pub(crate) fn last_published(&self, target: usize) -> Option<FrameOrder> {
        let mut newest_first = self.frames.iter().rev();
        let newest = newest_first.find(|(_, frame)| is_published(&frame.parts, target));
        let before = self.published_before.get(target).copied().flatten();
        newest.map(|(order, _)| *order).max(before)
    }

    /// Number of frames that await messages.
    pub(crate) fn count(&self) -> usize {
        self.waiting().count()
    }

    /// The frames that await messages.
    fn waiting(&self) -> impl Iterator<Item = &OpenFrame<P>> {
        self.frames.values().filter(|frame| frame.phase == Phase::Open)
    }

    /// Whether a frame, or a later one, is complete or has ended.
    pub(crate) fn is_past(&self, stamp: &FrameStamp) -> bool {
        self.last_complete.is_some_and(|last| stamp.order() <= last)
    }

    /// A frame that awaits messages.
    pub(crate) fn waiting_frame(&self, order: FrameOrder) -> Option<&OpenFrame<P>> {
        self.get(order).filter(|frame| frame.phase == Phase::Open)
    }

    /// A frame that has not ended.
    pub(crate) fn get(&self, order: FrameOrder) -> Option<&OpenFrame<P>> {
        self.frames.get(&order)
    }

    /// A frame that has not ended, mutable.
    pub(crate) fn get_mut(&mut self, order: FrameOrder) -> Option<&mut OpenFrame<P>> {
        self.frames.get_mut(&order)
    }

    /// The frame with this stamp, opened if needed; `None` if it accepts nothing more.
    fn open(&mut self, stamp: &FrameStamp, plan_id: u64, now_ns: i64) -> Option<&mut OpenFrame<P>> {
        if self.is_past(stamp) {
            return None;
        }
        let order = stamp.order();
        Some(self.frames.entry(order).or_insert_with(|| {
            let has_left = |target: usize| self.published_before[target] >= Some(order);
            let parts = parts_of(self.published_before.len(), has_left);
            let plan = self.plans.get(&plan_id).cloned();
            OpenFrame::new(*stamp, plan_id, plan, now_ns + self.keeping.deadline_ns, parts)
        }))
    }

    /// Adds a view that was cut. False if its frame accepts nothing more.
    pub(crate) fn add_view(&mut self, header: ViewHeader, pixels: P, now_ns: i64) -> bool {
        let (keeping, arrival) = (self.keeping, self.arrivals);
        let Some(frame) = self.open(&header.stamp, header.plan_id, now_ns) else { return false };
        frame.views.insert(header.view_index, header);
        let purpose = purpose_of(&header);
        if keeping.keeps_pixels {
            // A proposal without a place is not searched.
            let has_place = search_of(&header) != Search::Nothing;
            if keeping.keeps_places && purpose == Some(Purpose::Proposal) && has_place {
                frame.places.add(header, pixels.as_ref());
            }
            frame.held.add(header, pixels);
            if keeping.keeps_regions && matches!(purpose, Some(Purpose::Roi(_))) {
                frame.regions.push_back((arrival, header.view_index));
                self.arrivals += 1;
            }
        }
        if self.newest.is_none_or(|newest| !header.stamp.is_late_beside(&newest)) {
            self.newest = Some(header.stamp);
        }
        self.release_surplus();
        true
    }

    /// Adds the record of a view, and returns its frame. `None` if it is not awaited: its frame
    /// accepts nothing more, or another worker has answered before.
    pub(crate) fn add_record(&mut self, record: Record, now_ns: i64) -> Option<&mut OpenFrame<P>> {
        let header = record.header;
        let frame = self.open(&header.stamp, header.plan_id, now_ns)?;
        if frame.records.contains_key(&header.view_index) {
            return None;
        }
        frame.records.insert(header.view_index, record);
        Some(frame)
    }

    /// Records that rectification has finished a frame.
    pub(crate) fn add_end(&mut self, end: FrameEnd, now_ns: i64) {
        if let Some(frame) = self.open(&end.stamp, end.plan_id, now_ns) {
            frame.end = Some(end);
        }
    }

    /// Keeps a rotation of the camera until its frame is complete.
    pub(crate) fn add_rotation(&mut self, rotation: Rotation) {
        self.rotations.push_back(rotation);
        if self.rotations.len() > MAX_ROTATIONS {
            self.rotations.pop_front();
        }
    }

    /// Removes and returns the next rotation up to a frame.
    pub(crate) fn take_rotation(&mut self, until: FrameOrder) -> Option<Rotation> {
        let is_due = self.rotations.front().is_some_and(|next| next.stamp.order() <= until);
        if is_due { self.rotations.pop_front() } else { None }
    }

    /// Whether one more view would release the oldest that waits for its record.
    pub(crate) fn is_full(&self) -> bool {
        self.unanswered() >= self.keeping.max_unanswered
    }

    fn unanswered(&self) -> usize {
        self.frames.values().map(|frame| frame.held.unanswered.len()).sum()
    }

    /// Records the scores of a view whose record has arrived. If it `waits`, a region of interest
    /// stays held until its direct pass.
    pub(crate) fn answer(
        &mut self,
        order: FrameOrder,
        view_index: u32,
        shows: Vec<(usize, ViewQuality)>,
        waits: bool,
    ) {
        let Some(frame) = self.frames.get_mut(&order) else { return };
        if waits && frame.regions.iter().any(|(_, region)| *region == view_index) {
            frame.unseen.push((view_index, shows));
        } else {
            frame.held.answered(view_index, &shows);
        }
        self.release_surplus();
    }

    /// Removes and returns up to `most` regions of interest of a frame that arrived before those of
    /// other frames.
    pub(crate) fn take_regions(&mut self, order: FrameOrder, most: usize) -> Vec<u32> {
        let others = self.frames.iter().filter(|(other, _)| **other != order);
        let others = others.filter_map(|(_, frame)| frame.regions.front());
        let until = others.map(|(arrival, _)| *arrival).min().unwrap_or(u64::MAX);
        let Some(frame) = self.frames.get_mut(&order) else { return Vec::new() };
        let due = frame.regions.iter().take_while(|(arrival, _)| *arrival < until).take(most);
        let due = due.count();
        frame.regions.drain(..due).map(|(_, view_index)| view_index).collect()
    }

    /// Records the scores of those views of a frame that waited for the direct pass.
    pub(crate) fn answer_seen(&mut self, order: FrameOrder) {
        let Some(frame) = self.frames.get_mut(&order) else { return };
        for (view_index, shows) in std::mem::take(&mut frame.unseen) {
            self.answer(order, view_index, shows, true);
        }
    }

    /// Releases surplus views: the oldest of those without a record, and of the others those of
    /// newer frames. So the targets of a stalled frame keep their pixels.
    fn release_surplus(&mut self) {
        while self.unanswered() > self.keeping.max_unanswered {
            self.frames.values_mut().any(|frame| frame.held.unanswered.pop_first().is_some());
        }
        let best = |frame: &OpenFrame<P>| frame.held.best.len();
        while self.frames.values().map(best).sum::<usize>() > self.keeping.max_best {
            self.frames.values_mut().rev().any(|frame| frame.held.best.pop_last().is_some());
        }
        let places = |frame: &OpenFrame<P>| frame.places.views.len();
        while self.frames.values().map(places).sum::<usize>() > MAX_PLACES {
            self.frames.values_mut().rev().any(|frame| frame.places.views.pop_last().is_some());
        }
    }

    pub(crate) fn next_work(&self, now_ns: i64) -> Option<Work> {
        let works = self.frames.values().filter_map(OpenFrame::next_work);
        works.chain(self.completion(now_ns)).min()
    }

    /// Whether the oldest waiting frame need not wait any longer.
    fn completion(&self, now_ns: i64) -> Option<Work> {
        let oldest = self.waiting().next()?;
        let is_overdue = now_ns >= oldest.deadline_ns || self.count() > MAX_OPEN_FRAMES;
        // A frame without a plan of this process was under way when the process began.
        let is_partial = !(1..=self.newest_plan).contains(&oldest.plan_id)
            && self.waiting().any(OpenFrame::is_whole);
        let is_whole = oldest.is_whole();
        let is_complete = is_whole || is_overdue || is_partial;
        let (order, is_overdue) = (oldest.stamp.order(), is_overdue && !is_whole);
        is_complete.then_some(Work::CompleteFrame { order, is_overdue })
    }

    /// Ends the wait for messages of a frame.
    pub(crate) fn complete(&mut self, order: FrameOrder) {
        if let Some(frame) = self.frames.get_mut(&order) {
            frame.phase = Phase::Complete;
            self.last_complete = Some(order);
        }
    }

    /// Marks a frame as measured, except for places.
    pub(crate) fn set_measured(&mut self, order: FrameOrder) {
        if let Some(frame) = self.frames.get_mut(&order) {
            frame.phase = Phase::Measured;
        }
    }

    pub(crate) fn end(&mut self, order: FrameOrder) -> Option<OpenFrame<P>> {
        self.frames.remove(&order)
    }

    /// Deadline of the oldest frame, nanoseconds.
    pub(crate) fn next_deadline_ns(&self) -> Option<i64> {
        self.waiting().next().map(|frame| frame.deadline_ns)
    }
}

#[cfg(test)]
mod tests;
