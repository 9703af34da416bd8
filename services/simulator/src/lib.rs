//! A synthetic world in place of a spherical camera of any model: frames, and the truth about them.
//!
//! [`World::render`] writes the 8-bit luma plane of a frame into memory that it is given, and
//! returns where every body was. It has no port and no clock. Its one file is the painting that it
//! keeps for the next process.
//!
//! ```
//! use flockeye_dictionary::Dictionary;
//! use flockeye_geometry::body::{Bodies, squares};
//! use flockeye_geometry::camera::Camera;
//! use flockeye_simulator::{World, WorldParameters};
//!
//! let bodies = Bodies::new("DICT_5X5_250".into(), vec![squares("alpha", 0.0625, 0.05, 0)])?;
//! let camera = Camera::equirectangular(512, 256);
//! let parameters = WorldParameters { camera, ..Default::default() };
//! let mut world = World::new(parameters, &bodies, &Dictionary::of(&bodies)?)?;
//! let mut luma = vec![0; 512 * 256];
//! let truth = world.render(0, &mut luma, 512)?;
//! assert_eq!(truth.bodies[0].name, "alpha");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! How a frame comes about, all in linear light up to the last step:
//!
//! | module | what it does |
//! | --- | --- |
//! | `parameters` | what a world can be like |
//! | `world` | makes it all, once, and is asked for frames |
//! | `error` | what keeps a world or a frame from being made |
//! | `trajectory` | where the bodies are at a time |
//! | `gusts` | how gusts make the observer and the bodies lean and sway |
//! | `drone_motion` | how the observer and its camera move, and what an inertial sensor in it feels |
//! | `wander` | where the drones of a swarm fly |
//! | `inertial` | that sensor, with bias, noise, mounting and a clock of its own |
//! | `moment` | where everything is at an instant |
//! | `eyes` | where each part of the image is taken from: the camera's middle, or its lenses' places |
//! | `kept_painting` | the painted panorama, left to the next process |
//! | `hall`, `backdrop` | the panorama behind them: painted and blurred once, then turned |
//! | `cube` | the same for an observer that leans and turns unevenly, blurred along the way in each frame |
//! | `drone` | bodies and airframes as painted convex parts |
//! | `raster`, `optics`, `drawing` | drawn with exact area coverage, blurred by lens and motion, for each eye |
//! | `sun` | a low sun, and the shadows that it casts in stripes |
//! | `density` | where an eye sees a body, and how many pixels the image has there |
//! | `own_airframe` | the observer's own legs over everything |
//! | `scene`, `picture` | what a frame is made from, and the image that it is laid on |
//! | `sphere`, `sphere_picture` | laid on the sphere image, row by row |
//! | `tiles`, `panorama`, `tiled_picture` | laid on any other image, tile by tile |
//! | `response`, `sensor` | the curve to code values, clipping, noise |
//! | `schedule`, `ahead` | in flight: which frame is drawn when, before its time |
//! | `settings` | the world as the configuration asks for it |
//! | `messages` | the truth about a frame, as messages |
//! | `core` | which frame is drawn or handed over next, and its messages |
//! | `stage` | the ports around it |

#![warn(unreachable_pub)]

mod ahead;
mod backdrop;
mod core;
mod cube;
mod density;
mod drawing;
mod drone;
mod drone_motion;
mod error;
mod eyes;
mod gusts;
mod hall;
mod inertial;
mod kept_painting;
mod messages;
mod moment;
mod optics;
mod own_airframe;
mod panorama;
mod parameters;
mod picture;
mod raster;
mod response;
mod scatter;
mod scene;
mod schedule;
mod sensor;
pub mod settings;
mod sphere;
mod sphere_picture;
mod stage;
mod sun;
mod tiled_picture;
mod tiles;
mod trajectory;
mod truth;
mod wander;
mod world;

pub use error::{RenderError, WorldError};
pub use moment::{Attitude, Moment, Placement};
pub use parameters::WorldParameters;
pub use response::CameraCurve;
pub use truth::{FrameTruth, TargetTruth};
pub use world::World;

/// The simulator stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::SimulatorStage>()
}
