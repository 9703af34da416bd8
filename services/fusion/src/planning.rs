//! The plan of the next frame, from the record of searches.

use std::collections::{BTreeMap, BTreeSet};

use flockeye_geometry::filter::MotionEstimate;
use flockeye_geometry::search::{Plan, Planner, PredictedNeighbour, Purpose, Search, Searched};
use serde::{Deserialize, Serialize};

use crate::tracker::Tracker;

/// Longest time between two frames that is expected to repeat, seconds.
const MAX_INTERVAL_S: f64 = 0.25;

/// State of the search. A successor continues it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Planning {
    /// Record of searches.
    searched: Searched,
    /// Number of ended frames.
    pub(crate) frames: u64,
    /// Exposure of the last frame, seconds.
    last_s: Option<f64>,
    /// The time between the last two frames, seconds.
    pub(crate) interval_s: f64,
}

/// The plan for the next frame.
#[derive(Debug, Clone)]
pub struct NextPlan {
    /// Its number; this process numbers its plans from 1.
    pub(crate) plan_id: u64,
    pub(crate) plan: Plan,
    /// Predicted place of each tracked target, by its number.
    pub(crate) predictions: BTreeMap<usize, MotionEstimate>,
    /// Targets whose regions of interest need not be searched for markers.
    pub(crate) unsearched: BTreeSet<usize>,
    /// The learned exponent of the camera's response.
    pub(crate) gamma: Option<f64>,
}

impl Planning {
    /// Creates the state before the first search.
    pub(crate) fn new(planner: &Planner) -> Self {
        let searched = planner.nothing_searched();
        Self { searched, frames: 0, last_s: None, interval_s: 1.0 / 30.0 }
    }

    /// Continues another process's search, if it had the same tiles.
    pub(crate) fn resume(&mut self, saved: Self) {
        let mut times = [Some(saved.interval_s), saved.last_s].into_iter().flatten();
        if self.searched.has_tiles_of(&saved.searched) && times.all(f64::is_finite) {
            *self = saved;
        }
    }

    /// Records that a view was cut. It will be searched, so plans made meanwhile need not request
    /// it again.
    pub(crate) fn note_cut(&mut self, purpose: Purpose, search: Search) {
        self.searched.record(self.frames, purpose);
        self.searched.record_window(purpose, search);
    }

    /// Ends a frame that was exposed at `at_s`, seconds. `unnoted` are purposes of searched views
    /// that were never recorded as cut, `hit` is that of the first view with a marker.
    pub(crate) fn end_frame(
        &mut self,
        at_s: f64,
        unnoted: impl Iterator<Item = Purpose>,
        hit: Option<Purpose>,
    ) {
        unnoted.for_each(|purpose| self.searched.record(self.frames, purpose));
        if let Some(purpose) = hit {
            self.searched.hit(purpose);
        }
        if let Some(interval_s) = self.last_s.map(|last_s| at_s - last_s)
            && (0.0..MAX_INTERVAL_S).contains(&interval_s)
        {
            self.interval_s = interval_s;
        }
        self.last_s = Some(at_s);
        self.frames += 1;
    }

    /// Makes the plan for the next frame, with this number.
    pub(crate) fn next(&self, planner: &Planner, plan_id: u64, tracker: &Tracker) -> NextPlan {
        let next_s = self.last_s.map_or(0.0, |last_s| last_s + self.interval_s);
        let predictions: BTreeMap<usize, MotionEstimate> = tracker.predictions(next_s).collect();
        let predicted: Vec<PredictedNeighbour> = predictions
            .iter()
            .filter_map(|(&target, prediction)| {
                let known = &tracker.targets()[target];
                let neighbour = PredictedNeighbour::from_pose(
                    target,
                    &known.body,
                    &prediction.camera_from_markers,
                    &prediction.pose_covariance().fixed_view::<3, 3>(0, 0).into_owned(),
                    &prediction.apparent_velocity(),
                )?;
                Some(PredictedNeighbour { is_stale: known.is_stale(), ..neighbour })
            })
            .collect();
        let plan = planner.plan(&self.searched, &predicted);
        let targets = 0..tracker.targets().len();
        let unsearched = targets.filter(|&target| tracker.needs_no_markers(target)).collect();
        let gamma = tracker.camera.response.gamma();
        NextPlan { plan_id, plan, predictions, unsearched, gamma }
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
        let planner = planner();
        let mut planning = Planning::new(&planner);
        // The frame that is searched has not ended when the next plans are made.
        let mut asked = BTreeSet::new();
        for _ in 0..5 {
            let next = planning.next(&planner, 1, &tracker).plan.views[0].purpose;
            planning.note_cut(next, Search::FineWindow);
            asked.insert(format!("{next:?}"));
        }
        assert_eq!(asked.len(), 5, "{asked:?}");
    }
}
