//! State of fusion for the next process: tracks, the camera's rotation, the sums of exposure,
//! response and lenses, and the record of searches.
//!
//! It is saved before a pose is published and after each frame. A process that starts in a swap, or
//! after a crash, continues from there. It contains no views of open frames, because only the old
//! process has them. It states which poses of open frames were published, so that none is published
//! twice.

use anyhow::ensure;
use nalgebra::{Matrix5, Vector5};
use serde::{Deserialize, Serialize};

use flockeye_contract::FrameOrder;
use flockeye_geometry::ego_rotation::EgoRotation;

use crate::planning::Planning;
use crate::target::SavedTarget;

/// Version of the saved form. It rises with each change, and other versions are not read.
const VERSION: u32 = 5;

/// The state of a core after a frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Snapshot {
    /// The last frame that has ended. A successor publishes nothing about it or older ones.
    pub(crate) ended: Option<FrameOrder>,
    pub(crate) targets: Vec<SavedTarget>,
    pub(crate) ego: EgoRotation,
    /// Exposure from blur: sums of stretch and weight.
    pub(crate) exposure: (f64, f64),
    /// Response from print: sums of gamma and weight, and the gamma in use.
    pub(crate) response: (f64, f64, Option<f64>),
    /// Lenses of a stitched camera from bodies across their border: information about its constants,
    /// and that times the constants. `None` for another camera.
    pub(crate) lenses: Option<(Matrix5<f64>, Vector5<f64>)>,
    pub(crate) planning: Planning,
}

impl Snapshot {
    /// The part that stays valid at any age: frames of published poses, and numbers of tracks.
    pub(crate) fn without_tracks(mut self) -> Self {
        self.targets.iter_mut().for_each(|target| target.life = None);
        self
    }

    /// Its bytes: the version, then the fields in their order, in postcard form.
    ///
    /// # Errors
    /// None for any snapshot.
    pub(crate) fn to_bytes(&self) -> anyhow::Result<Vec<u8>> {
        postcard::to_stdvec(&(VERSION, self)).map_err(unreadable)
    }

    /// Reads a snapshot.
    ///
    /// # Errors
    /// Another version, or bytes that are no snapshot.
    pub(crate) fn from_bytes(bytes: &[u8]) -> anyhow::Result<Self> {
        let (found, rest) = postcard::take_from_bytes::<u32>(bytes).map_err(unreadable)?;
        ensure!(found == VERSION, "it has version {found}; this program reads version {VERSION}");
        postcard::from_bytes(rest).map_err(unreadable)
    }
}

/// The error of bytes that are no snapshot, or were cut off.
fn unreadable(error: postcard::Error) -> anyhow::Error {
    let reason = format!("it cannot be read: {error}");
    anyhow::Error::from(error).context(reason)
}
