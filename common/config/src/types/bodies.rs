//! What the neighbours carry, as types.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::mount::Mount;

/// What the neighbours carry.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct BodySet {
    /// A JSON file of ids and corner positions; it replaces `dictionary` and `list`.
    pub file: Option<PathBuf>,
    /// Dictionary of all markers: one of OpenCV's names, or a dictionary file in OpenCV's YAML form.
    pub dictionary: String,
    /// The neighbours, by preset.
    pub list: Vec<PresetBody>,
}

impl Default for BodySet {
    fn default() -> Self {
        let body = |name: &str, first_id| PresetBody {
            name: name.into(),
            first_id,
            ..PresetBody::default()
        };
        Self {
            file: None,
            dictionary: "DICT_5X5_250".into(),
            list: vec![body("alpha", 0), body("bravo", 17)],
        }
    }
}

/// A body from a preset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PresetBody {
    /// The neighbour's name on the network.
    pub name: String,
    /// Which solid.
    pub preset: Preset,
    /// Edge of the solid, metres; left out: the preset's own.
    #[schemars(range(min = 0.005, max = 5.0))]
    pub edge_m: Option<f64>,
    /// Side of the markers' black squares, metres; left out: the preset's own.
    #[schemars(range(min = 0.005, max = 5.0))]
    pub marker_m: Option<f64>,
    /// `truncated`: side of the small markers' black squares, metres; left out: in proportion.
    #[schemars(range(min = 0.002, max = 5.0))]
    pub small_marker_m: Option<f64>,
    /// `truncated`: how far the small markers lie from the middle of their triangle towards the belt,
    /// metres; left out: in proportion.
    #[schemars(range(min = -1.0, max = 1.0))]
    pub small_shift_m: Option<f64>,
    /// Id of its first marker; the others follow.
    #[schemars(range(min = 0, max = 1000000))]
    pub first_id: u32,
    /// `custom`: the JSON file that has the body of this name.
    pub file: Option<PathBuf>,
    /// Where the marker body sits on its drone.
    pub target_from_markers: Mount,
}

impl Default for PresetBody {
    fn default() -> Self {
        Self {
            name: "alpha".into(),
            preset: Preset::Squares,
            edge_m: None,
            marker_m: None,
            small_marker_m: None,
            small_shift_m: None,
            first_id: 0,
            file: None,
            target_from_markers: Mount::default(),
        }
    }
}

/// The solids that come with Flockeye.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// Rhombicuboctahedron with 17 markers: every square facet but the bottom one.
    #[default]
    Squares,
    /// The same without its lower cupola: 13 markers on squares, 4 small ones on triangles.
    Truncated,
    /// A cube with 5 markers: every side but the bottom one.
    Cube,
    /// One marker that looks up.
    Plate,
    /// From a JSON file of ids and corner positions.
    Custom,
}

impl Preset {
    /// Its name in the configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Squares => "squares",
            Self::Truncated => "truncated",
            Self::Cube => "cube",
            Self::Plate => "plate",
            Self::Custom => "custom",
        }
    }
}
