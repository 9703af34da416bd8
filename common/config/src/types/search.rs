//! Where fusion has views searched, and how much of a frame.

use flockeye_contract::SearchMode;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::Costs;

/// How fusion searches.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
#[schemars(rename = "Search")]
pub struct SearchSettings {
    /// greedy and optimized are the paper's; exhaustive searches everywhere; roi (the default) searches
    /// where neighbours are predicted and sweeps the rest.
    pub mode: SearchMode,
    /// How many processors work on a frame, for the stated costs of `profile: repeat` and `stills`. Two
    /// logical ones that share a core, and a pipeline that waits for one stage after another, do the work
    /// of about 1.3: then as many views of a recording are searched as at its own rate.
    #[schemars(range(min = 0.25, max = 256.0))]
    pub processors: f64,
    /// Resolution of the high-resolution tiles, as a multiple of the sphere's along a side. The mode roi
    /// searches them in turn with the partitions, and finds neighbours that many times as far away. With 1
    /// there are none.
    #[schemars(range(min = 1.0, max = 3.0))]
    pub far_magnification: f64,
    /// Views of places that look like a body, in each frame while a neighbour is not tracked: the mode
    /// roi finds such places by a fast look at the whole picture. Twice as many with `profile: stills`, where
    /// the look is thorough and bodies are searched there in any attitude. 0: none.
    #[schemars(range(min = 0, max = 64))]
    pub proposals: u32,
}

impl Default for SearchSettings {
    fn default() -> Self {
        Self {
            mode: SearchMode::Roi,
            processors: Costs::default().processors,
            far_magnification: 2.0,
            proposals: 12,
        }
    }
}
