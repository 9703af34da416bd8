//! Search plans: where to look in the next frame, in which order, and when to stop.
//!
//! The orders are plain functions ([`greedy`], [`optimized`], [`least_recently_searched`],
//! [`gaze_view`]); a [`Planner`] makes a [`Plan`] of them, from what [`Searched`] remembers.

mod gaze;
mod searched;
mod sweep;

pub use gaze::{GazeOptions, PredictedNeighbour, gaze_view};
pub use searched::Searched;
pub use sweep::least_recently_searched;

use nalgebra::Vector3;

use crate::mask::Mask;
use crate::partition::Partition;
use crate::view::View;

/// How a frame is searched.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SearchMode {
    /// The paper's baseline: partitions in a fixed order until the first hit.
    Greedy,
    /// The paper's Algorithm 1: [`optimized`].
    Optimized,
    /// Every partition of every frame.
    Exhaustive,
    /// Magnified views at the predicted neighbours first, then partitions, least recently
    /// searched first.
    Gaze,
}

/// When no further view of a plan is cut.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StopRule {
    /// After the first view that holds a marker of a configured body.
    FirstHit,
    /// After the last view.
    All,
    /// When a newer frame is there or due; in a lossless run after [`Plan::view_budget`] views.
    Deadline,
}

/// Why a view is planned.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// To search this partition.
    Partition(usize),
    /// To follow this target: the number of its body.
    Gaze(usize),
}

/// One view of a plan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlannedView {
    /// What to cut.
    pub view: View,
    /// Why.
    pub purpose: Purpose,
    /// How the view turns with what it follows: rotation vector a second, in the camera frame,
    /// radians/s. Zero for partitions.
    pub rate_in_camera: Vector3<f64>,
}

/// Where to look in a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The views, in the order in which they are to be cut.
    pub views: Vec<PlannedView>,
    /// When to stop.
    pub stop_rule: StopRule,
    /// How many of them a lossless run cuts, where time must not decide.
    pub view_budget: usize,
}

/// The paper's baseline (Table "Search Algorithm Comparison"): every partition in a fixed order.
pub fn greedy(partition: &Partition) -> Vec<usize> {
    (0..partition.len()).collect()
}

/// The paper's Algorithm 1, "Optimized Sphere Partition Search", for one frame.
///
/// `n` is the partition of the last detection: one for the whole swarm. As long as there was none,
/// all partitions are parsed in their fixed order. Then `all_parts[n]` is searched first, and if
/// nothing is found the others, sorted by their distance from it (`sort_by_dist`), the lower number
/// first in a tie.
///
/// The listing goes on after a hit, the text does not: "the algorithm is content with finding the
/// first set of markers it finds". So the order goes with [`StopRule::FirstHit`], and the partition
/// of that hit is the next frame's `n` ([`Searched::hit`]).
pub fn optimized(partition: &Partition, n: Option<usize>) -> Vec<usize> {
    let all_parts = greedy(partition);
    let Some(n) = n.filter(|&n| n < partition.len()) else {
        return all_parts;
    };
    let mut sorted_parts = all_parts;
    let middle = partition.directions()[n];
    // The one at distance zero, n itself, comes first. The sort is stable: ties stay by number.
    // Rounded, so that rounding errors do not break the ties of a regular solid.
    sorted_parts
        .sort_by_key(|&part| (partition.directions()[part].angle(&middle) * 1e9).round() as i64);
    sorted_parts
}

/// Makes the plan for each frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Planner {
    mode: SearchMode,
    partition: Partition,
    /// Those of the partition, then the far ones.
    views: Vec<View>,
    /// Views of which the camera sees nothing.
    hidden: Vec<bool>,
    mask: Option<Mask>,
    gaze: GazeOptions,
}

/// Why a planner could not be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum PlannerError {
    /// The views are not those of the partition.
    #[error("{views} views for {partitions} partitions: there must be one for each")]
    Views {
        /// Views given.
        views: usize,
        /// Partitions there are.
        partitions: usize,
    },
    /// An option of the gaze mode is out of its range.
    #[error("gaze option {name} is {value}: {cure}")]
    Gaze {
        /// The field of [`GazeOptions`].
        name: &'static str,
        /// Its value.
        value: f64,
        /// What would be right.
        cure: &'static str,
    },
}

