//! The views that cover the configured camera's sphere.

use flockeye_geometry::partition::{Partition, PartitionError};
use flockeye_geometry::search::GazeOptions;
use flockeye_geometry::view::View;

use crate::camera::CameraSettingError;
use crate::config::Pipeline;

/// Why the sphere has no views.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SphereViewsError {
    /// The camera cannot be.
    #[error(transparent)]
    Camera(#[from] CameraSettingError),
    /// A margin that leaves no view.
    #[error("partition: {0}")]
    Partition(#[from] PartitionError),
}

impl Pipeline {
    /// The directions that share the sphere.
    pub fn sphere_partition(&self) -> Partition {
        Partition::icosahedron()
    }

    /// The partitions as views at the sphere's own resolution, which overlap by
    /// `partition.margin_deg`, or by `largest_marker_m` seen from `partition.nearest_m`.
    ///
    /// # Errors
    /// A margin that leaves no view; a camera that cannot be.
    pub fn partition_views(&self, largest_marker_m: f64) -> Result<Vec<View>, SphereViewsError> {
        let margin_rad = match self.partition.margin_deg {
            Some(degrees) => degrees.to_radians(),
            None => 2.0 * (largest_marker_m / (2.0 * self.partition.nearest_m)).atan(),
        };
        let pixels_per_radian = self.camera_model()?.pixels_per_radian();
        Ok(self.sphere_partition().views(margin_rad, pixels_per_radian)?)
    }

    /// Pixels along the side of the largest view that this pipeline cuts.
    ///
    /// # Errors
    /// As [`Pipeline::partition_views`].
    pub fn largest_view_px(&self, largest_marker_m: f64) -> Result<u32, SphereViewsError> {
        let partitions = self.partition_views(largest_marker_m)?;
        let largest = partitions.iter().map(|view| view.size_px).max().unwrap_or(0);
        Ok(largest.max(self.gaze_options()?.size_max_px))
    }

    /// How gaze views are cut from this camera's frames.
    ///
    /// # Errors
    /// A camera that cannot be.
    pub fn gaze_options(&self) -> Result<GazeOptions, CameraSettingError> {
        Ok(GazeOptions {
            partitions_per_frame: self.search.lossless_partitions as usize,
            ..GazeOptions::new(self.camera_model()?.pixels_per_radian())
        })
    }
}
