//! The views that cover the configured camera's sphere.

use std::f64::consts::PI;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use flockeye_contract::MAX_VIEW_PX;
use flockeye_geometry::partition::{self, Criterion, Method, Partition, PartitionError, Weights};
use flockeye_geometry::search::GazeOptions;
use flockeye_geometry::view::View;

use super::camera::CameraSettingError;
use crate::types::{Auto, Count, Filter, Pipeline};

/// Why the sphere has no views.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum SphereViewsError {
    /// The camera cannot be.
    #[error(transparent)]
    Camera(#[from] CameraSettingError),
    /// A margin that leaves no view.
    #[error("partition: {0}")]
    Partition(#[from] PartitionError),
    /// Views that no message can carry.
    #[error(
        "partition.count: {count} views of this camera's sphere have {size_px} px a side, and a view \
         has {MAX_VIEW_PX} at most. Cure: more views, a smaller margin, smaller frames, or a smaller \
         partition.magnification"
    )]
    TooLarge {
        /// How many views.
        count: usize,
        /// Their side, pixels.
        size_px: u32,
    },
    /// Far views that no message can carry.
    #[error(
        "search.far_magnification: far views of this camera's sphere have {size_px} px a side, and a \
         view has {MAX_VIEW_PX} at most. Cure: a smaller magnification, or smaller frames"
    )]
    FarTooLarge {
        /// Their side, pixels.
        size_px: u32,
    },
}

/// Overlap of the far views, radians: who is looked for there is so far that its markers are smaller.
const FAR_MARGIN_RAD: f64 = 2.5 / 180.0 * PI;

/// The side of the largest of these views, pixels, if no message can carry it.
fn too_large(views: &[View]) -> Option<u32> {
    views.iter().map(|view| view.size_px).max().filter(|&size_px| size_px > MAX_VIEW_PX)
}

/// Method, number of views and seed.
type Key = (Method, usize, u64);

/// Partitions that this process had to find.
static FOUND: Mutex<Vec<(Key, Partition)>> = Mutex::new(Vec::new());

impl Pipeline {
    /// How many views cover the sphere.
    ///
    /// # Errors
    /// Weights that are none.
    pub fn partition_count(&self) -> Result<usize, PartitionError> {
        match self.partition.count {
            Count::Views(count) => Ok(count),
            Count::Chosen(Auto::Auto) => {
                Ok(Criterion::new(Weights::new(self.partition.weights)?).choice())
            }
        }
    }

    /// The directions that share the sphere: every process of a pipeline finds the same.
    ///
    /// # Errors
    /// A number of views for which there is no partition.
    pub fn sphere_partition(&self) -> Result<Partition, PartitionError> {
        let method = self.partition.method.into();
        let key = (method, self.partition_count()?, u64::from(self.partition.seed));
        let (method, count, seed) = key;
        if Partition::is_stored(method, count, seed) {
            return Partition::of(method, count, seed);
        }
        // Found once in each process.
        let mut found = FOUND.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, partition)) = found.iter().find(|(known, _)| *known == key) {
            return Ok(partition.clone());
        }
        let start = Instant::now();
        let partition = Partition::of(method, count, seed)?;
        tracing::info!(
            count,
            seed,
            seconds = start.elapsed().as_secs_f64(),
            "this partition of the sphere is not stored: found it from its seed"
        );
        found.push((key, partition.clone()));
        Ok(partition)
    }

    /// Overlap of the partitions, radians: `partition.margin_deg`, or `largest_marker_m` seen from
    /// `partition.nearest_m`.
    pub fn partition_margin_rad(&self, largest_marker_m: f64) -> f64 {
        match self.partition.margin_deg {
            Some(degrees) => degrees.to_radians(),
            None => 2.0 * (largest_marker_m / (2.0 * self.partition.nearest_m)).atan(),
        }
    }

    /// Field of the partitions' views, radians.
    ///
    /// # Errors
    /// A margin that leaves no view.
    pub fn partition_field_rad(&self, largest_marker_m: f64) -> Result<f64, PartitionError> {
        self.sphere_partition()?.field_rad(self.partition_margin_rad(largest_marker_m))
    }

    /// Pixels of the partitions' views for each of the sphere's, along a side.
    pub fn partition_magnification(&self) -> f64 {
        // Gaze views are magnified, but without tracks there are none.
        let without_gaze = if self.fusion.filter == Filter::None { 2.0 } else { 1.0 };
        self.partition.magnification.unwrap_or(without_gaze)
    }

    /// The partitions as views, at the sphere's resolution times
    /// [`Pipeline::partition_magnification`], which overlap by [`Pipeline::partition_margin_rad`].
    ///
    /// # Errors
    /// A margin that leaves no view; a camera that cannot be.
    pub fn partition_views(&self, largest_marker_m: f64) -> Result<Vec<View>, SphereViewsError> {
        let margin_rad = self.partition_margin_rad(largest_marker_m);
        let pixels_per_radian =
            self.camera_model()?.pixels_per_radian() * self.partition_magnification();
        let views = self.sphere_partition()?.views(margin_rad, pixels_per_radian)?;
        match too_large(&views) {
            Some(size_px) => Err(SphereViewsError::TooLarge { count: views.len(), size_px }),
            None => Ok(views),
        }
    }

    /// The views that sweep the sphere for neighbours too far for the partitions: the stored covering by
    /// most views, at the sphere's resolution times `search.far_magnification`. None where the
    /// partitions see as much, and where no gaze view would follow.
    ///
    /// # Errors
    /// A margin that leaves no view; a camera that cannot be.
    pub fn far_views(&self) -> Result<Vec<View>, SphereViewsError> {
        let magnification = self.search.far_magnification;
        if !self.gazes() || magnification <= self.partition_magnification() {
            return Ok(Vec::new());
        }
        let count = *partition::STORED.end();
        let partition = Partition::of(Method::Covering, count, partition::STORED_SEED)?;
        let pixels_per_radian = self.camera_model()?.pixels_per_radian() * magnification;
        let views = partition.views(FAR_MARGIN_RAD, pixels_per_radian)?;
        match too_large(&views) {
            Some(size_px) => Err(SphereViewsError::FarTooLarge { size_px }),
            None => Ok(views),
        }
    }

    /// Pixels along the side of the largest view that this pipeline cuts.
    ///
    /// # Errors
    /// As [`Pipeline::partition_views`].
    pub fn largest_view_px(&self, largest_marker_m: f64) -> Result<u32, SphereViewsError> {
        let (near, far) = (self.partition_views(largest_marker_m)?, self.far_views()?);
        let largest = near.iter().chain(&far).map(|view| view.size_px).max().unwrap_or(0);
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
