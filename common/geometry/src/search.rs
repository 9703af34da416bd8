//! Search plans: the views of the next frame, their order, and when to stop.
//!
//! The orders are plain functions ([`greedy`], [`optimized`], [`least_recently_searched`],
//! [`roi_view`]); a [`Planner`] makes a [`Plan`] from them and from the record in [`Searched`].
//!
//! The sphere is covered by *tiles*, the partition's views, and beside them by *high-resolution
//! tiles* for neighbours at long range. A tracked neighbour has a *region of interest*, a small
//! view at its predicted place.

mod roi;
mod searched;
mod sweep;

pub use roi::{PredictedNeighbour, ROI_SIZE_MAX_PX, RoiOptions, roi_view};
pub use searched::Searched;
pub use sweep::least_recently_searched;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use crate::mask::Mask;
use crate::partition::Partition;
use crate::view::View;

/// Number of neighbours' views before the first partition: see [`Planner::plan`].
const VIEWS_BEFORE_PARTITION: usize = 4;

/// Order and selection of the views in a plan. The key `search.mode` selects it together with the
/// profile: without tracks `roi` has no prediction to look at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlanOrder {
    /// The paper's baseline: partitions in a fixed order until the first hit.
    Greedy,
    /// The paper's Algorithm 1: [`optimized`].
    Optimized,
    /// Every partition of every frame.
    Exhaustive,
    /// Magnified views at the predicted neighbours first, then the partitions that were searched
    /// longest ago.
    Roi,
}

/// Condition that ends the cutting of a plan's views.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StopRule {
    /// After the first view that holds a marker of a configured body.
    FirstHit,
    /// After the last view.
    All,
    /// When a newer frame is there or due; in a lossless run, after [`Plan::view_budget`] views.
    Deadline,
}

/// Purpose of a planned view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// To search this tile, by the index of its partition.
    Partition(usize),
    /// To search this high-resolution tile, by its own index from 0.
    HighResolution(usize),
    /// To follow this target, by the index of its body.
    Roi(usize),
    /// To look at a place that looks like a body. The stage that has the picture chooses the place.
    Proposal,
}

/// Detector setting for a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Search {
    /// With every threshold window of the detector.
    AllWindows,
    /// With its finest window alone.
    FineWindow,
    /// With its coarsest window alone.
    CoarseWindow,
    /// No search: only the pixels are needed.
    Nothing,
}

/// Half the field of a proposal's view, in radii of the possible body. The body's middle may be off
/// the place.
pub const PROPOSAL_FIELD_RADII: f64 = 1.7;

/// One view of a plan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SearchView {
    /// The view to cut.
    pub view: View,
    /// Its purpose.
    pub purpose: Purpose,
    /// Detector setting for the view.
    pub search: Search,
    /// Rotation of the view with its target: rotation vector a second, in the camera frame,
    /// radians/s. Zero for tiles.
    pub rate_in_camera: Vector3<f64>,
}

/// Plan for one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The views, in the order in which they are to be cut.
    pub views: Vec<SearchView>,
    /// Condition that ends the cutting.
    pub stop_rule: StopRule,
    /// Number of views that a lossless run cuts, because there time must not decide.
    pub view_budget: usize,
}

/// The paper's baseline (Table "Search Algorithm Comparison"): every partition in a fixed order.
pub fn greedy(partition: &Partition) -> Vec<usize> {
    (0..partition.len()).collect()
}

/// The paper's Algorithm 1, "Optimized Sphere Partition Search", for one frame.
///
/// `n` is the partition of the last detection: one for the whole swarm. Before the first detection,
/// all partitions are searched in their fixed order. Then `all_parts[n]` is searched first. If
/// nothing is found, the others follow by their distance from it (`sort_by_dist`), the lower number
/// first in a tie.
///
/// The paper's listing continues after a hit, its text does not: "the algorithm is content with
/// finding the first set of markers it finds". So the order goes with [`StopRule::FirstHit`], and
/// the partition of that hit is the next frame's `n` ([`Searched::hit`]).
pub fn optimized(partition: &Partition, n: Option<usize>) -> Vec<usize> {
    let all_parts = greedy(partition);
    let Some(n) = n.filter(|&n| n < partition.len()) else {
        return all_parts;
    };
    let mut sorted_parts = all_parts;
    let middle = partition.directions()[n];
    // Partition n itself, at distance zero, comes first. The sort is stable: ties stay by number.
    // Distances are rounded, so that rounding errors do not break the ties of a regular solid.
    sorted_parts
        .sort_by_key(|&part| (partition.directions()[part].angle(&middle) * 1e9).round() as i64);
    sorted_parts
}

