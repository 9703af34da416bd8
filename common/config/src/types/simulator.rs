//! The simulated world, as types.

use std::path::PathBuf;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::camera::FisheyeLens;

/// The simulated world.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Simulator {
    /// The same seed gives the same flight.
    #[schemars(range(min = 0, max = 4294967295u32))]
    pub seed: u32,
    /// How many of the configured bodies fly.
    #[schemars(range(min = 0, max = 32))]
    pub neighbours: u32,
    /// Frames a second.
    #[schemars(range(min = 0.1, max = 240.0))]
    pub frames_per_second: f64,
    /// Frames until the flight ends; 0: it does not.
    #[schemars(range(min = 0))]
    pub frames: u64,
    /// Length of the exposure, milliseconds.
    #[schemars(range(min = 0.01, max = 1000.0))]
    pub exposure_ms: f64,
    /// Nearest and farthest distance of the neighbours, metres.
    pub distance_m: [f64; 2],
    /// Fastest that a neighbour flies, metres a second.
    #[schemars(range(min = 0.0, max = 20.0))]
    pub speed_m_s: f64,
    /// The observer's own yaw, degrees a second.
    #[schemars(range(min = -360.0, max = 360.0))]
    pub yaw_deg_s: f64,
    /// Farthest that gusts make drones lean, the observer and its neighbours, degrees. 0: calm air.
    #[schemars(range(min = 0.0, max = 45.0))]
    pub tilt_deg: f64,
    /// By how much gusts make drones yaw faster or slower than they would, degrees a second.
    #[schemars(range(min = 0.0, max = 360.0))]
    pub yaw_swing_deg_s: f64,
    /// By how many stops pictures are brighter than they should be; darker if negative. Motion blur does not change.
    #[schemars(range(min = -8.0, max = 8.0))]
    pub exposure_stops: f64,
    /// By how many stops pictures become brighter and darker in turn, as an auto-exposure makes them that follows the
    /// backdrop and knows nothing of the bodies.
    #[schemars(range(min = 0.0, max = 4.0))]
    pub exposure_swing_stops: f64,
    /// A low sun that shines on the bodies, in stripes if things cast shadows. Left out: the hall's lamps alone.
    pub sun: Option<SimulatedSun>,
    /// Sensor noise as a multiple of the default camera's; 0: none.
    #[schemars(range(min = 0.0, max = 20.0))]
    pub noise: f64,
    /// Whether airframes hide markers.
    pub airframes: bool,
    /// Its inertial sensor, for `inertial.source: sim`.
    pub inertial: SimulatedInertial,
    /// A JSON file of the same bodies as they really are, if they differ from what is searched for.
    pub bodies: Option<PathBuf>,
    /// `camera.lens_distance_m` as it really is, metres. Left out: as the camera's.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lens_distance_m: Option<f64>,
    /// How the picture of an equirectangular camera is stitched from those of two lenses. Left out: perfectly, for
    /// infinity. Given, the camera is one that nobody knows: its lenses and its response are learned.
    pub stitch: Option<SimulatedStitch>,
    /// `camera.lenses` as they really are; empty: as the camera's.
    #[schemars(length(max = 2))]
    pub lenses: Vec<FisheyeLens>,
    /// This drone's place in a swarm whose drones all look at one world. Left out: the neighbours fly round it.
    pub swarm: Option<SimulatedSwarm>,
}

/// A place in a simulated swarm: a ring of drones, each with a pipeline of its own on this machine. The bodies
/// are the other drones, in the order of their numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SimulatedSwarm {
    /// This drone's number, from 0 to `simulator.neighbours`.
    pub drone: u32,
    /// When the world's time was 0, CLOCK_MONOTONIC of this machine, nanoseconds: the same for all drones.
    pub start_ns: i64,
}

