//! The configured camera and the views that cover its sphere.

use flockeye_contract::Transfer;
use flockeye_geometry::camera::Camera;
use flockeye_geometry::partition::{Partition, PartitionError};
use flockeye_geometry::search::GazeOptions;
use flockeye_geometry::view::View;

use crate::config::{Pipeline, Response};

impl Pipeline {
    /// The camera model.
    pub fn camera_model(&self) -> Camera {
        Camera::equirectangular(self.camera.width, self.camera.height)
    }

    /// The code of the camera's transfer curve, and its gamma where it has one.
    pub fn transfer(&self) -> (Transfer, f32) {
        match self.camera.response {
            Response::Srgb => (Transfer::Srgb, 0.0),
            Response::Gamma => (Transfer::Gamma, self.camera.gamma),
            Response::Linear => (Transfer::Linear, 0.0),
        }
    }

    /// The directions that share the sphere.
    pub fn sphere_partition(&self) -> Partition {
        Partition::icosahedron()
    }

    /// The partitions as views at the sphere's own resolution, which overlap by
    /// `partition.margin_deg`, or by `largest_marker_m` seen from `partition.nearest_m`.
    ///
    /// # Errors
    /// A margin that leaves no view.
    pub fn partition_views(&self, largest_marker_m: f64) -> Result<Vec<View>, PartitionError> {
        let margin_rad = match self.partition.margin_deg {
            Some(degrees) => degrees.to_radians(),
            None => 2.0 * (largest_marker_m / (2.0 * self.partition.nearest_m)).atan(),
        };
        self.sphere_partition().views(margin_rad, self.camera_model().pixels_per_radian())
    }

    /// Pixels along the side of the largest view that this pipeline cuts.
    ///
    /// # Errors
    /// As [`Pipeline::partition_views`].
    pub fn largest_view_px(&self, largest_marker_m: f64) -> Result<u32, PartitionError> {
        let partitions = self.partition_views(largest_marker_m)?;
        let largest = partitions.iter().map(|view| view.size_px).max().unwrap_or(0);
        Ok(largest.max(self.gaze_options().size_max_px))
    }

    /// How gaze views are cut from this camera's frames.
    pub fn gaze_options(&self) -> GazeOptions {
        GazeOptions {
            partitions_per_frame: self.search.lossless_partitions as usize,
            ..GazeOptions::new(self.camera_model().pixels_per_radian())
        }
    }
}
