//! How the sphere is cut, as types.

use flockeye_geometry::partition;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How the sphere is cut.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
#[schemars(rename = "Partition")]
pub struct PartitionSettings {
    /// How many views cover the sphere. Coverings by up to 32 are stored; more are found at the start,
    /// which takes some seconds.
    #[schemars(
        range(min = 4, max = 128),
        extend("x-why" = "three flat images never see the whole sphere, and more than 128 are never all searched in time")
    )]
    pub count: usize,
    /// covering: the smallest circles that leave no gap. paper: spread points, then grow circles
    /// round them (found at the start).
    pub method: PartitionMethod,
    /// Nearest working range, metres. Views overlap by the size of the largest marker there, so that it
    /// lies wholly in one of them.
    #[schemars(range(min = 0.1, max = 100.0))]
    pub nearest_m: f64,
}

impl Default for PartitionSettings {
    fn default() -> Self {
        Self {
            // The least by the paper's criterion (`flockeye partition`).
            count: 12,
            method: PartitionMethod::Covering,
            nearest_m: 0.4,
        }
    }
}

/// How the directions of the views are found.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
#[schemars(rename = "Method")]
pub enum PartitionMethod {
    /// The smallest circles that leave no gap.
    #[default]
    Covering,
    /// The paper's: spread points, then circles round them that leave no gap.
    Paper,
}

impl From<PartitionMethod> for partition::Method {
    fn from(method: PartitionMethod) -> Self {
        match method {
            PartitionMethod::Covering => Self::Covering,
            PartitionMethod::Paper => Self::Paper,
        }
    }
}
