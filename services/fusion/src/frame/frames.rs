//! All open frames, in the order of their exposure.
//!
//! Messages about a frame come in whatever order. It is complete when rectification has ended it
//! and every view it issued is answered. A stage that died would leave it open for ever: after a
//! deadline it is taken as it is. So is, as soon as a newer one is whole, a frame that follows no
//! plan of this process: it was under way when the process began, which never receives what came
//! before.

use std::collections::{BTreeMap, VecDeque};

use flockeye_contract::{FrameEnd, FrameOrder, FrameStamp, Rotation, ViewHeader};
use flockeye_convert::{purpose_of, search_of};
use flockeye_geometry::search::{Plan, Purpose, Search};

use super::parts::Parts;
use super::plans::Plans;
use super::views::ViewQuality;
use super::{OpenFrame, Phase};
use crate::pictures::Pixels;
use crate::record::Record;
use crate::work::{Completion, Work};

/// Frames that may be open at once; beyond it the oldest is taken as it is.
const MAX_OPEN_FRAMES: usize = 8;
/// Views of places that are kept at most, of all frames.
const MAX_PLACES: usize = 128;
/// Rotations that wait for their frames, at most; a lossless source has one frame under way.
const MAX_ROTATIONS: usize = 64;

/// What frames keep, and how long.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Keeping {
    /// How long a frame stays open at most, nanoseconds.
    pub deadline_ns: i64,
    /// Views without a record that are held at most, of all frames.
    pub max_unanswered: usize,
    /// Best views of targets that are held at most, of all frames.
    pub max_best: usize,
    /// Whether the pixels of views are used.
    pub keeps_pixels: bool,
    /// Whether regions of interest are measured before they are searched.
    pub keeps_regions: bool,
    /// Whether places that look like a body are searched for targets of which nothing else is known.
    pub keeps_places: bool,
}

/// The open frames.
#[derive(Debug)]
pub struct Frames<P> {
    keeping: Keeping,
    frames: BTreeMap<FrameOrder, OpenFrame<P>>,
    plans: Plans,
    /// The last frame that is complete.
    last_complete: Option<FrameOrder>,
    /// The newest frame of which a view has come.
    newest: Option<FrameStamp>,
    /// The newest frame in which each target's pose has left the process before this one.
    published_before: Vec<Option<FrameOrder>>,
    /// How the camera has turned, for frames that are not complete.
    rotations: VecDeque<Rotation>,
    /// How many regions of interest have come.
    arrivals: u64,
}

impl<P: Pixels> Frames<P> {
    /// Starts without an open frame, for `targets` targets.
    pub fn new(keeping: Keeping, targets: usize) -> Self {
        Self {
            keeping,
            frames: BTreeMap::new(),
            plans: Plans::default(),
            last_complete: None,
            newest: None,
            published_before: vec![None; targets],
            rotations: VecDeque::new(),
            arrivals: 0,
        }
    }

    /// Notes a plan that this process made.
    pub fn note_plan(&mut self, plan_id: u64, plan: &Plan) {
        self.plans.add(plan_id, plan);
    }

    /// How many views a plan has, as far as it is remembered.
    pub fn views_of_plan(&self, plan_id: u64) -> Option<usize> {
        self.plans.get(plan_id).map(|plan| plan.purposes.len())
    }

    /// The last frame that is complete. It and all before it take nothing more.
    pub fn last_complete(&self) -> Option<FrameOrder> {
        self.last_complete
    }

    /// The newest frame of which a view has come.
    pub fn newest(&self) -> Option<&FrameStamp> {
        self.newest.as_ref()
    }

    /// Takes this frame, and all before it, as complete: another process has ended them.
    pub fn begin_after(&mut self, ended: Option<FrameOrder>) {
        self.last_complete = self.last_complete.max(ended);
    }

    /// The process before this one has published a target's pose in this frame. Which of the frames
    /// before it had a pose too is not known, so none is published again.
    pub fn note_published_before(&mut self, target: usize, order: Option<FrameOrder>) {
        if let Some(before) = self.published_before.get_mut(target) {
            *before = (*before).max(order);
        }
    }

    /// The newest frame in which a target's pose has left, as far as such frames may still be open.
    pub fn last_published(&self, target: usize) -> Option<FrameOrder> {
        let mut newest_first = self.frames.iter().rev();
        let newest = newest_first.find(|(_, frame)| frame.parts.is_published(target));
        let before = self.published_before.get(target).copied().flatten();
        newest.map(|(order, _)| *order).max(before)
    }

