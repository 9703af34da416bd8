//! What fusion leaves to the process that follows it: tracks, the camera's rotation, what was
//! learned of the exposure, and what was searched when.
//!
//! It is saved before a pose leaves and after each frame. A process that is started in a swap, or
//! after a crash, goes on from there. Of frames that are open only that is part of it which must
//! not be said twice: nobody but the old process has their views.

use anyhow::ensure;
use serde::{Deserialize, Serialize};

use flockeye_contract::FrameOrder;
use flockeye_geometry::ego_rotation::EgoRotation;

use crate::planning::Planning;
use crate::target::SavedTarget;

/// Rises with each change of what is saved. Another version is not read.
const VERSION: u32 = 2;

/// The state of a core after a frame.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Snapshot {
    /// The last frame that has ended. A successor sends nothing about it or older ones.
    pub(crate) ended: Option<FrameOrder>,
    pub(crate) targets: Vec<SavedTarget>,
    pub(crate) ego: EgoRotation,
    /// What blur has shown of the exposure: sums of stretch and weight.
    pub(crate) exposure: (f64, f64),
    pub(crate) planning: Planning,
}

impl Snapshot {
    /// The part that stays true however old it is: which poses have left, how many tracks there
    /// were.
    pub(crate) fn without_tracks(mut self) -> Self {
        self.targets.iter_mut().for_each(|target| target.life = None);
        self
    }

    /// Its bytes: the version, then the fields in their order, as postcard writes them.
    ///
    /// # Errors
    /// None that a snapshot could lead to.
    pub(crate) fn to_bytes(&self) -> anyhow::Result<Vec<u8>> {
        postcard::to_stdvec(&(VERSION, self)).map_err(unreadable)
    }

    /// Reads one.
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