/// Makes the plan for each frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Planner {
    order: PlanOrder,
    partition: Partition,
    /// The view of each partition; `None` where the camera sees nothing of it.
    tiles: Vec<Option<View>>,
    /// The view of each high-resolution tile, likewise.
    high_resolution: Vec<Option<View>>,
    mask: Option<Mask>,
    roi: RoiOptions,
    alternates_windows: bool,
    targets: usize,
    /// Number of views of places that look like bodies, in a frame while a target is not tracked.
    proposals: usize,
}

/// Number of frames without a tile after which one is searched in any case, so that untracked
/// targets are found.
pub const MAX_FRAMES_WITHOUT_TILE: u64 = 4;

/// Placeholder of a view in a plan whose place is not known yet. Where no place is found, it is cut
/// like this, at a negligible cost.
const UNPLACED: View = View {
    camera_from_view: UnitQuaternion::new_unchecked(Quaternion::new(1.0, 0.0, 0.0, 0.0)),
    focal_px: 16.0,
    size_px: 16,
};

/// A proposal in a plan.
const PROPOSAL: SearchView = SearchView {
    view: UNPLACED,
    purpose: Purpose::Proposal,
    search: Search::Nothing,
    rate_in_camera: Vector3::new(0.0, 0.0, 0.0),
};

/// Indices of the tiles of which the camera sees at least a part.
fn visible(tiles: &[Option<View>]) -> impl Iterator<Item = usize> {
    tiles.iter().enumerate().filter(|(_, view)| view.is_some()).map(|(index, _)| index)
}

/// Reason why a planner could not be made.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say what the fields are")]
pub enum PlannerError {
    /// The number of views differs from the number of partitions.
    #[error("{views} views for {partitions} partitions: there must be one for each")]
    Views { views: usize, partitions: usize },
    /// An option of the mode roi is out of its range.
    #[error("option of the mode roi, {name} is {value}: {cure}")]
    Roi { name: &'static str, value: f64, cure: &'static str },
}

impl Planner {
    /// A planner for `mode`; `views` are the partition's own ([`Partition::views`]).
    ///
    /// # Errors
    /// Views that are not one for each partition; options of the mode roi out of range.
    pub fn new(
        order: PlanOrder,
        partition: Partition,
        views: Vec<View>,
        roi: RoiOptions,
    ) -> Result<Self, PlannerError> {
        if views.len() != partition.len() {
            return Err(PlannerError::Views { views: views.len(), partitions: partition.len() });
        }
        roi.check()?;
        Ok(Self {
            order,
            partition,
            tiles: views.into_iter().map(Some).collect(),
            high_resolution: Vec::new(),
            mask: None,
            roi,
            alternates_windows: false,
            targets: 0,
            proposals: 0,
        })
    }

    /// With [`PlanOrder::Roi`], also sweeps the sphere with these views of a higher
    /// resolution, for neighbours that are too far for the partition's own.
    pub fn with_high_resolution_tiles(mut self, views: Vec<View>) -> Self {
        let is_hidden = |view: &View| self.mask.as_ref().is_some_and(|mask| mask.hides_view(view));
        self.high_resolution =
            views.into_iter().map(|view| (!is_hidden(&view)).then_some(view)).collect();
        self
    }

    /// Plans no view in which `mask` hides everything.
    pub fn with_mask(mut self, mask: Mask) -> Self {
        for tile in self.tiles.iter_mut().chain(&mut self.high_resolution) {
            *tile = tile.filter(|view| !mask.hides_view(view));
        }
        self.mask = Some(mask);
        self
    }

    /// Whether each tile is searched with one threshold window at a time, the fine and the coarse
    /// one in turn, instead of all of them.
    ///
    /// That takes about half the time for each tile, so that the sphere is swept nearly twice as
    /// often. Most markers are found with either window, the others at the next visit.
    pub fn with_alternating_windows(self, alternates_windows: bool) -> Self {
        Self { alternates_windows, ..self }
    }

    /// Requests `views` proposals in each frame while one of `targets` targets is not tracked, with
    /// [`PlanOrder::Roi`]. With [`PlanOrder::Exhaustive`] it requests them in each frame.
    pub fn with_proposals(self, targets: usize, views: usize) -> Self {
        Self { targets, proposals: views, ..self }
    }

    /// A record of searches with room for this planner's tiles, in which nothing was searched yet.
    pub fn nothing_searched(&self) -> Searched {
        Searched::new(self.tiles.len(), self.high_resolution.len())
    }

