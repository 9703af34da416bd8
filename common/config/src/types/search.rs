//! Where fusion has views searched, and how much of a frame.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Costs;

/// How fusion searches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Search {
    /// greedy and optimized are the paper's; exhaustive searches everywhere; gaze (the default) searches
    /// where neighbours are predicted and sweeps the rest.
    pub mode: Mode,
    /// How much of a frame a lossless run works on. flight (the default): what flight has time for, by
    /// `costs`, so that it gives the poses that flight gives. unlimited: all passes, and
    /// `lossless_partitions` tiles, for each frame.
    pub budget: SearchBudget,
    /// What each piece of work costs, for the budget flight.
    pub costs: Costs,
    /// Tiles searched after the regions of interest in each frame of a lossless run without limit.
    #[schemars(range(min = 1, max = 128))]
    pub lossless_partitions: u32,
    /// Resolution of the high-resolution tiles, as a multiple of the sphere's along a side. The mode gaze
    /// searches them in turn with the partitions, and finds neighbours that many times as far away. With 1
    /// (or no more than `partition.magnification`) there are none.
    #[schemars(range(min = 1.0, max = 3.0))]
    pub far_magnification: f64,
    /// Views of places that look like a body, in each frame while a neighbour is not tracked: the mode
    /// gaze finds such places by a fast look at the whole picture. Twice as many with `fusion.filter: none` in a
    /// lossless run, where the look is thorough and bodies are searched there in any attitude. 0: none.
    #[schemars(range(min = 0, max = 64))]
    pub proposals: u32,
}

impl Default for Search {
    fn default() -> Self {
        Self {
            mode: Mode::Gaze,
            budget: SearchBudget::Flight,
            costs: Costs::default(),
            lossless_partitions: 4,
            far_magnification: 2.0,
            proposals: 12,
        }
    }
}

/// How a frame is searched.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Mode {
    /// Partitions in a fixed order until the first hit.
    Greedy,
    /// The paper's Algorithm 1.
    Optimized,
    /// Every partition of every frame.
    Exhaustive,
    /// Predicted neighbours first, magnified; then partitions, least recently searched first.
    #[default]
    Gaze,
}

/// How much of a lossless frame is worked on.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SearchBudget {
    /// What flight has time for, by `search.costs`: the same passes in the same order. Single images (`fusion.filter: none`)
    /// are searched as well as can be all the same.
    #[default]
    Flight,
    /// `search.lossless_partitions` tiles with all windows, and all passes at once.
    Unlimited,
}
