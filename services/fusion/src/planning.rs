//! Where to look in the next frame: what was searched when, and the plans that frames still follow.

use std::collections::{BTreeMap, BTreeSet};

use flockeye_contract::ViewHeader;
use flockeye_convert::purpose_of;
use flockeye_geometry::filter::Prediction;
use flockeye_geometry::search::{
    Plan, Planner, PredictedNeighbour, Purpose, Search, Searched, StopRule,
};

use crate::frame_assembly::{Frame, Record};
use crate::snapshot::SavedPlanning;
use crate::tracker::Tracker;

/// Why each view of a frame was cut, by the view's place in the plan.
pub type Purposes = BTreeMap<u32, Purpose>;

/// Plans that are remembered, for frames that still follow them.
const REMEMBERED_PLANS: usize = 16;

/// A longer time between two frames is not expected to repeat, seconds.
const MAX_INTERVAL_S: f64 = 0.25;

/// Makes the plans, and remembers what they were for.
#[derive(Debug)]
pub struct Planning {
    planner: Planner,
    searched: Searched,
    remembered: BTreeMap<u64, (Purposes, StopRule)>,
    plan_id: u64,
    /// How many frames have ended.
    frames: u64,
    /// When the last frame was exposed, seconds.
    last_s: Option<f64>,
    /// The time between the last two frames, seconds.
    interval_s: f64,
}

/// The plan for the next frame.
#[derive(Debug, Clone)]
pub struct NextPlan {
    /// Its number; this process numbers its plans from 1.
    pub plan_id: u64,
    /// Where to look.
    pub plan: Plan,
    /// Where each tracked target will be, by its number.
    pub predictions: BTreeMap<usize, Prediction>,
    /// Targets whose regions of interest need not be searched for markers.
    pub unsearched: BTreeSet<usize>,
}

impl Planning {
    /// Nothing was searched yet.
    pub fn new(planner: Planner) -> Self {
        let searched = planner.nothing_searched();
        Self {
            planner,
            searched,
            remembered: BTreeMap::new(),
            plan_id: 0,
            frames: 0,
            last_s: None,
            interval_s: 1.0 / 30.0,
        }
    }

    /// Where the search is, for a successor.
    pub fn saved(&self) -> SavedPlanning {
        SavedPlanning {
            searched: self.searched.clone(),
            frames: self.frames,
            last_s: self.last_s,
            interval_s: self.interval_s,
        }
    }

    /// Goes on with another process's search, if it searched the same tiles.
    pub fn resume(&mut self, saved: SavedPlanning) {
        let mut times = [Some(saved.interval_s), saved.last_s].into_iter().flatten();
        if self.searched.has_tiles_of(&saved.searched) && times.all(f64::is_finite) {
            let SavedPlanning { searched, frames, last_s, interval_s } = saved;
            (self.searched, self.frames) = (searched, frames);
            (self.last_s, self.interval_s) = (last_s, interval_s);
        }
    }

    /// How many frames have ended.
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// How many plans were made.
    pub fn plans(&self) -> u64 {
        self.plan_id
    }

    /// Notes that a view was cut. It will be searched, so plans that are made meanwhile need not ask for
    /// it again.
    pub fn note_cut(&mut self, purpose: Purpose, search: Search) {
        self.searched.record(self.frames, purpose);
        self.searched.record_window(purpose, search);
    }

    /// Why a view was cut: as planned or, where rectification followed no plan of this process, as the
    /// view itself states.
    pub fn purpose_of(
        &self,
        plan_id: u64,
        view_index: u32,
        view: Option<&ViewHeader>,
    ) -> Option<Purpose> {
        match self.remembered.get(&plan_id) {
            Some((purposes, _)) => purposes.get(&view_index).copied(),
            None => view.and_then(purpose_of),
        }
    }

    /// How many views a plan has, as far as it is remembered.
    pub fn views_of(&self, plan_id: u64) -> Option<usize> {
        self.remembered.get(&plan_id).map(|(purposes, _)| purposes.len())
    }

    /// The stop rule of a plan.
    pub fn stop_rule_of(&self, plan_id: u64) -> StopRule {
        self.remembered.get(&plan_id).map_or(StopRule::All, |(_, stop_rule)| *stop_rule)
    }