    /// How many frames wait for something.
    pub fn count(&self) -> usize {
        self.waiting().count()
    }

    /// The frames that wait for something.
    fn waiting(&self) -> impl Iterator<Item = &OpenFrame<P>> {
        self.frames.values().filter(|frame| frame.phase == Phase::Open)
    }

    /// Whether a frame is complete or has ended, or one behind it.
    pub fn is_past(&self, stamp: &FrameStamp) -> bool {
        self.last_complete.is_some_and(|last| stamp.order() <= last)
    }

    /// A frame that waits for something.
    pub fn waiting_frame(&self, order: FrameOrder) -> Option<&OpenFrame<P>> {
        self.get(order).filter(|frame| frame.phase == Phase::Open)
    }

    /// A frame that has not ended.
    pub fn get(&self, order: FrameOrder) -> Option<&OpenFrame<P>> {
        self.frames.get(&order)
    }

    /// A frame that has not ended, to be changed.
    pub fn get_mut(&mut self, order: FrameOrder) -> Option<&mut OpenFrame<P>> {
        self.frames.get_mut(&order)
    }

    /// The frame of this stamp, opened if need be; `None` if it takes nothing more.
    fn open(&mut self, stamp: &FrameStamp, plan_id: u64, now_ns: i64) -> Option<&mut OpenFrame<P>> {
        if self.is_past(stamp) {
            return None;
        }
        let order = stamp.order();
        Some(self.frames.entry(order).or_insert_with(|| {
            let is_published = |target: usize| self.published_before[target] >= Some(order);
            let parts = Parts::new(self.published_before.len(), is_published);
            let plan = self.plans.get(plan_id).cloned();
            OpenFrame::new(*stamp, plan_id, plan, now_ns + self.keeping.deadline_ns, parts)
        }))
    }

