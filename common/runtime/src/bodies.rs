//! The configured marker bodies, with their geometry.

use std::path::PathBuf;

use flockeye_geometry::body::{Bodies, BodiesError, squares};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector3};

use crate::config::{BodySet, Mount, Pipeline, Preset};

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
    /// The file contradicts itself.
    #[error("{path}: {error}")]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        error: BodiesError,
    },
    /// The presets contradict each other.
    #[error("bodies.list: {0}")]
    Presets(BodiesError),
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
}

impl Pipeline {
    /// The bodies of `bodies.file`, or else those of `bodies.list`. A body's place in them is the
    /// `target` number of the contract.
    ///
    /// # Errors
    /// The file cannot be read, or everything in it that contradicts.
    pub fn bodies(&self) -> Result<Bodies, BodySetError> {
        let Some(path) = &self.bodies.file else {
            return from_presets(&self.bodies).map_err(BodySetError::Presets);
        };
        let json = std::fs::read_to_string(path)
            .map_err(|error| BodySetError::Read { path: path.clone(), error })?;
        let bodies = Bodies::from_json(&json)
            .map_err(|error| BodySetError::File { path: path.clone(), error })?;
        let bad = bodies.iter().find(|body| !flockeye_contract::wire::is_name(&body.name));
        match bad {
            Some(body) => Err(BodySetError::Name { path: path.clone(), name: body.name.clone() }),
            None => Ok(bodies),
        }
    }
}

/// The bodies of `bodies.list`.
pub(crate) fn from_presets(set: &BodySet) -> Result<Bodies, BodiesError> {
    let bodies = set.list.iter().map(|preset| {
        let mut body = match preset.preset {
            Preset::Squares => {
                squares(&preset.name, preset.edge_m, preset.marker_m, preset.first_id)
            }
        };
        body.target_from_markers = isometry(&preset.target_from_markers);
        body
    });
    Bodies::new(set.dictionary.clone(), bodies.collect())
}

/// A configured mount as a transform.
pub fn isometry(mount: &Mount) -> Isometry3<f64> {
    let [x, y, z, w] = mount.orientation;
    Isometry3::from_parts(
        Translation3::from(Vector3::from(mount.position)),
        UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)),
    )
}