impl Planner {
    /// A planner for `mode`; `views` are the partition's own ([`Partition::views`]).
    ///
    /// # Errors
    /// Views that are not one for each partition; gaze options out of range.
    pub fn new(
        mode: SearchMode,
        partition: Partition,
        views: Vec<View>,
        gaze: GazeOptions,
    ) -> Result<Self, PlannerError> {
        if views.len() != partition.len() {
            return Err(PlannerError::Views { views: views.len(), partitions: partition.len() });
        }
        gaze.check()?;
        let hidden = vec![false; views.len()];
        Ok(Self { mode, partition, views, hidden, mask: None, gaze })
    }

    /// Sweeps the sphere in the mode [`SearchMode::Gaze`] with these views too, which show it at a
    /// higher resolution, for neighbours that are too far for the partition's own. As
    /// [`Purpose::Partition`] they are numbered behind those.
    pub fn with_far_views(mut self, far_views: Vec<View>) -> Self {
        self.views.truncate(self.partition.len());
        self.views.extend(far_views);
        self.hide();
        self
    }

    /// How many views [`Purpose::Partition`] numbers: what [`Searched`] is to remember.
    pub fn sweep_len(&self) -> usize {
        self.views.len()
    }

    /// Plans no view in which `mask` hides everything.
    pub fn with_mask(mut self, mask: Mask) -> Self {
        self.mask = Some(mask);
        self.hide();
        self
    }

    fn hide(&mut self) {
        let is_hidden = |view| self.mask.as_ref().is_some_and(|mask| mask.hides_view(view));
        self.hidden = self.views.iter().map(is_hidden).collect();
    }

    /// How many partitions are never searched, because the camera sees nothing of them.
    pub fn hidden_partitions(&self) -> usize {
        self.hidden.iter().take(self.partition.len()).filter(|&&is_hidden| is_hidden).count()
    }

    /// The partition that is searched.
    pub fn partition(&self) -> &Partition {
        &self.partition
    }

    /// The plan for the next frame. `neighbours` counts in the mode [`SearchMode::Gaze`] alone.
    ///
    /// The same arguments always give the same plan.
    pub fn plan(&self, searched: &Searched, neighbours: &[PredictedNeighbour]) -> Plan {
        let whole = |order: Vec<usize>, stop_rule| {
            let views = self.partition_views(&order);
            Plan { view_budget: views.len(), views, stop_rule }
        };
        match self.mode {
            SearchMode::Greedy => whole(greedy(&self.partition), StopRule::FirstHit),
            SearchMode::Optimized => {
                whole(optimized(&self.partition, searched.last_hit()), StopRule::FirstHit)
            }
            SearchMode::Exhaustive => whole(greedy(&self.partition), StopRule::All),
            SearchMode::Gaze => self.gaze_plan(searched, neighbours),
        }
    }

    /// One view for each neighbour, least recently looked at first (ties by the neighbours' own
    /// order), then the partitions, least recently searched first, in turn with the far views.
    ///
    /// Where there are more than [`GazeOptions::views_before_partition`] neighbours, the first
    /// partition comes right after so many of their views: however many neighbours there are, a
    /// frame with time for one view more than that searches at least one partition, so all
    /// N are searched within N such frames, and a neighbour left out comes first in the next.
    fn gaze_plan(&self, searched: &Searched, neighbours: &[PredictedNeighbour]) -> Plan {
        let mut gazes: Vec<PlannedView> =
            neighbours.iter().filter_map(|neighbour| gaze_view(neighbour, &self.gaze)).collect();
        if let Some(mask) = &self.mask {
            gazes.retain(|planned| !mask.hides_view(&planned.view));
        }
        gazes.sort_by_key(|planned| searched.last_searched(planned.purpose));
        let seen = |parts: std::ops::Range<usize>| parts.filter(|&part| !self.hidden[part]);
        let near = self.partition.len();
        let order = least_recently_searched(searched, seen(0..near), seen(near..self.views.len()));
        let partitions = self.partition_views(&order);
        let view_budget = gazes.len() + self.gaze.partitions_per_frame.min(partitions.len());
        let mut views = gazes;
        let early = views.len().min(self.gaze.views_before_partition);
        let (first, others) = partitions.split_at(partitions.len().min(1));
        views.splice(early..early, first.iter().copied());
        views.extend_from_slice(others);
        Plan { views, stop_rule: StopRule::Deadline, view_budget }
    }

    fn partition_views(&self, order: &[usize]) -> Vec<PlannedView> {
        order
            .iter()
            .filter(|&&part| !self.hidden[part])
            .map(|&part| PlannedView {
                view: self.views[part],
                purpose: Purpose::Partition(part),
                rate_in_camera: Vector3::zeros(),
            })
            .collect()
    }
}

#[cfg(test)]
mod tests;