    /// Adds a view that was cut. False if its frame takes nothing more.
    pub fn add_view(&mut self, header: ViewHeader, pixels: P, now_ns: i64) -> bool {
        let (keeping, arrival) = (self.keeping, self.arrivals);
        let Some(frame) = self.open(&header.stamp, header.plan_id, now_ns) else { return false };
        frame.views.insert(header.view_index, header);
        let purpose = purpose_of(&header);
        if keeping.keeps_pixels {
            // A proposal for which there was no place is not searched.
            let has_place = search_of(&header) != Search::Nothing;
            if keeping.keeps_places && purpose == Some(Purpose::Proposal) && has_place {
                frame.places.add(header, pixels.pixels());
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

    /// Adds the record of a view, and gives its frame. `None` if nobody waits for it: its frame
    /// takes nothing more, or another worker has answered before.
    pub fn add_record(&mut self, record: Record, now_ns: i64) -> Option<&mut OpenFrame<P>> {
        let header = record.header;
        let frame = self.open(&header.stamp, header.plan_id, now_ns)?;
        if frame.records.contains_key(&header.view_index) {
            return None;
        }
        frame.records.insert(header.view_index, record);
        Some(frame)
    }

    /// Rectification is done with a frame.
    pub fn add_end(&mut self, end: FrameEnd, now_ns: i64) {
        if let Some(frame) = self.open(&end.stamp, end.plan_id, now_ns) {
            frame.end = Some(end);
        }
    }

    /// Keeps a rotation of the camera until its frame is complete.
    pub fn add_rotation(&mut self, rotation: Rotation) {
        self.rotations.push_back(rotation);
        if self.rotations.len() > MAX_ROTATIONS {
            self.rotations.pop_front();
        }
    }

    /// Takes out the next rotation up to a frame.
    pub fn take_rotation(&mut self, until: FrameOrder) -> Option<Rotation> {
        let is_due = self.rotations.front().is_some_and(|next| next.stamp.order() <= until);
        if is_due { self.rotations.pop_front() } else { None }
    }

    /// Whether one more view would release the oldest that waits for its record.
    pub fn is_full(&self) -> bool {
        self.unanswered() >= self.keeping.max_unanswered
    }

    fn unanswered(&self) -> usize {
        self.frames.values().map(|frame| frame.held.unanswered_count()).sum()
    }

    /// Notes what a view shows whose record has come. Where it `waits`, a region of interest stays
    /// held until the direct pass has seen it.
    pub fn answer(
        &mut self,
        order: FrameOrder,
        view_index: u32,
        shows: Vec<(usize, ViewQuality)>,
        waits: bool,
    ) {
        let Some(frame) = self.frames.get_mut(&order) else { return };
        if waits && frame.regions.iter().any(|(_, region)| *region == view_index) {
            frame.shown.push((view_index, shows));
        } else {
            frame.held.answered(view_index, &shows);
        }
        self.release_surplus();
    }

    /// Takes out regions of interest of a frame, `most` at once, that came before those of other
    /// frames.
    pub fn take_regions(&mut self, order: FrameOrder, most: usize) -> Vec<u32> {
        let others = self.frames.iter().filter(|(other, _)| **other != order);
        let others = others.filter_map(|(_, frame)| frame.regions.front());
        let until = others.map(|(arrival, _)| *arrival).min().unwrap_or(u64::MAX);
        let Some(frame) = self.frames.get_mut(&order) else { return Vec::new() };
        let due = frame.regions.iter().take_while(|(arrival, _)| *arrival < until).take(most);
        let due = due.count();
        frame.regions.drain(..due).map(|(_, view_index)| view_index).collect()
    }

    /// Notes what those views of a frame show that have waited for the direct pass.
    pub fn answer_seen(&mut self, order: FrameOrder) {
        let Some(frame) = self.frames.get_mut(&order) else { return };
        for (view_index, shows) in std::mem::take(&mut frame.shown) {
            self.answer(order, view_index, shows, true);
        }
    }

    /// Releases surplus views: the oldest of those without a record, and of the others those of
    /// newer frames. The targets of a stalled frame keep their pixels so.
    fn release_surplus(&mut self) {
        while self.unanswered() > self.keeping.max_unanswered {
            self.frames.values_mut().any(|frame| frame.held.release_unanswered());
        }
        let best = |frame: &OpenFrame<P>| frame.held.best_count();
        while self.frames.values().map(best).sum::<usize>() > self.keeping.max_best {
            self.frames.values_mut().rev().any(|frame| frame.held.release_best());
        }
        let places = |frame: &OpenFrame<P>| frame.places.count();
        while self.frames.values().map(places).sum::<usize>() > MAX_PLACES {
            self.frames.values_mut().rev().any(|frame| frame.places.drop_last());
        }
    }

    /// The most urgent work.
    pub fn next_work(&self, now_ns: i64) -> Option<Work> {
        let works = self.frames.values().filter_map(OpenFrame::next_work);
        works.chain(self.completion(now_ns)).min()
    }

    /// Whether the oldest frame that waits need not wait any more.
    fn completion(&self, now_ns: i64) -> Option<Work> {
        let oldest = self.waiting().next()?;
        let reason = if oldest.is_whole() {
            Completion::Whole
        } else if now_ns >= oldest.deadline_ns || self.count() > MAX_OPEN_FRAMES {
            Completion::Overdue
        } else if !self.plans.has_made(oldest.plan_id) && self.waiting().any(OpenFrame::is_whole) {
            Completion::Partial
        } else {
            return None;
        };
        Some(Work::CompleteFrame { order: oldest.stamp.order(), reason })
    }

    /// Waits for nothing more in a frame.
    pub fn complete(&mut self, order: FrameOrder) {
        if let Some(frame) = self.frames.get_mut(&order) {
            frame.phase = Phase::Complete;
            self.last_complete = Some(order);
        }
    }

    /// Whether places that look like a body are searched.
    pub fn keeps_places(&self) -> bool {
        self.keeping.keeps_places
    }

    /// Leaves nothing but places to be measured in a frame.
    pub fn set_measured(&mut self, order: FrameOrder) {
        if let Some(frame) = self.frames.get_mut(&order) {
            frame.phase = Phase::Measured;
        }
    }

    /// Ends a frame.
    pub fn end(&mut self, order: FrameOrder) -> Option<OpenFrame<P>> {
        self.frames.remove(&order)
    }

    /// When the oldest frame will be overdue, nanoseconds.
    pub fn next_deadline_ns(&self) -> Option<i64> {
        self.waiting().next().map(|frame| frame.deadline_ns)
    }
}

#[cfg(test)]
mod tests;