    /// Number of partitions that are never searched, because the camera sees nothing of them.
    pub fn hidden_partitions(&self) -> usize {
        self.tiles.len() - visible(&self.tiles).count()
    }

    /// The partition that is searched.
    pub fn partition(&self) -> &Partition {
        &self.partition
    }

    /// The plan for the next frame. `neighbours` counts with [`PlanOrder::Roi`] alone.
    ///
    /// The same arguments always give the same plan.
    pub fn plan(&self, searched: &Searched, neighbours: &[PredictedNeighbour]) -> Plan {
        let whole = |order: Vec<usize>, stop_rule| {
            let order: Vec<Purpose> = order.into_iter().map(Purpose::Partition).collect();
            let views = self.tile_views(searched, &order);
            Plan { view_budget: views.len(), views, stop_rule }
        };
        match self.order {
            PlanOrder::Greedy => whole(greedy(&self.partition), StopRule::FirstHit),
            PlanOrder::Optimized => {
                whole(optimized(&self.partition, searched.last_hit()), StopRule::FirstHit)
            }
            PlanOrder::Exhaustive => {
                let mut plan = whole(greedy(&self.partition), StopRule::All);
                plan.views.extend(vec![PROPOSAL; self.proposals]);
                Plan { view_budget: plan.views.len(), ..plan }
            }
            PlanOrder::Roi => self.roi_plan(searched, neighbours),
        }
    }

    /// One region of interest for each neighbour, least recently searched first (ties by the
    /// neighbours' own order). Then the proposals, where a target is untracked or stale. Then the
    /// tiles of both resolutions in turn, least recently searched first.
    ///
    /// After [`MAX_FRAMES_WITHOUT_TILE`] frames without a tile, the first tile comes before the
    /// proposals. A target that is never proposed must be found too.
    ///
    /// Where there are more than `VIEWS_BEFORE_PARTITION` neighbours, the first tile comes right
    /// after that many of their views. So a frame with time for one view more searches at least one
    /// tile. All N tiles are searched within N such frames, for any number of neighbours. A
    /// neighbour left out comes first in the next frame.
    fn roi_plan(&self, searched: &Searched, neighbours: &[PredictedNeighbour]) -> Plan {
        let mut regions: Vec<SearchView> = neighbours
            .iter()
            .filter_map(|neighbour| roi_view(neighbour, self.roi.pixels_per_radian))
            .collect();
        if let Some(mask) = &self.mask {
            regions.retain(|planned| !mask.hides_view(&planned.view));
        }
        regions.sort_by_key(|planned| searched.last_searched(planned.purpose));
        let order =
            least_recently_searched(searched, visible(&self.tiles), visible(&self.high_resolution));
        let tiles = self.tile_views(searched, &order);
        let known = neighbours.iter().filter(|neighbour| !neighbour.is_stale).count();
        let proposals = if known < self.targets { self.proposals } else { 0 };
        let view_budget =
            regions.len() + proposals + self.roi.partitions_per_frame.min(tiles.len());
        let mut views = regions;
        let (first, others) = tiles.split_at(tiles.len().min(1));
        let is_crowded = views.len() > VIEWS_BEFORE_PARTITION;
        let is_tile_due = searched.frames_without_tile() >= MAX_FRAMES_WITHOUT_TILE;
        let mut rest = vec![PROPOSAL; proposals];
        match (is_crowded, is_tile_due) {
            (true, _) => {
                let early = VIEWS_BEFORE_PARTITION;
                views.splice(early..early, first.iter().copied());
            }
            (false, true) => views.extend_from_slice(first),
            (false, false) => rest.extend_from_slice(first),
        }
        views.append(&mut rest);
        views.extend_from_slice(others);
        Plan { views, stop_rule: StopRule::Deadline, view_budget }
    }

    /// The tiles in this order, without those that the camera does not see.
    fn tile_views(&self, searched: &Searched, order: &[Purpose]) -> Vec<SearchView> {
        let tile = |purpose: &Purpose| {
            let view = match *purpose {
                Purpose::Partition(index) => *self.tiles.get(index)?,
                Purpose::HighResolution(index) => *self.high_resolution.get(index)?,
                Purpose::Roi(_) | Purpose::Proposal => None,
            };
            Some(SearchView {
                view: view?,
                purpose: *purpose,
                search: match self.alternates_windows {
                    true => searched.next_window(*purpose),
                    false => Search::AllWindows,
                },
                rate_in_camera: Vector3::zeros(),
            })
        };
        order.iter().filter_map(tile).collect()
    }
}

#[cfg(test)]
mod tests;
