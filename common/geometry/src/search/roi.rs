//! Regions of interest: small magnified views at the predicted neighbours.

use nalgebra::{Isometry3, Matrix3, Unit, Vector3};

use super::{PlannerError, Purpose, Search, SearchView};
use crate::Ray;
use crate::body::{Body, Marker};
use crate::view::View;

/// Prediction of a neighbour at the exposure of the next frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PredictedNeighbour {
    /// The number of its body.
    pub target: usize,
    /// The middle of its body, in the camera frame.
    pub direction_in_camera: Ray,
    /// Rotation of that direction: rotation vector a second, in the camera frame, radians/s.
    pub rate_in_camera: Vector3<f64>,
    /// Angle from the body's middle to its rim, radians.
    pub radius_rad: f64,
    /// Standard deviation of the direction, radians.
    pub deviation_rad: f64,
    /// Apparent side of the smallest marker that is to be decoded, seen frontally, radians.
    pub marker_rad: f64,
    /// Whether it was not measured for some frames, so that it may be elsewhere.
    pub is_stale: bool,
}

impl PredictedNeighbour {
    /// View parameters from a predicted pose of `body`'s markers.
    ///
    /// `position_covariance` (m^2) and `velocity_in_camera` (m/s) belong to the markers' origin in
    /// the camera frame; the velocity is relative to the camera. `None` for a pose that is not
    /// finite or has the camera inside the body.
    pub fn from_pose(
        target: usize,
        body: &Body,
        camera_from_markers: &Isometry3<f64>,
        position_covariance: &Matrix3<f64>,
        velocity_in_camera: &Vector3<f64>,
    ) -> Option<Self> {
        let position = camera_from_markers.translation.vector;
        let range = position.norm();
        let radius = body.radius();
        let smallest_side = body.markers.iter().map(Marker::side).fold(f64::INFINITY, f64::min);
        if !(range > radius && range.is_finite() && smallest_side.is_finite()) {
            return None;
        }
        let direction = Unit::new_normalize(position);
        // Only motion across the line of sight moves the body in the view.
        let across = Matrix3::identity() - direction.into_inner() * direction.transpose();
        let lateral = across * position_covariance * across;
        let variance = lateral.symmetric_eigenvalues().max();
        Some(Self {
            target,
            direction_in_camera: direction,
            rate_in_camera: position.cross(velocity_in_camera) / (range * range),
            radius_rad: (radius / range).asin(),
            deviation_rad: variance.max(0.0).sqrt() / range,
            marker_rad: smallest_side / range,
            is_stale: false,
        })
    }
}

/// Side of the smallest marker to decode in the view, pixels.
const MARKER_PX: f64 = 80.0;
/// Least side of that marker for any uncertainty of the direction, pixels: no smaller marker
/// decodes.
const MARKER_LEAST_PX: f64 = 24.0;
/// Largest magnification over the sphere's own resolution.
const MAGNIFICATION_MAX: f64 = 3.0;
/// Smallest and largest field of a view, degrees.
const FIELD_MIN_DEG: f64 = 4.0;
const FIELD_MAX_DEG: f64 = 70.0;
/// Margin on either side of the body, in standard deviations of the direction.
const MARGIN_DEVIATIONS: f64 = 3.0;
/// Pixels along the side of the largest view.
pub const ROI_SIZE_MAX_PX: u32 = 640;

/// Options of regions of interest: their share of a frame beside the partitions, and the resolution
/// of their source.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RoiOptions {
    /// The sphere image's own resolution, pixels for each radian.
    pub pixels_per_radian: f64,
    /// Number of partitions that a lossless run searches in each frame beside the neighbours'
    /// views.
    pub partitions_per_frame: usize,
}

impl RoiOptions {
    /// The defaults for a sphere image of this resolution (pixels for each radian).
    pub fn new(pixels_per_radian: f64) -> Self {
        Self { pixels_per_radian, partitions_per_frame: 2 }
    }

    pub(super) fn check(&self) -> Result<(), PlannerError> {
        let within = |name, value: f64, most: f64, cure| {
            if (1.0..=most).contains(&value) {
                Ok(())
            } else {
                Err(PlannerError::Roi { name, value, cure })
            }
        };
        within("pixels_per_radian", self.pixels_per_radian, 1e5, "1 to 100000 are allowed")?;
        within(
            "partitions_per_frame",
            self.partitions_per_frame as f64,
            256.0,
            "at least 1, or a newcomer is never found",
        )
    }
}

/// The view for one neighbour, centred on its direction. Its field is the body's angular diameter
/// and the margins for uncertainty.
///
/// It is magnified until the smallest marker has `MARKER_PX`, up to `MAGNIFICATION_MAX`. The field
/// must also fit the largest view. But markers get at least `MARKER_LEAST_PX` and the sphere's own
/// resolution. If both are impossible, the field is reduced around the most likely direction,
/// because a wide field in which nothing decodes is useless. Markers of a close neighbour are large
/// enough, so its view has less than the sphere's resolution.
///
/// `None` for a prediction that is not finite.
pub fn roi_view(neighbour: &PredictedNeighbour, pixels_per_radian: f64) -> Option<SearchView> {
    let wanted_rad = 2.0 * (neighbour.radius_rad + MARGIN_DEVIATIONS * neighbour.deviation_rad);
    let finite = wanted_rad.is_finite()
        && neighbour.marker_rad > 0.0
        && neighbour.direction_in_camera.iter().all(|x| x.is_finite())
        && neighbour.rate_in_camera.iter().all(|x| x.is_finite());
    if !finite {
        return None;
    }
    let field_rad = wanted_rad.clamp(FIELD_MIN_DEG.to_radians(), FIELD_MAX_DEG.to_radians());
    // Pixels across the view for each pixel of focal length.
    let span = 2.0 * (field_rad / 2.0).tan();
    let own = pixels_per_radian;
    let most = own * MAGNIFICATION_MAX;
    let wanted_at = MARKER_PX / neighbour.marker_rad;
    let least = (MARKER_LEAST_PX / neighbour.marker_rad).clamp(own, most).min(wanted_at);
    let fits_at = f64::from(ROI_SIZE_MAX_PX) / span;
    let focal_px = wanted_at.clamp(own, most).min(fits_at).max(least);
    // f64 to u32 saturates, so an absurd prediction cannot wrap around.
    let size_px = ((focal_px * span).ceil() as u32).clamp(1, ROI_SIZE_MAX_PX);
    let upright = View::looking_at(&neighbour.direction_in_camera, field_rad, size_px);
    Some(SearchView {
        view: View { focal_px, ..upright },
        purpose: Purpose::Roi(neighbour.target),
        search: Search::AllWindows,
        rate_in_camera: neighbour.rate_in_camera,
    })
}
