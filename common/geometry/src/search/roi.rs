//! Regions of interest: small magnified views at where neighbours are predicted.

use nalgebra::{Isometry3, Matrix3, Unit, Vector3};

use super::{PlannedView, PlannerError, Purpose, Search};
use crate::Ray;
use crate::body::{Body, Marker};
use crate::view::View;

/// Where a neighbour will be when the next frame is exposed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PredictedNeighbour {
    /// The number of its body.
    pub target: usize,
    /// The middle of its body, in the camera frame.
    pub direction_in_camera: Ray,
    /// How that direction turns: rotation vector a second, in the camera frame, radians/s.
    pub rate_in_camera: Vector3<f64>,
    /// Angle from the body's middle to its rim, radians.
    pub radius_rad: f64,
    /// Standard deviation of the direction, radians.
    pub deviation_rad: f64,
    /// Apparent side of the smallest marker that is to be decoded, seen frontally, radians.
    pub marker_rad: f64,
}

impl PredictedNeighbour {
    /// What a predicted pose of `body`'s markers says of the view to take.
    ///
    /// `position_covariance` (m^2) and `velocity_in_camera` (m/s) are those of the markers' origin
    /// in the camera frame, the velocity as the camera sees it. `None` for a pose that is not a number or has the camera inside it.
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
        // Only what moves the body across the line of sight moves it in the view.
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
        })
    }
}

/// How regions of interest are sized and how they share a frame with the partitions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RoiOptions {
    /// The sphere image's own resolution, pixels for each radian.
    pub pixels_per_radian: f64,
    /// Side that the smallest marker to be decoded gets in the view, pixels.
    pub marker_px: f64,
    /// Side that it gets at least, however uncertain its direction, pixels: below, nothing decodes.
    pub marker_least_px: f64,
    /// Largest magnification over the sphere's own resolution.
    pub magnification_max: f64,
    /// Smallest angle that a view's sides span, radians.
    pub field_min_rad: f64,
    /// Largest angle that a view's sides span, radians.
    pub field_max_rad: f64,
    /// Standard deviations of the direction that are added to either side of the body.
    pub margin_deviations: f64,
    /// Pixels along the side of the largest view.
    pub size_max_px: u32,
    /// Neighbours' views that come before the first partition: see [`super::Planner::plan`].
    pub views_before_partition: usize,
    /// Partitions that a lossless run searches in each frame beside the neighbours' views.
    pub partitions_per_frame: usize,
}

impl RoiOptions {
    /// The defaults for a sphere image of this resolution (pixels for each radian).
    pub fn new(pixels_per_radian: f64) -> Self {
        Self {
            pixels_per_radian,
            marker_px: 80.0,
            marker_least_px: 24.0,
            magnification_max: 3.0,
            field_min_rad: 4f64.to_radians(),
            field_max_rad: 70f64.to_radians(),
            margin_deviations: 3.0,
            size_max_px: 640,
            views_before_partition: 4,
            partitions_per_frame: 2,
        }
    }

    pub(super) fn check(&self) -> Result<(), PlannerError> {
        let within = |name, value: f64, least: f64, most: f64, cure| {
            if (least..=most).contains(&value) {
                Ok(())
            } else {
                Err(PlannerError::Roi { name, value, cure })
            }
        };
        let (least, most) = (self.field_min_rad, self.field_max_rad);
        within("pixels_per_radian", self.pixels_per_radian, 1.0, 1e5, "1 to 100000 are allowed")?;
        within("marker_px", self.marker_px, 4.0, 1e3, "4 to 1000 are allowed")?;
        within(
            "marker_least_px",
            self.marker_least_px,
            1.0,
            self.marker_px,
            "it lies between 1 and marker_px",
        )?;
        within("magnification_max", self.magnification_max, 1.0, 16.0, "1 to 16 are allowed")?;
        within("field_min_rad", least, 0.01, 2.4, "0.01 to 2.4 are allowed")?;
        within("field_max_rad", most, least, 2.4, "it lies between field_min_rad and 2.4")?;
        within("margin_deviations", self.margin_deviations, 0.0, 10.0, "0 to 10 are allowed")?;
        within("size_max_px", f64::from(self.size_max_px), 32.0, 4096.0, "32 to 4096 are allowed")?;
        within(
            "partitions_per_frame",
            self.partitions_per_frame as f64,
            1.0,
            256.0,
            "at least 1, or a newcomer is never found",
        )
    }
}

/// The view for one neighbour: centred on its direction, its field the body's angular diameter and
/// the margins for uncertainty.
///
/// It is magnified until the smallest marker gets [`RoiOptions::marker_px`], but not beyond
/// [`RoiOptions::magnification_max`], and not beyond what lets the field fit the largest view, as
/// long as markers get [`RoiOptions::marker_least_px`] and the sphere's own resolution: of a wide
/// field in which nothing decodes nobody has anything, so it is cut instead, round where the neighbour
/// is most likely. A view of a close neighbour, whose markers are large enough anyway, is taken at
/// less than the sphere's resolution.
///
/// `None` for a prediction that is not a number.
pub fn roi_view(neighbour: &PredictedNeighbour, options: &RoiOptions) -> Option<PlannedView> {
    let wanted_rad =
        2.0 * (neighbour.radius_rad + options.margin_deviations * neighbour.deviation_rad);
    let finite = wanted_rad.is_finite()
        && neighbour.marker_rad > 0.0
        && neighbour.direction_in_camera.iter().all(|x| x.is_finite())
        && neighbour.rate_in_camera.iter().all(|x| x.is_finite());
    if !finite {
        return None;
    }
    let field_rad = wanted_rad.clamp(options.field_min_rad, options.field_max_rad);
    // Pixels across the view for each pixel of focal length.
    let span = 2.0 * (field_rad / 2.0).tan();
    let own = options.pixels_per_radian;
    let most = own * options.magnification_max;
    let wanted_at = options.marker_px / neighbour.marker_rad;
    let least = (options.marker_least_px / neighbour.marker_rad).clamp(own, most).min(wanted_at);
    let fits_at = f64::from(options.size_max_px) / span;
    let focal_px = wanted_at.clamp(own, most).min(fits_at).max(least);
    // f64 to u32 saturates, so an absurd option cannot wrap round.
    let size_px = ((focal_px * span).ceil() as u32).clamp(1, options.size_max_px);
    let upright = View::looking_at(&neighbour.direction_in_camera, field_rad, size_px);
    Some(PlannedView {
        view: View { focal_px, ..upright },
        purpose: Purpose::Roi(neighbour.target),
        search: Search::AllWindows,
        rate_in_camera: neighbour.rate_in_camera,
    })
}
