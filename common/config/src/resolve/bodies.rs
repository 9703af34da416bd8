//! The configured marker bodies, with their geometry.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use flockeye_geometry::body::{Bodies, Body, TruncatedSizes, cube, plate, squares, truncated};

use super::error::{MAX_FILE_BYTES, ResolveError};
use super::mount::isometry;
use crate::types::{BodySet, Mount, Preset, PresetBody};

/// The bodies of `bodies.file`, or else of `bodies.list`. The index of a body is the `target`
/// number of the contract.
///
/// # Errors
/// A file cannot be read, or everything in it that contradicts.
pub fn bodies(settings: &BodySet) -> Result<Bodies, ResolveError> {
    if let Some(path) = &settings.file {
        return read_bodies(path);
    }
    let wanted = &settings.dictionary;
    let bodies: Result<Vec<Body>, ResolveError> = settings
        .list
        .iter()
        .map(|entry| match (preset_body(entry), &entry.file) {
            (Some(body), _) => Ok(body),
            (None, Some(path)) => custom_body(entry, path, wanted),
            // The check of the configuration refuses this; a body without markers is refused below.
            (None, None) => Ok(Body::new(entry.name.as_str(), Vec::new())),
        })
        .collect();
    Bodies::new(wanted.clone(), bodies?).map_err(ResolveError::List)
}

/// The configured bodies, with replacements of the same names from the file at `path`.
pub(crate) fn simulated_bodies(configured: &Bodies, path: &Path) -> Result<Bodies, ResolveError> {
    let real = read_bodies(path)?;
    check_dictionary(path, &real, &configured.dictionary)?;
    let bodies: Result<Vec<Body>, ResolveError> = configured
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
                false => Err(ResolveError::Ids { path: path.to_owned(), name: body.name.clone() }),
            }
        })
        .collect();
    Bodies::new(configured.dictionary.clone(), bodies?)
        .map_err(|error| ResolveError::File { path: path.to_owned(), error })
}

/// Reads a bodies file. Its dictionary, if that is a file, may lie beside it.
///
/// # Errors
/// It cannot be read, is far too large, or everything in it that contradicts.
pub fn read_bodies(path: &Path) -> Result<Bodies, ResolveError> {
    let unreadable = |error| ResolveError::Read { path: path.to_owned(), error };
    let file = File::open(path).map_err(unreadable)?;
    let bytes = file.metadata().map_err(unreadable)?.len();
    let mut json = String::new();
    if bytes <= MAX_FILE_BYTES {
        // One byte more than allowed, because a device or a growing file reports no final length.
        file.take(MAX_FILE_BYTES + 1).read_to_string(&mut json).map_err(unreadable)?;
    }
    if bytes.max(json.len() as u64) > MAX_FILE_BYTES {
        return Err(ResolveError::Size { path: path.to_owned() });
    }
    let mut bodies = Bodies::from_json(&json)
        .map_err(|error| ResolveError::File { path: path.to_owned(), error })?;
    let beside = path.parent().unwrap_or(Path::new("")).join(&bodies.dictionary);
    if beside.is_file() {
        bodies.dictionary = beside.to_string_lossy().into_owned();
    }
    let bad = bodies.iter().find(|body| !flockeye_contract::wire::is_name(&body.name));
    match bad {
        Some(body) => Err(ResolveError::Name { path: path.to_owned(), name: body.name.clone() }),
        None => Ok(bodies),
    }
}

/// The body that a `custom` entry names.
fn custom_body(entry: &PresetBody, path: &Path, wanted: &str) -> Result<Body, ResolveError> {
    let bodies = read_bodies(path)?;
    check_dictionary(path, &bodies, wanted)?;
    let found = bodies.iter().find(|body| body.name == entry.name);
    let mut body = found.cloned().ok_or_else(|| ResolveError::Missing {
        path: path.to_owned(),
        name: entry.name.clone(),
        has: bodies.iter().map(|body| body.name.clone()).collect(),
    })?;
    // The file's own mount holds unless another is configured.
    if entry.target_from_markers != Mount::default() {
        body.target_from_markers = isometry(&entry.target_from_markers);
    }
    Ok(body)
}

fn check_dictionary(path: &Path, bodies: &Bodies, wanted: &str) -> Result<(), ResolveError> {
    if bodies.dictionary == wanted {
        return Ok(());
    }
    Err(ResolveError::Dictionary {
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