impl Default for Simulator {
    fn default() -> Self {
        Self {
            seed: 1,
            neighbours: 1,
            frames_per_second: 30.0,
            frames: 0,
            exposure_ms: 6.25,
            distance_m: [0.6, 2.0],
            speed_m_s: 0.8,
            yaw_deg_s: 12.0,
            tilt_deg: 0.0,
            yaw_swing_deg_s: 0.0,
            exposure_stops: 0.0,
            exposure_swing_stops: 0.0,
            sun: None,
            noise: 1.0,
            airframes: true,
            inertial: SimulatedInertial::default(),
            bodies: None,
            lens_distance_m: None,
            stitch: None,
            lenses: Vec::new(),
            swarm: None,
        }
    }
}

/// How the simulated camera stitches its picture, and what it does with it then. The zeros are a perfect camera.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SimulatedStitch {
    /// The distance of things whose halves fit together, metres; 0: infinity.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub fits_at_m: f64,
    /// Width of the strip in which the pictures of both lenses are mixed, degrees.
    #[schemars(range(min = 0.0, max = 30.0))]
    pub blend_deg: f64,
    /// By how much one lens is turned against the other, degrees.
    #[schemars(range(min = 0.0, max = 5.0))]
    pub turn_deg: f64,
    /// By how much the lenses' curves are off at the border, outwards; it falls with the third power of the angle from
    /// the axis. Degrees.
    #[schemars(range(min = -5.0, max = 5.0))]
    pub rim_deg: f64,
    /// By how much the picture of the lens behind is darker, as a share of its light.
    #[schemars(range(min = 0.0, max = 0.9))]
    pub darker: f64,
    /// Sharpening: how many times the difference between a pixel and its surroundings is added to it.
    #[schemars(range(min = 0.0, max = 3.0))]
    pub sharpening: f64,
    /// By how much the tone curve is bent to an S, from 0 to 1: shadows darker and lights brighter than the camera's
    /// response has them.
    #[schemars(range(min = 0.0, max = 0.9))]
    pub tone: f64,
}

/// The simulated sun.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SimulatedSun {
    /// How many times brighter a surface is that faces it than the same one in the shade.
    #[schemars(range(min = 1.0, max = 100.0))]
    pub ratio: f64,
    /// Its height above the horizon, degrees.
    #[schemars(range(min = -90.0, max = 90.0))]
    pub elevation_deg: f64,
    /// Its direction in the world, counterclockwise from where a single observer looks at the start, degrees.
    #[schemars(range(min = -360.0, max = 360.0))]
    pub azimuth_deg: f64,
    /// Width of a stripe of sun and of the shadow beside it together, metres, 0.005 or more; 0: nothing casts
    /// shadows.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub stripes_m: f64,
}

impl Default for SimulatedSun {
    fn default() -> Self {
        Self { ratio: 4.0, elevation_deg: 15.0, azimuth_deg: 40.0, stripes_m: 0.0 }
    }
}

/// The simulated inertial sensor as it really is: what `inertial` in the configuration need not know.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SimulatedInertial {
    /// Samples a second.
    #[schemars(range(min = 20.0, max = 4000.0))]
    pub rate_hz: f64,
    /// Constant error of the rate about each axis, degrees a second, of a sign of its own.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub bias_deg_s: f64,
    /// White noise of each sample's rate, degrees a second.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub noise_deg_s: f64,
    /// Turns the sensor's axes into the camera's: unit quaternion x, y, z, w.
    pub camera_from_sensor: [f64; 4],
    /// What has to be added to the sensor's time to get the camera's, milliseconds.
    #[schemars(range(min = -1000.0, max = 1000.0))]
    pub time_offset_ms: f64,
}

impl Default for SimulatedInertial {
    fn default() -> Self {
        Self {
            rate_hz: 200.0,
            bias_deg_s: 0.5,
            noise_deg_s: 0.1,
            camera_from_sensor: [0.0, 0.0, 0.0, 1.0],
            time_offset_ms: 0.0,
        }
    }
}
