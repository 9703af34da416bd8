//! The camera's part of the configuration.

use std::path::PathBuf;

use flockeye_contract::{Projection, Transfer};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::mount::Mount;

/// The spherical camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
#[schemars(rename = "Camera")]
pub struct CameraSettings {
    /// Pixels in a row.
    #[schemars(range(min = 64, max = 16384))]
    pub width: u32,
    /// Rows.
    #[schemars(range(min = 32, max = 8192))]
    pub height: u32,
    /// The camera model.
    pub projection: Projection,
    /// Of an equirectangular camera: the distance between the two lenses it was stitched from, one
    /// looking ahead and one back, metres; 0 for a camera with one centre. Left out: 0 for the simulator;
    /// for other sources it is learned from bodies across the border between the lenses.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub lens_distance_m: Option<f64>,
    /// Of a dual fisheye camera: its two lenses, the one that looks ahead first.
    #[schemars(length(max = 2))]
    pub lenses: Vec<FisheyeLens>,
    /// Of a stereographic image: angle across its circle, degrees.
    #[schemars(range(min = 1.0, max = 350.0))]
    pub stereographic_field_deg: f64,
    /// How far rays of this model are off, in pixels of the picture's middle, one standard deviation.
    /// Neighbouring rays have nearly the same error.
    /// Left out: 0.3 for lenses of a dual fisheye camera, 0.15 for an equirectangular picture of which the
    /// lenses are learned, 0 for other cameras and for a simulated one that is as configured.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub lens_error_px: Option<f64>,
    /// The distance for which rays are exact where no neighbour is predicted, metres. It matters only if
    /// lenses are off the camera's centre.
    #[schemars(range(min = 0.1, max = 1000.0))]
    pub assumed_distance_m: f64,
    /// A PNG image of the frames' size, black where the own airframe always hides the view; left out:
    /// everything is visible.
    pub mask: Option<PathBuf>,
    /// The curve between light and code values. Left out: sRGB for the simulator. For other sources it is
    /// learned from the print of the bodies that are seen, and sRGB until then.
    pub response: Option<Transfer>,
    /// Exponent of `response: gamma`.
    #[schemars(range(min = 0.1, max = 10.0))]
    pub gamma: f32,
    /// The radiance of codes at equal steps from 0 to 255, for `response: table`: 2 to 256 rising
    /// numbers, in any unit.
    #[schemars(length(max = 256))]
    pub response_table: Vec<f64>,
    /// Time between a frame's exposure and its arrival, milliseconds: subtracted from arrival.
    #[schemars(range(min = 0.0, max = 10000.0))]
    pub latency_ms: f64,
    /// Time between the first and the last row's exposure, milliseconds.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub readout_ms: f64,
    /// How long a frame is exposed, milliseconds; 0: not known. Then it is learned from the blur of tracked
    /// neighbours, once one moves by more than about a pixel during the exposure.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub exposure_ms: f64,
}

impl Default for CameraSettings {
    fn default() -> Self {
        Self {
            width: 3840,
            height: 1920,
            projection: Projection::Equirectangular,
            lens_distance_m: None,
            lenses: Vec::new(),
            stereographic_field_deg: 300.0,
            lens_error_px: None,
            assumed_distance_m: 1.5,
            mask: None,
            response: None,
            gamma: 2.2,
            response_table: Vec::new(),
            latency_ms: 0.0,
            readout_ms: 0.0,
            exposure_ms: 0.0,
        }
    }
}

/// A fisheye lens of a dual fisheye camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct FisheyeLens {
    /// Where its axis meets the image, pixels.
    pub centre_px: [f64; 2],
    /// Radius of its image circle, pixels.
    #[schemars(range(min = 1.0, max = 16384.0))]
    pub circle_px: f64,
    /// Angle across its field, degrees.
    #[schemars(range(min = 10.0, max = 300.0))]
    pub field_deg: f64,
    /// Where the lens (x right and y down in the image, z along its axis) sits in the camera.
    pub camera_from_lens: Mount,
    /// Calibrated focal lengths along rows and columns, pixels; left out: the field fills the
    /// circle, equidistantly.
    pub focal_px: Option<[f64; 2]>,
    /// Calibrated k1 to k4 of Kannala and Brandt's curve (OpenCV's `fisheye`).
    pub equidistant: Option<[f64; 4]>,
    /// Calibrated xi and alpha of the double sphere model (Kalibr's `ds`).
    pub double_sphere: Option<[f64; 2]>,
    /// Calibrated xi, k1, k2, p1, p2 of the unified model with a pinhole's distortion (Kalibr's
    /// `omni-radtan`, camodocal's `MEI`).
    pub unified: Option<[f64; 5]>,
}
