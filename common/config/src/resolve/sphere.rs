//! The views that cover the configured camera's sphere.

use std::f64::consts::PI;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

use flockeye_contract::MAX_VIEW_PX;
use flockeye_geometry::camera::Camera;
use flockeye_geometry::partition::{self, Method, Partition, PartitionError};
use flockeye_geometry::view::View;

use super::error::SettingError;
use crate::types::{PartitionSettings, Pipeline};

/// Overlap of the high-resolution tiles, radians. It is small, because distant neighbours and their
/// markers look small.
const FAR_MARGIN_RAD: f64 = 2.5 / 180.0 * PI;

/// Side of the largest of these views, pixels, if no message has room for it.
fn too_large(views: &[View]) -> Option<u32> {
    views.iter().map(|view| view.size_px).max().filter(|&size_px| size_px > MAX_VIEW_PX)
}

/// Key of a fault in a partition.
pub(crate) const PARTITION: &str = "partition";

pub(crate) fn of_partition(error: PartitionError) -> SettingError {
    SettingError::new(PARTITION, error)
}

/// Method and number of views.
type Key = (Method, usize);

/// Partitions that this process computed, because they are not stored.
static FOUND: Mutex<Vec<(Key, Partition)>> = Mutex::new(Vec::new());

/// Directions that divide the sphere: the same in every process of a pipeline.
fn partition(settings: &PartitionSettings) -> Result<Partition, PartitionError> {
    let (method, count, seed) = (settings.method.into(), settings.count, partition::STORED_SEED);
    let key = (method, count);
    if Partition::is_stored(method, count, seed) {
        return Partition::of(method, count, seed);
    }
    // Computed once in each process: the check of the configuration needs it, then the stage.
    let mut found = FOUND.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some((_, partition)) = found.iter().find(|(known, _)| *known == key) {
        return Ok(partition.clone());
    }
    let start = Instant::now();
    let partition = Partition::of(method, count, seed)?;
    tracing::info!(
        count,
        seconds = start.elapsed().as_secs_f64(),
        "this partition of the sphere is not stored: computed it"
    );
    found.push((key, partition.clone()));
    Ok(partition)
}

/// Division of the sphere: the directions of the partitions, and the overlap of their views.
#[derive(Debug, Clone)]
pub struct Division {
    /// The directions that divide the sphere.
    pub partition: Partition,
    /// Overlap of the partitions, radians: the largest marker seen from `partition.nearest_m`.
    pub margin_rad: f64,
    /// Field of the partitions' views, radians.
    pub field_rad: f64,
}

impl Division {
    /// The configured division for bodies whose largest marker has a side of `largest_marker_m`.
    ///
    /// # Errors
    /// A number of views for which there is no partition, or a margin that leaves no view.
    pub(crate) fn of(
        settings: &PartitionSettings,
        largest_marker_m: f64,
    ) -> Result<Self, PartitionError> {
        let partition = partition(settings)?;
        let margin_rad = 2.0 * (largest_marker_m / (2.0 * settings.nearest_m)).atan();
        let field_rad = partition.field_rad(margin_rad)?;
        Ok(Self { partition, margin_rad, field_rad })
    }

    /// The partitions as views, at the resolution of the profile.
    ///
    /// # Errors
    /// A margin that leaves no view; views that no message can carry.
    pub(crate) fn views(
        &self,
        pipeline: &Pipeline,
        camera: &Camera,
    ) -> Result<Vec<View>, SettingError> {
        let pixels_per_radian = camera.pixels_per_radian() * pipeline.tile_magnification();
        let views = self.partition.views(self.margin_rad, pixels_per_radian);
        let views = views.map_err(of_partition)?;
        let Some(size_px) = too_large(&views) else { return Ok(views) };
        let reason = format!(
            "{} views of this camera's sphere have {size_px} px a side, and a view has {MAX_VIEW_PX} at \
             most. Cure: more views, a larger partition.nearest_m, or smaller frames",
            views.len()
        );
        Err(SettingError::new("partition.count", reason))
    }
}

/// High-resolution views for neighbours too far for the partitions. They are the stored covering
/// with the most views, at the sphere's resolution times `search.far_magnification`. None where the
/// partitions have the same resolution, and where no region of interest would follow.
///
/// # Errors
/// A margin that leaves no view; views that no message can carry.
pub(crate) fn high_resolution_tiles(
    pipeline: &Pipeline,
    camera: &Camera,
) -> Result<Vec<View>, SettingError> {
    let far_magnification = pipeline.search.far_magnification;
    if !pipeline.has_regions() || far_magnification <= pipeline.tile_magnification() {
        return Ok(Vec::new());
    }
    let count = *partition::STORED.end();
    let partition = Partition::of(Method::Covering, count, partition::STORED_SEED);
    let pixels_per_radian = camera.pixels_per_radian() * far_magnification;
    let views = partition.and_then(|partition| partition.views(FAR_MARGIN_RAD, pixels_per_radian));
    let views = views.map_err(of_partition)?;
    let Some(size_px) = too_large(&views) else { return Ok(views) };
    let reason = format!(
        "high-resolution tiles of this camera's sphere have {size_px} px a side, and a view has \
         {MAX_VIEW_PX} at most. Cure: a smaller magnification, or smaller frames"
    );
    Err(SettingError::new("search.far_magnification", reason))
}
