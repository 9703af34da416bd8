//! What fusion leaves to the process that follows it: tracks, the camera's rotation, what was
//! learned of the exposure, and what was searched when.
//!
//! It is saved before a pose leaves and after each frame. A process that is started in a swap, or
//! after a crash, goes on from there. Of frames that are open only that is part of it which must
//! not be said twice: nobody but the old process has their views.

use serde::{Deserialize, Serialize};

use flockeye_contract::FrameOrder;
use flockeye_geometry::ego_rotation::EgoRotation;
use flockeye_geometry::filter::SavedLife;
use flockeye_geometry::search::Searched;

use crate::exposure::LearnedExposure;

/// Rises with each change of what is saved. Another version is not read.
const VERSION: u32 = 2;

/// Why a snapshot is not gone on with.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SnapshotError {
    /// Another version of fusion saved it.
    #[error("it has version {found}; this program reads version {VERSION}")]
    Version {
        /// Its version.
        found: u32,
    },
    /// The bytes are no snapshot, or were cut off.
    #[error("it cannot be read: {0}")]
    Unreadable(#[from] postcard::Error),
}

/// The state of a core after a frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Snapshot {
    /// The last frame that has ended. A successor sends nothing about it or older ones.
    pub ended: Option<FrameOrder>,
    /// All targets.
    pub targets: Vec<SavedTarget>,
    /// How the camera has turned.
    pub ego: EgoRotation,
    /// What blur has shown of the exposure.
    pub exposure: LearnedExposure,
    /// Where the search is.
    pub planning: SavedPlanning,
}

/// A target.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedTarget {
    /// Its body's name.
    pub body: String,
    /// The number of its newest track.
    pub track_id: u32,
    /// The newest frame in which its pose has left, as far as such frames may still be open.
    pub published: Option<FrameOrder>,
    /// The track, if it is tracked.
    pub life: Option<SavedLife>,
}

/// Where the search is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SavedPlanning {
    /// What was searched when.
    pub searched: Searched,
    /// How many frames have ended.
    pub frames: u64,
    /// When the last frame was exposed, seconds.
    pub last_s: Option<f64>,
    /// The time between the last two frames, seconds.
    pub interval_s: f64,
}

impl Snapshot {
    /// The part that stays true however old it is: which poses have left, how many tracks there
    /// were.
    pub fn without_tracks(mut self) -> Self {
        self.targets.iter_mut().for_each(|target| target.life = None);
        self
    }

    /// Its bytes: the version, then the fields in their order, as postcard writes them.
    ///
    /// # Errors
    /// None that a snapshot could lead to.
    pub fn to_bytes(&self) -> Result<Vec<u8>, SnapshotError> {
        Ok(postcard::to_stdvec(&(VERSION, self))?)
    }

    /// Reads one.
    ///
    /// # Errors
    /// Another version, or bytes that are no snapshot.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, SnapshotError> {
        let (found, rest) = postcard::take_from_bytes::<u32>(bytes)?;
        if found != VERSION {
            return Err(SnapshotError::Version { found });
        }
        Ok(postcard::from_bytes(rest)?)
    }
}
