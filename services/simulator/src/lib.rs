//! A synthetic world in place of a spherical camera of any model: frames, and the truth about them.
//!
//! [`World::render`] writes the 8-bit luma plane of a frame into the caller's memory, and returns
//! the poses of all bodies. It has no port and no clock. It has one file: the painted panorama,
//! kept for the next process.
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
//! Modules. All drawing is in linear light up to the last step:
//!
//! | module | what it does |
//! | --- | --- |
//! | `parameters` | parameters of a world, and their checks |
//! | `world` | builds the scene once, and renders frames |
//! | `error` | errors of a world or a frame |
//! | `trajectory` | paths of the bodies |
//! | `gusts` | lean and sway of drones in gusts |
//! | `drone_motion` | motion of the observer and its camera, and the specific force in it |
//! | `wander` | paths of the drones of a swarm |
//! | `inertial` | the inertial sensor: bias, noise, mounting and clock offset |
//! | `moment` | poses of camera and bodies at one instant |
//! | `blend` | one picture from those of two lenses |
//! | `eyes` | viewpoints of the image's parts: the camera's centre, or the lenses' positions |
//! | `kept_painting` | the painted panorama, kept for the next process |
//! | `hall`, `backdrop` | the panorama behind the bodies: painted and blurred once, then turned |
//! | `cube` | the same for an observer in gusts, with motion blur in each frame |
//! | `drone` | bodies and airframes as painted convex parts |
//! | `raster`, `optics`, `drawing` | exact rasterization, and blur by lens and motion |
//! | `sun` | a low sun, and striped shadows |
//! | `density` | pixels per radian where an eye sees a body |
//! | `own_airframe` | the observer's own airframe in front of everything |
//! | `scene`, `picture` | the parts of a frame, and the image that they are drawn on |
//! | `sphere`, `sphere_picture` | drawing on an equirectangular image, row by row |
//! | `tiles`, `panorama`, `tiled_picture` | drawing on any other image, tile by tile |
//! | `response`, `sensor` | response curve, clipping, noise |
//! | `schedule`, `ahead` | in flight: drawing of frames ahead of their time |
//! | `settings` | the world for a configuration |
//! | `messages` | the truth about a frame, as messages |
//! | `core` | the order of frames, and their messages |
//! | `film` | a flight outside of a pipeline |
//! | `stage` | the ports around it |

mod ahead;
mod backdrop;
mod blend;
mod core;
mod cube;
mod density;
mod drawing;
mod drone;
mod drone_motion;
mod error;
mod eyes;
mod film;
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

pub use crate::core::PictureMessages;
pub use error::{RenderError, WorldError};
pub use film::draw_flight;
pub use moment::{Attitude, Moment, Placement};
pub use parameters::WorldParameters;
pub use response::CameraCurve;
pub use truth::{FrameTruth, TargetTruth};
pub use world::World;

/// The simulator stage's process. It is part of the library, so that it is compiled once.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::SimulatorStage>()
}
