//! Where fusion has views searched, and how much of a frame.

use flockeye_contract::SearchMode;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Costs;

/// How fusion searches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Search {
    /// greedy and optimized are the paper's; exhaustive searches everywhere; gaze (the default) searches
    /// where neighbours are predicted and sweeps the rest.
    pub mode: SearchMode,
    /// What each piece of work costs, for `profile: repeat` and `stills`.
    pub costs: Costs,
    /// Tiles searched after the regions of interest in each frame with `profile: unlimited`.
    #[schemars(range(min = 1, max = 128))]
    pub lossless_partitions: u32,
    /// Resolution of the high-resolution tiles, as a multiple of the sphere's along a side. The mode gaze
    /// searches them in turn with the partitions, and finds neighbours that many times as far away. With 1
    /// (or no more than `partition.magnification`) there are none.
    #[schemars(range(min = 1.0, max = 3.0))]
    pub far_magnification: f64,
    /// Views of places that look like a body, in each frame while a neighbour is not tracked: the mode
    /// gaze finds such places by a fast look at the whole picture. Twice as many with `profile: stills`, where
    /// the look is thorough and bodies are searched there in any attitude. 0: none.
    #[schemars(range(min = 0, max = 64))]
    pub proposals: u32,
}

impl Default for Search {
    fn default() -> Self {
        Self {
            mode: SearchMode::Gaze,
            costs: Costs::default(),
            lossless_partitions: 4,
            far_magnification: 2.0,
            proposals: 12,
        }
    }
}