    /// Why each view of a frame was cut, and when the search stopped.
    pub fn purposes_of(&self, frame: &Frame) -> (Purposes, StopRule) {
        self.remembered.get(&frame.plan_id).cloned().unwrap_or_else(|| {
            let stated = frame.views.iter();
            let stated = stated.filter_map(|(index, view)| Some((*index, purpose_of(view)?)));
            (stated.collect(), StopRule::All)
        })
    }

    /// Ends a frame: notes what was searched and hit in it.
    pub fn end_frame(&mut self, frame: &Frame, counted: &[&Record], purposes: &Purposes) {
        // Views that came were noted when they did.
        for index in frame.records.keys().filter(|index| !frame.views.contains_key(index)) {
            if let Some(&purpose) = purposes.get(index) {
                self.searched.record(self.frames, purpose);
            }
        }
        let first_hit = counted.iter().find(|record| record.header.hits > 0);
        if let Some(&purpose) = first_hit.and_then(|record| purposes.get(&record.header.view_index))
        {
            self.searched.hit(purpose);
        }
        let at_s = frame.stamp.exposure_s();
        if let Some(interval_s) = self.last_s.map(|last_s| at_s - last_s)
            && (0.0..MAX_INTERVAL_S).contains(&interval_s)
        {
            self.interval_s = interval_s;
        }
        self.last_s = Some(at_s);
        self.frames += 1;
    }

    /// Makes the plan for the next frame, and remembers it.
    pub fn next(&mut self, tracker: &Tracker) -> NextPlan {
        let (plan, predictions) = self.plan(tracker);
        self.plan_id += 1;
        let purposes =
            plan.views.iter().zip(0..).map(|(view, index)| (index, view.purpose)).collect();
        self.remembered.insert(self.plan_id, (purposes, plan.stop_rule));
        while self.remembered.len() > REMEMBERED_PLANS {
            self.remembered.pop_first();
        }
        let targets = 0..tracker.targets().len();
        let unsearched = targets.filter(|&target| tracker.needs_no_markers(target)).collect();
        NextPlan { plan_id: self.plan_id, plan, predictions, unsearched }
    }

    fn plan(&self, tracker: &Tracker) -> (Plan, BTreeMap<usize, Prediction>) {
        let next_s = self.last_s.map_or(0.0, |last_s| last_s + self.interval_s);
        let predictions: BTreeMap<usize, Prediction> = tracker.predictions(next_s).collect();
        let predicted: Vec<PredictedNeighbour> = predictions
            .iter()
            .filter_map(|(&target, prediction)| {
                PredictedNeighbour::from_pose(
                    target,
                    &tracker.targets()[target].body,
                    &prediction.camera_from_markers,
                    &prediction.pose_covariance().fixed_view::<3, 3>(0, 0).into_owned(),
                    &prediction.apparent_velocity(),
                )
            })
            .collect();
        (self.planner.plan(&self.searched, &predicted), predictions)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::expect_used)]
    use super::*;
    use crate::fixtures::{alpha, planner, tracker_of};

    #[test]
    fn a_tile_that_is_being_searched_is_not_asked_for_again() {
        let tracker = tracker_of(vec![alpha()], 1);
        let mut planning = Planning::new(planner());
        // The frame that is searched has not ended when the next plans are made.
        let mut asked = BTreeSet::new();
        for _ in 0..5 {
            let next = planning.next(&tracker).plan.views[0].purpose;
            planning.note_cut(next, Search::FineWindow);
            asked.insert(format!("{next:?}"));
        }
        assert_eq!(asked.len(), 5, "{asked:?}");
    }

    #[test]
    fn old_plans_are_forgotten() {
        let tracker = tracker_of(vec![alpha()], 1);
        let mut planning = Planning::new(planner());
        (0..100).for_each(|_| drop(planning.next(&tracker)));
        assert_eq!(planning.remembered.len(), REMEMBERED_PLANS);
        assert_eq!(planning.purpose_of(100, 0, None), Some(Purpose::Partition(0)));
        assert_eq!(planning.purpose_of(1, 0, None), None);
    }
}
