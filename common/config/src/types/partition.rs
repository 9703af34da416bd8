//! How the sphere is cut, as types.

use flockeye_geometry::partition::{self, Weights};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How the sphere is cut.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Partition {
    /// How many views cover the sphere: auto, or 4 to 128. Coverings by up to 32 are stored; more
    /// are found at the start, which takes some seconds.
    pub count: Count,
    /// covering: the smallest circles that leave no gap. paper: spread points, then grow circles
    /// round them (found at the start).
    pub method: Method,
    /// Weights of the number of views, their pixels and their distortion, for `count: auto`.
    pub weights: [f64; 3],
    /// Random start of what is not stored; stored is what 1 gave.
    #[schemars(range(min = 0, max = 4294967295u32))]
    pub seed: u32,
    /// Overlap of neighbouring views, degrees: anything smaller lies wholly in one of them. Left out: the
    /// size of the largest marker at `nearest_m`.
    #[schemars(range(min = 0.0, max = 130.0))]
    pub margin_deg: Option<f64>,
    /// Nearest working range, metres, for the margin.
    #[schemars(range(min = 0.1, max = 100.0))]
    pub nearest_m: f64,
    /// Pixels of the views for each of the sphere's, along a side. Left out: 1; and 2 with
    /// `profile: stills`, where no magnified view of a neighbour follows.
    #[schemars(range(min = 0.5, max = 3.0))]
    pub magnification: Option<f64>,
}

impl Default for Partition {
    fn default() -> Self {
        Self {
            count: Count::Views(12),
            method: Method::Covering,
            weights: Weights::default().values(),
            seed: 1,
            margin_deg: None,
            nearest_m: 0.4,
            magnification: None,
        }
    }
}

/// Number of views that cover the sphere.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(untagged)]
pub enum Count {
    /// The stored covering of least cost by the paper's criterion.
    Chosen(Auto),
    /// This many.
    Views(
        #[schemars(
            range(min = 4, max = 128),
            extend("x-why" = "three flat images never see the whole sphere, and more than 128 are never all searched in time")
        )]
        usize,
    ),
}

/// Left to the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Auto {
    /// Left to the program.
    Auto,
}

impl Count {
    /// The largest number of views that this can give.
    pub fn most(self) -> usize {
        match self {
            Self::Chosen(Auto::Auto) => *partition::STORED.end(),
            Self::Views(count) => count,
        }
    }
}

/// How the directions of the views are found.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// The smallest circles that leave no gap.
    #[default]
    Covering,
    /// The paper's: spread points, then circles round them that leave no gap.
    Paper,
}

impl From<Method> for partition::Method {
    fn from(method: Method) -> Self {
        match method {
            Method::Covering => Self::Covering,
            Method::Paper => Self::Paper,
        }
    }
}
