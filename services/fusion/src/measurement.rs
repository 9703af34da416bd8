//! Measurements of one body in a frame: corners as rays, and a measured pose.

use flockeye_contract::{DetectedMarker, MeasuredBy};
use flockeye_geometry::Ray;
use flockeye_geometry::body::Body;
use flockeye_geometry::camera::ShownBy;
use flockeye_geometry::filter::RivalPose;
use flockeye_geometry::pose::{CornerRay, PoseEstimate};
use flockeye_geometry::view::{View, ViewPixel};
use flockeye_imaging::align::Alignment;
use nalgebra::{Matrix6, Unit, Vector2, Vector3};

use crate::decide;

/// A pose of a body, measured in one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseMeasurement {
    /// The pose.
    pub pose: PoseEstimate,
    /// Another pose that explains the frame almost as well.
    pub rival: Option<RivalPose>,
    /// Source of the measurement, never [`MeasuredBy::Nothing`].
    pub measured_by: MeasuredBy,
    /// Number of decoded markers of the body.
    pub markers: u32,
    /// Whether its pose is precise. If not, it only updates a track that it fits.
    pub is_precise: bool,
    /// Whether the picture alone proves the pose, by several facets. Then it may replace a stale
    /// track.
    pub is_proven: bool,
    /// What shows the body in the picture of a stitched camera.
    pub shown: Option<Shown>,
}

/// What shows a body in a stitched picture, and what all poses from there have in common.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shown {
    /// The half, or both.
    pub by: ShownBy,
    /// Covariance from what is not known of one half ([`Stitch::pose_covariance`]).
    ///
    /// [`Stitch::pose_covariance`]: flockeye_geometry::camera::Stitch::pose_covariance
    pub covariance: Matrix6<f64>,
}

impl Shown {
    /// Covariance of the jump of measured poses since one that was shown by `before`.
    pub(crate) fn jump_since(&self, before: ShownBy) -> Option<Matrix6<f64>> {
        match (before, self.by) {
            (before, now) if before == now => None,
            // The errors of the halves are opposite.
            (ShownBy::One(_), ShownBy::One(_)) => Some(self.covariance * 4.0),
            _ => Some(self.covariance),
        }
    }
}

impl PoseMeasurement {
    /// Whether the measurement is usable by itself. If not, it only updates a track, and no pose is
    /// published as measured.
    pub fn is_usable_alone(&self) -> bool {
        self.is_precise && self.rival.is_none()
    }

    /// An alignment's result, with this number of decoded markers.
    pub(crate) fn aligned(found: &Alignment, markers: u32) -> Self {
        Self {
            pose: found.pose(),
            rival: None,
            measured_by: MeasuredBy::Aligned,
            markers,
            is_precise: found.is_precise,
            is_proven: decide::is_proven(found),
            shown: None,
        }
    }
}

/// Corner rays of the decoded markers that `body` carries.
pub fn decoded_rays<'m>(
    body: &Body,
    markers: impl IntoIterator<Item = &'m DetectedMarker>,
) -> Vec<CornerRay> {
    let own = markers.into_iter().filter(|marker| body.marker(marker.id).is_some());
    own.flat_map(|marker| {
        (0..4).map(|corner| CornerRay {
            marker_id: marker.id,
            corner,
            ray_in_camera: ray(marker.rays_in_camera[corner]),
            deviation_rad: marker.deviations[corner],
        })
    })
    .collect()
}

/// The unit ray of a message's components.
pub(crate) fn ray(components: [f64; 3]) -> Ray {
    Unit::new_normalize(Vector3::from(components))
}

/// Ids of the markers of these corners, rising, each once.
pub(crate) fn marker_ids(rays: &[CornerRay]) -> Vec<u32> {
    let mut ids: Vec<u32> = rays.iter().map(|ray| ray.marker_id).collect();
    ids.sort_unstable();
    ids.dedup();
    ids
}

/// Largest difference of another stage's rays from ours by rounding, radians.
const RAY_TOLERANCE_RAD: f64 = 1e-3;

/// Whether a marker's rays match its corners in the searched view.
pub(crate) fn agrees_with_view(marker: &DetectedMarker, view: &View) -> bool {
    marker.corners_in_view.iter().zip(&marker.rays_in_camera).all(|(&[u, v], &stated)| {
        let seen = view.ray(ViewPixel(Vector2::new(f64::from(u), f64::from(v))));
        seen.angle(&ray(stated)) < RAY_TOLERANCE_RAD
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixtures::{alpha, bravo, facing_markers};
    use nalgebra::Isometry3;

    #[test]
    fn markers_of_other_bodies_are_left_out() {
        let (alpha, bravo) = (alpha(), bravo());
        let pose = Isometry3::translation(1.0, 0.0, 0.0);
        assert!(decoded_rays(&bravo, &facing_markers(&alpha, &pose, 8)).is_empty());
    }

    #[test]
    fn rays_that_disagree_with_their_corners_are_noticed() {
        let view = View::looking_at(&Vector3::x_axis(), 1.0, 201);
        let corners = [[90.0f32, 90.0], [110.0, 90.0], [110.0, 110.0], [90.0, 110.0]];
        let mut marker = DetectedMarker {
            corners_in_view: corners,
            rays_in_camera: corners.map(|[u, v]| {
                let ray = view.ray(ViewPixel::new(f64::from(u), f64::from(v)));
                [ray.x, ray.y, ray.z]
            }),
            ..DetectedMarker::default()
        };
        assert!(agrees_with_view(&marker, &view));
        marker.rays_in_camera.swap(0, 2);
        assert!(!agrees_with_view(&marker, &view));
    }
}
