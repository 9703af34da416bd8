//! Values that a process computes once from a configuration.

mod bodies;
mod camera;
mod error;
mod mask;
mod mount;
mod sphere;

use std::sync::OnceLock;

use flockeye_contract::Transfer;
use flockeye_geometry::body::Bodies;
use flockeye_geometry::camera::Camera;
use flockeye_geometry::mask::Mask;
use flockeye_geometry::pose::LensError;
use flockeye_geometry::search::{ROI_SIZE_MAX_PX, RoiOptions};
use flockeye_geometry::view::View;
use nalgebra::Isometry3;

use crate::types::Pipeline;

pub use bodies::{bodies, read_bodies};
pub use error::{ResolveError, SettingError};
pub use mount::isometry;
pub use sphere::Division;

// Parts that the check of a configuration needs before all of them are valid.
pub(crate) use bodies::preset_body;
pub(crate) use camera::{camera, response_table, simulated_camera};
pub(crate) use sphere::{PARTITION, high_resolution_tiles};

/// Number of tiles searched after the regions of interest in each frame with `profile: unlimited`.
/// It is a third of the default partitions. So a few frames sweep the sphere, and their processing
/// times are similar.
const UNLIMITED_TILES: usize = 4;

/// A configuration, and the values computed from it: bodies with their geometry, the camera, the
/// views of its sphere. Built once for each process.
#[derive(Debug, Clone)]
pub struct Resolved {
    /// The configuration as it was read.
    pub pipeline: Pipeline,
    /// Marker bodies of the neighbours. The index of a body is the `target` number of the contract.
    pub bodies: Bodies,
    /// The camera model, exact for `camera.assumed_distance_m`.
    pub camera: Camera,
    /// Pose of the camera on this drone.
    pub observer_from_camera: Isometry3<f64>,
    /// The code of the camera's transfer curve, and its gamma where it has one (else 0).
    pub transfer: (Transfer, f32),
    /// Radiance of each code, white being 1, where `camera.response` is a table. `None` for the
    /// curves that headers name.
    pub measured_response: Option<[f32; 256]>,
    /// Division of the sphere.
    pub division: Division,
    /// The partitions as views, in the order of their numbers.
    pub partition_views: Vec<View>,
    /// Views that sweep the sphere for neighbours too far for the partitions; there may be none.
    pub high_resolution_tiles: Vec<View>,
    /// Parameters for cutting regions of interest from this camera's frames.
    pub roi_options: RoiOptions,
    mask: OnceLock<Mask>,
}

impl Resolved {
    /// Resolves `pipeline`.
    ///
    /// # Errors
    /// A bodies file that cannot be read, or settings that contradict it. For a pipeline that was
    /// not read by [`Pipeline::load`], also everything that `load` refuses.
    pub fn of(pipeline: Pipeline) -> Result<Self, ResolveError> {
        let bodies = bodies(&pipeline.bodies)?;
        Self::with_bodies(pipeline, bodies)
    }

    /// Resolves `pipeline` with known bodies, such as those of a recording.
    ///
    /// # Errors
    /// As [`Resolved::of`], but no file of bodies is read.
    pub fn with_bodies(pipeline: Pipeline, bodies: Bodies) -> Result<Self, ResolveError> {
        let camera = camera(&pipeline.camera)?;
        let division = Division::of(&pipeline.partition, bodies.largest_side())
            .map_err(sphere::of_partition)?;
        Ok(Self {
            observer_from_camera: isometry(&pipeline.observer.observer_from_camera),
            transfer: camera::transfer(&pipeline.camera),
            measured_response: camera::measured_response(&pipeline.camera)?,
            partition_views: division.views(&pipeline, &camera)?,
            high_resolution_tiles: high_resolution_tiles(&pipeline, &camera)?,
            roi_options: RoiOptions {
                partitions_per_frame: UNLIMITED_TILES,
                ..RoiOptions::new(camera.pixels_per_radian())
            },
            mask: OnceLock::new(),
            pipeline,
            bodies,
            camera,
            division,
        })
    }

    /// Visible pixels: all of the image circles, except those that `camera.mask` hides. The file is
    /// read at the first use, because only some processes need it.
    ///
    /// # Errors
    /// The file cannot be read, or is of another size than the frames.
    pub fn mask(&self) -> Result<&Mask, SettingError> {
        match self.mask.get() {
            Some(mask) => Ok(mask),
            None => {
                let mask = mask::mask(self.pipeline.camera.mask.as_deref(), &self.camera)?;
                Ok(self.mask.get_or_init(|| mask))
            }
        }
    }

    /// Bodies of the simulated world: those of `simulator.bodies` replace the configured ones of
    /// the same name.
    ///
    /// # Errors
    /// The file cannot be read, or has other ids or another dictionary.
    pub fn simulated_bodies(&self) -> Result<Bodies, ResolveError> {
        match &self.pipeline.simulator.bodies {
            Some(path) => bodies::simulated_bodies(&self.bodies, path),
            None => Ok(self.bodies.clone()),
        }
    }

    /// Camera of the simulated world: with the lenses of `simulator` instead of the configured
    /// ones.
    ///
    /// # Errors
    /// Lenses that no camera has.
    pub fn simulated_camera(&self) -> Result<Camera, SettingError> {
        simulated_camera(&self.pipeline)
    }

    /// The error of the camera's model.
    pub fn lens_error(&self) -> LensError {
        LensError { deviation_rad: self.pipeline.lens_error_px() / self.camera.pixels_per_radian() }
    }

    /// Pixels along the side of the largest view that this pipeline cuts.
    pub fn largest_view_px(&self) -> u32 {
        let views = self.partition_views.iter().chain(&self.high_resolution_tiles);
        let largest = views.map(|view| view.size_px).max().unwrap_or(0);
        largest.max(ROI_SIZE_MAX_PX)
    }
}
