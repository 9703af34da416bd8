//! The configured marker bodies, with their geometry.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use flockeye_geometry::body::{
    Bodies, BodiesError, Body, TruncatedSizes, cube, plate, squares, truncated,
};

use super::mount::isometry;
use crate::types::{Mount, Pipeline, Preset, PresetBody};

/// A bodies file of 32 bodies with 100 markers each has a tenth of it.
const MAX_FILE_BYTES: u64 = 16_000_000;

/// Why the bodies cannot be had.
#[derive(Debug, thiserror::Error)]
pub enum BodySetError {
    /// The file cannot be read.
    #[error("cannot read the bodies file {path}: {error}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        error: std::io::Error,
    },
    /// The file is larger than any of its kind.
    #[error(
        "the bodies file {path} has more than {} MB, which no bodies need. Cure: give the JSON file \
         of ids and corners",
        MAX_FILE_BYTES / 1_000_000
    )]
    Size {
        /// The file.
        path: PathBuf,
    },
    /// The file contradicts itself.
    #[error("{path}: {error}")]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        error: BodiesError,
    },
    /// The entries contradict each other.
    #[error("bodies.list: {0}")]
    List(BodiesError),
    /// A name that cannot go over the network.
    #[error(
        "{path}: '{name}' cannot be a body's name: use 1 to 31 letters, digits, '-', '_' and '.'"
    )]
    Name {
        /// The file.
        path: PathBuf,
        /// The name.
        name: String,
    },
    /// A file without the body that is wanted of it.
    #[error("{path} has no body '{name}'; it has {}", .has.join(", "))]
    Missing {
        /// The file.
        path: PathBuf,
        /// What is wanted.
        name: String,
        /// What there is.
        has: Vec<String>,
    },
    /// A file of another dictionary.
    #[error("the markers of {path} are from {found}, those of the other bodies from {wanted}")]
    Dictionary {
        /// The file.
        path: PathBuf,
        /// Its dictionary.
        found: String,
        /// The configured one.
        wanted: String,
    },
    /// A body that is not the configured one.
    #[error(
        "{path}: body '{name}' has other marker ids than the configured one. Cure: give it the same \
         ids, or another name"
    )]
    Ids {
        /// The file.
        path: PathBuf,
        /// The body.
        name: String,
    },
}

impl Pipeline {
    /// The bodies of `bodies.file`, or else those of `bodies.list`. A body's place in them is the
    /// `target` number of the contract.
    ///
    /// # Errors
    /// A file cannot be read, or everything in it that contradicts.
    pub fn bodies(&self) -> Result<Bodies, BodySetError> {
        if let Some(path) = &self.bodies.file {
            return read_bodies(path);
        }
        let wanted = &self.bodies.dictionary;
        let bodies: Result<Vec<Body>, BodySetError> = self
            .bodies
            .list
            .iter()
            .map(|entry| match (preset_body(entry), &entry.file) {
                (Some(body), _) => Ok(body),
                (None, Some(path)) => custom_body(entry, path, wanted),
                // Refused with the configuration: it has no marker, and says so once more.
                (None, None) => Ok(Body::new(entry.name.as_str(), Vec::new())),
            })
            .collect();
        Bodies::new(wanted.clone(), bodies?).map_err(BodySetError::List)
    }

    /// The bodies as they fly in the simulated world: those of `simulator.bodies` instead of the
    /// configured ones of the same name.
    ///
    /// # Errors
    /// As [`Pipeline::bodies`]; and bodies of the same name with other ids.
    pub fn simulated_bodies(&self) -> Result<Bodies, BodySetError> {
        let configured = self.bodies()?;
        let Some(path) = &self.simulator.bodies else { return Ok(configured) };
        let real = read_bodies(path)?;
        check_dictionary(path, &real, &configured.dictionary)?;
        let bodies: Result<Vec<Body>, BodySetError> = configured
            .iter()
            .map(|body| {
                let Some(real) = real.iter().find(|real| real.name == body.name) else {
                    return Ok(body.clone());
                };
                let mut placed = real.clone();
                placed.target_from_markers = body.target_from_markers;
                let ids = |body: &Body| body.markers.iter().map(|m| m.id).collect::<Vec<_>>();
                match ids(real) == ids(body) {
                    true => Ok(placed),
                    false => Err(BodySetError::Ids { path: path.clone(), name: body.name.clone() }),
                }
            })
            .collect();
        Bodies::new(configured.dictionary.clone(), bodies?)
            .map_err(|error| BodySetError::File { path: path.clone(), error })
    }
}

