//! Stage: detections to tracks, and plans for where to look next.
//!
//! It takes views (their headers), detections and frame ends; it gives tracks and plans; between
//! frames it keeps a filter for each neighbour and what was searched when.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`assembly`] | puts a frame together from what the stages say of it |
//! | [`parallax`] | rays of lenses beside the camera's middle |
//! | [`gallery`] | which views' pixels are held |
//! | [`pictures`] | held views as images |
//! | [`alignment`] | a body aligned with the pixels of the best view of it |
//! | [`sighting`] | one believed pose of a body from a frame's rays and pixels |
//! | [`second_look`] | what takes long, on a thread of its own |
//! | [`neighbour`] | a neighbour's track from frame to frame |
//! | [`swarm`] | all neighbours, and the plan for the next frame |
//! | [`parallel`] | the same done with several things at once |
//! | [`settings`] | what the configuration means for it |
//! | [`message`] | the same as the contract's messages |
//! | [`stage`] | the ports around it |

pub mod alignment;
pub mod assembly;
pub mod gallery;
pub mod message;
pub mod neighbour;
pub mod parallax;
pub mod parallel;
pub mod pictures;
pub mod second_look;
pub mod settings;
pub mod sighting;
pub mod stage;
pub mod swarm;

#[cfg(test)]
#[path = "../../../common/imaging/tests/drawn_body/mod.rs"]
mod drawn_body;

/// The fusion stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::FusionStage>()
}
