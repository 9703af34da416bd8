//! A frame as one value, from the first message about it until its end: its phase, views, records,
//! and each target's part in it.

pub(crate) mod frames;
pub(crate) mod parts;
pub(crate) mod places;
pub(crate) mod views;

use std::collections::{BTreeMap, VecDeque};
use std::rc::Rc;

use flockeye_contract::{FrameEnd, FrameStamp, ViewHeader};
use flockeye_convert::purpose_of;
use flockeye_geometry::search::{Plan, Purpose, StopRule};

use self::parts::{Part, unpublished};
use self::places::Places;
use self::views::{HeldViews, ViewQuality};
use crate::output::Outgoing;
use crate::record::Record;
use crate::target::Target;
use crate::work::Work;

/// Phase of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Phase {
    /// Views, records or its end may still arrive.
    Open,
    /// No more messages are awaited, and its targets await their last measurement.
    Complete,
    /// Its targets are measured, except those at places that look like a body.
    Measured,
}

/// A frame that has not ended, with `P` the hold on a view's pixels.
#[derive(Debug)]
pub(crate) struct OpenFrame<P> {
    pub(crate) stamp: FrameStamp,
    /// Its phase.
    pub(crate) phase: Phase,
    /// The views that have arrived, by their place in the plan.
    pub(crate) views: BTreeMap<u32, ViewHeader>,
    pub(crate) records: BTreeMap<u32, Record>,
    /// Its end message from rectification, once it has arrived.
    pub(crate) end: Option<FrameEnd>,
    /// Views whose pixels are still needed.
    pub(crate) held: HeldViews<P>,
    /// Views of places that look like a body.
    pub(crate) places: Places,
    pub(crate) parts: Vec<Part>,
    /// Number of the plan that it follows; 0: rectification swept on its own.
    plan_id: u64,
    /// The plan that the frame follows, if this process made it.
    plan: Option<Rc<Plan>>,
    deadline_ns: i64,
    /// Regions of interest that wait for the direct pass: their arrivals, which rise with each
    /// region of any frame, and their places in the plan.
    regions: VecDeque<(u64, u32)>,
    /// Records that wait for the corner pass over their regions, by the views' places in the plan.
    pub(crate) searched: Vec<u32>,
    /// Views whose records arrived before their direct pass, with their scores for targets.
    unseen: Vec<(u32, Vec<(usize, ViewQuality)>)>,
    /// Results of direct passes that wait until the frame is complete.
    pub(crate) found: Vec<Outgoing>,
}

impl<P> OpenFrame<P> {
    fn new(
        stamp: FrameStamp,
        plan_id: u64,
        plan: Option<Rc<Plan>>,
        deadline_ns: i64,
        parts: Vec<Part>,
    ) -> Self {
        Self {
            stamp,
            phase: Phase::Open,
            views: BTreeMap::new(),
            records: BTreeMap::new(),
            end: None,
            held: HeldViews::default(),
            places: Places::default(),
            parts,
            plan_id,
            plan,
            deadline_ns,
            regions: VecDeque::new(),
            searched: Vec::new(),
            unseen: Vec::new(),
            found: Vec::new(),
        }
    }

    /// Whether its end has arrived and every issued view was answered.
    fn is_whole(&self) -> bool {
        self.end.is_some_and(|end| {
            self.records.range(..end.views_issued).count() == end.views_issued as usize
        })
    }

    /// The next work in it, as far as that does not depend on the time and on other frames.
    fn next_work(&self) -> Option<Work> {
        let order = self.stamp.order();
        if let Some((arrival, _)) = self.regions.front() {
            return Some(Work::MeasureRegions { arrival: *arrival, order });
        }
        if !self.searched.is_empty() {
            return Some(Work::MeasureRecords { order });
        }
        match self.phase {
            Phase::Open => None,
            Phase::Complete => Some(Work::MeasureFrame { order }),
            Phase::Measured => Some(Work::SearchPlaces { order }),
        }
    }

    /// Purpose of a view: as planned or, where rectification followed no plan of this process, as
    /// the view itself states.
    pub(crate) fn purpose_of(&self, view_index: u32) -> Option<Purpose> {
        match &self.plan {
            Some(plan) => plan.views.get(view_index as usize).map(|view| view.purpose),
            None => self.views.get(&view_index).and_then(purpose_of),
        }
    }

    pub(crate) fn stop_rule(&self) -> StopRule {
        self.plan.as_ref().map_or(StopRule::All, |plan| plan.stop_rule)
    }

    /// The views whose records count, in plan order. With the rule `first_hit` those up to the
    /// first hit, because the number of searches beyond it depends on time.
    pub(crate) fn counted_views(&self) -> impl Iterator<Item = u32> {
        let mut records = self.records.iter();
        let is_last =
            |record: &Record| self.stop_rule() == StopRule::FirstHit && record.header.hits > 0;
        let last = records.find(|(_, record)| is_last(record)).map_or(u32::MAX, |(last, _)| *last);
        self.records.range(..=last).map(|(view_index, _)| *view_index)
    }

    /// Purposes of those views that were searched and have not arrived here.
    pub(crate) fn purposes_without_view(&self) -> impl Iterator<Item = Purpose> {
        let missing = self.records.keys().filter(|index| !self.views.contains_key(index));
        missing.filter_map(|index| self.purpose_of(*index))
    }

    /// Purpose of the first view with a marker.
    pub(crate) fn first_hit(&self) -> Option<Purpose> {
        let mut records = self.records.iter();
        let (view_index, _) = records.find(|(_, record)| record.header.hits > 0)?;
        self.purpose_of(*view_index)
    }

    /// Scores of a view for the `targets` of its region or of its markers. Targets whose pose in
    /// the frame was published need no view.
    pub(crate) fn qualities(
        &self,
        view_index: u32,
        targets: &[Target],
    ) -> Vec<(usize, ViewQuality)> {
        let (Some(record), Some(view)) =
            (self.records.get(&view_index), self.views.get(&view_index))
        else {
            return Vec::new();
        };
        let (purpose, stop_rule) = (self.purpose_of(view_index), self.stop_rule());
        let quality = |number: usize| {
            let target = &targets[number];
            let is_own = purpose == Some(Purpose::Roi(number));
            let is_followed = target.is_tracked() && !target.is_stale();
            let body = &target.body;
            let quality = ViewQuality::of(record, view, body, is_own, is_followed, stop_rule)?;
            Some((number, quality))
        };
        unpublished(&self.parts).filter_map(quality).collect()
    }

    /// Removes and returns the results of direct passes, by target, so that the order does not
    /// depend on their speed.
    pub(crate) fn take_found(&mut self) -> Vec<Outgoing> {
        let mut found = std::mem::take(&mut self.found);
        found.sort_by_key(|((target, _), _)| *target);
        found
    }

    /// Calls `by` with the frame and the targets' parts in it, which it may change.
    pub(crate) fn with_parts<T>(&mut self, by: impl FnOnce(&Self, &mut [Part]) -> T) -> T {
        let mut parts = std::mem::take(&mut self.parts);
        let made = by(self, &mut parts);
        self.parts = parts;
        made
    }
}