/// Reads a bodies file. Its dictionary, if that is a file, may lie beside it.
///
/// # Errors
/// It cannot be read, is far too large, or everything in it that contradicts.
pub fn read_bodies(path: &Path) -> Result<Bodies, BodySetError> {
    let unreadable = |error| BodySetError::Read { path: path.to_owned(), error };
    let file = File::open(path).map_err(unreadable)?;
    let bytes = file.metadata().map_err(unreadable)?.len();
    let mut json = String::new();
    if bytes <= MAX_FILE_BYTES {
        // One more than allowed: a device, or a file that grows, has no length to go by.
        file.take(MAX_FILE_BYTES + 1).read_to_string(&mut json).map_err(unreadable)?;
    }
    if bytes.max(json.len() as u64) > MAX_FILE_BYTES {
        return Err(BodySetError::Size { path: path.to_owned() });
    }
    let mut bodies = Bodies::from_json(&json)
        .map_err(|error| BodySetError::File { path: path.to_owned(), error })?;
    let beside = path.parent().unwrap_or(Path::new("")).join(&bodies.dictionary);
    if beside.is_file() {
        bodies.dictionary = beside.to_string_lossy().into_owned();
    }
    let bad = bodies.iter().find(|body| !flockeye_contract::wire::is_name(&body.name));
    match bad {
        Some(body) => Err(BodySetError::Name { path: path.to_owned(), name: body.name.clone() }),
        None => Ok(bodies),
    }
}

/// The body that a `custom` entry names.
fn custom_body(entry: &PresetBody, path: &Path, wanted: &str) -> Result<Body, BodySetError> {
    let bodies = read_bodies(path)?;
    check_dictionary(path, &bodies, wanted)?;
    let found = bodies.iter().find(|body| body.name == entry.name);
    let mut body = found.cloned().ok_or_else(|| BodySetError::Missing {
        path: path.to_owned(),
        name: entry.name.clone(),
        has: bodies.iter().map(|body| body.name.clone()).collect(),
    })?;
    // The file's own mount holds until another is configured.
    if entry.target_from_markers != Mount::default() {
        body.target_from_markers = isometry(&entry.target_from_markers);
    }
    Ok(body)
}

fn check_dictionary(path: &Path, bodies: &Bodies, wanted: &str) -> Result<(), BodySetError> {
    if bodies.dictionary == wanted {
        return Ok(());
    }
    Err(BodySetError::Dictionary {
        path: path.to_owned(),
        found: bodies.dictionary.clone(),
        wanted: wanted.to_owned(),
    })
}

/// The body of an entry of `bodies.list`; `None` for a custom one, which is in its file.
pub(crate) fn preset_body(entry: &PresetBody) -> Option<Body> {
    let (name, id) = (entry.name.as_str(), entry.first_id);
    let flown = TruncatedSizes::default();
    let usual = match entry.preset {
        Preset::Squares | Preset::Cube | Preset::Plate => (0.0625, 0.05),
        Preset::Truncated => (flown.edge_m, flown.marker_m),
        Preset::Custom => return None,
    };
    let edge_m = entry.edge_m.unwrap_or(usual.0);
    let scale = edge_m / usual.0;
    let marker_m = entry.marker_m.unwrap_or(usual.1 * scale);
    let mut body = match entry.preset {
        Preset::Squares => squares(name, edge_m, marker_m, id),
        Preset::Cube => cube(name, edge_m, marker_m, id),
        Preset::Plate => plate(name, edge_m, marker_m, id),
        Preset::Truncated | Preset::Custom => {
            let small_marker_m = entry.small_marker_m.unwrap_or(flown.small_marker_m * scale);
            let small_shift_m = entry.small_shift_m.unwrap_or(flown.small_shift_m * scale);
            let sizes = TruncatedSizes { edge_m, marker_m, small_marker_m, small_shift_m };
            truncated(name, &sizes, id)
        }
    };
    body.target_from_markers = isometry(&entry.target_from_markers);
    Some(body)
}
