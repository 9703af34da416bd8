//! A synthetic world in place of a spherical camera: frames, and the truth about them.
//!
//! [`World::render`] writes the 8-bit luma plane of a frame into memory that it is given, and says
//! where every body was. Nothing here knows of processes, clocks or files.
//!
//! ```
//! use flockeye_geometry::body::{Bodies, squares};
//! use flockeye_simulator::{PatternBook, World, WorldParameters};
//!
//! let bodies = Bodies::new("DICT_5X5_250".into(), vec![squares("alpha", 0.0625, 0.05, 0)])?;
//! let parameters = WorldParameters { width: 512, height: 256, ..Default::default() };
//! let mut world = World::new(parameters, &bodies, &PatternBook::dict_5x5_250())?;
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
//! | [`parameters`] | what a world can be told |
//! | [`patterns`] | which cells of a marker are white |
//! | [`trajectory`] | where the bodies are at a time |
//! | [`hall`], [`backdrop`] | the panorama behind them: painted and blurred once, then turned |
//! | [`solid`], [`drone`] | bodies and airframes as painted convex parts |
//! | [`raster`], [`optics`], [`drawing`] | drawn with exact area coverage, blurred by lens and motion, laid on the sphere |
//! | [`own_airframe`] | the observer's own legs over everything |
//! | [`sensor`] | sRGB curve, clipping, noise |

pub mod backdrop;
pub mod drawing;
pub mod drone;
pub mod hall;
pub mod optics;
pub mod own_airframe;
pub mod parameters;
pub mod patterns;
pub mod raster;
pub mod scatter;
pub mod schedule;
pub mod sensor;
pub mod solid;
pub mod sphere;
pub mod stage;
pub mod trajectory;
pub mod truth;
pub mod world;

pub use parameters::{Quality, WorldParameters};
pub use patterns::PatternBook;
pub use truth::{FrameTruth, TargetTruth};
pub use world::{Moment, Placement, RenderError, World, WorldError};
