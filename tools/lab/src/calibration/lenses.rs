//! The relative pose of a camera's two lenses, from frames in which a body spans the seam between
//! them.
//!
//! In such a frame each lens sees some markers of a body. The body is rigid, so both lenses must
//! see it at one pose. [`calibrate`] adjusts the body's pose in every frame together with the
//! model's unknowns. For a stitched image this is the distance between the lenses. For two fisheyes
//! it is the pose of the second lens relative to the first. Nothing is assumed about the motion of
//! the body or the camera.
//!
//! A shift and a turn of the second lens have the same effect on a body at one place of the seam.
//! Bodies at several places round the seam, or at several distances, distinguish the two.

mod adjust;

use nalgebra::{Isometry3, Matrix6, Vector3, Vector6};

use super::CalibrationError;
use super::descent::Adjust;
use super::leverage::worst_error_m;
use super::weighted_ray::{WeightedRay, difference};
use adjust::{Adjustment, LensSighting, SeamFrame};
use flockeye_geometry::body::Body;
use flockeye_geometry::camera::{Camera, CameraModel, LensRay};
use flockeye_geometry::pose::{CornerRay, keep_sharpest, solve};
use flockeye_geometry::statistics::median;

/// Fewest frames in which a body spans the seam.
const LEAST_FRAMES: usize = 12;
/// Corners nearer to the seam than this are not used, radians: their edges contain pixels of the
/// other lens.
const SEAM_MARGIN_RAD: f64 = 0.01;
/// Largest angle between a ray of the other lens and the body's corner, radians. Beyond, it is
/// another object.
const FARTHEST_RAD: f64 = 0.15;
/// Largest angle between two poses that count as the same, radians.
const SAME_TURN_RAD: f64 = 0.3;
/// A pose is clear if every other one has an error in the other lens that is larger by this factor.
const CLEARLY: f64 = 2.0;
/// Largest standard deviations of a valid result: metres, and radians.
const WORST_SHIFT_M: f64 = 0.005;
const WORST_TURN_RAD: f64 = 0.009;

/// The calibrated unknowns of the camera model.
#[derive(Debug, Clone, Copy, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "there is one for each calibration")]
pub(crate) enum FoundLenses {
    /// The distance between the two lenses of a stitched image.
    Distance {
        /// The distance, metres.
        lens_distance_m: f64,
        /// Standard deviation of the distance, metres.
        deviation_m: f64,
    },
    /// The pose of the second fisheye lens, with the first one as configured.
    Second {
        /// The lens' pose in the camera frame.
        camera_from_lens: Isometry3<f64>,
        /// Covariance of the pose: position (m), then rotation vector (rad), both in the camera's
        /// axes.
        covariance: Matrix6<f64>,
    },
}

/// The result for the lenses.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct LensCalibration {
    /// The calibrated unknowns. Their deviations are enlarged if rays scatter more than stated.
    pub found: FoundLenses,
    /// Change from the configured lenses: shift (m), then rotation vector (rad) of the second lens
    /// relative to the first, in the camera's axes.
    pub change: Vector6<f64>,
    /// Number of frames that were used. A frame with two bodies across the seam counts twice.
    pub frames: usize,
    /// Number of frames that fit no pose and were left out.
    pub left_out: usize,
    /// Numbers of frames by the body's place on the seam: ahead, back, left, right, above, below.
    pub sides: [usize; 6],
    /// Remaining errors of the rays, in stated standard deviations: 1 if these and the model are
    /// right.
    pub scatter: f64,
    /// Scatter with the lenses as configured.
    pub scatter_before: f64,
    /// Covariance of `change`.
    covariance: Matrix6<f64>,
    /// Direction of the second lens' optical axis, in the camera's axes.
    second_axis: Vector3<f64>,
    /// Share of the change that moves one lens relative to the camera's middle: 1/2 if both lenses
    /// move.
    share: f64,
}

impl LensCalibration {
    /// Position error of a neighbour at this distance in the second lens, in the worst direction,
    /// due to the covariance. It is the root of the expected squared error, metres.
    pub(crate) fn error_at_m(&self, distance_m: f64) -> f64 {
        self.share * self.worst(&self.covariance, distance_m / self.share)
    }

    /// Position error of such a neighbour with the lenses as configured, metres.
    pub(crate) fn configured_error_at_m(&self, distance_m: f64) -> f64 {
        let squared = self.change * self.change.transpose();
        self.share * self.worst(&squared, distance_m / self.share)
    }

    fn worst(&self, covariance: &Matrix6<f64>, distance_m: f64) -> f64 {
        worst_error_m(covariance, distance_m, |direction| direction.dot(&self.second_axis) >= 0.0)
    }
}

/// Finds the relative pose of the lenses of `camera` from the rays of many frames. Rays are valid
/// for the distance for which `camera` is valid.
///
/// Skipped are frames in which no body spans the seam, frames with an ambiguous pose, and markers
/// across or next to the seam.
pub(crate) fn calibrate(
    camera: &Camera,
    bodies: &[Body],
    frames: &[Vec<CornerRay>],
) -> Result<LensCalibration, CalibrationError> {
    let positions = camera.lens_positions().ok_or(CalibrationError::OneCentre)?;
    let of_bodies = |rays: &Vec<CornerRay>| -> Vec<SeamFrame> {
        bodies.iter().filter_map(|body| seam_frame(camera, &positions, body, rays)).collect()
    };
    let spanned: Vec<SeamFrame> = frames.iter().flat_map(of_bodies).collect();
    if spanned.len() < LEAST_FRAMES {
        let (frames, needed) = (spanned.len(), LEAST_FRAMES);
        return Err(CalibrationError::SeamSeldomSpanned { frames, needed });
    }
    let mut adjustment = match camera.model() {
        CameraModel::DualFisheye(_) => Adjustment::of_second_lens(positions, spanned),
        CameraModel::Equirectangular { .. } | CameraModel::Stereographic { .. } => {
            Adjustment::of_distance(positions, spanned)
        }
    };
    let scatter_before = adjustment.scatter_as_configured();
    adjustment.adjust();
    let left_out = adjustment.leave_out_misfits();
    if left_out > 0 {
        adjustment.adjust();
    }
    let (covariance, scatter) = adjustment.covariance().ok_or(undetermined(f64::INFINITY, 0.0))?;
    let [shift_m, turn_rad] = [0, 3].map(|from| {
        let block = covariance.fixed_view::<3, 3>(from, from).into_owned();
        block.symmetric_eigenvalues().max().max(0.0).sqrt()
    });
    if shift_m > WORST_SHIFT_M || turn_rad > WORST_TURN_RAD {
        return Err(undetermined(shift_m, turn_rad));
    }
    let apart = adjustment.positions[1] - positions[1] - (adjustment.positions[0] - positions[0]);
    let turn = adjustment.second_turn;
    let found = match camera.model() {
        CameraModel::DualFisheye([_, second]) => FoundLenses::Second {
            camera_from_lens: Isometry3::from_parts(
                adjustment.positions[1].into(),
                turn * second.camera_from_lens.rotation,
            ),
            covariance,
        },
        CameraModel::Equirectangular { .. } | CameraModel::Stereographic { .. } => {
            FoundLenses::Distance {
                lens_distance_m: (adjustment.positions[0] - adjustment.positions[1]).x,
                deviation_m: covariance[(0, 0)].sqrt(),
            }
        }
    };
    let (second_axis, share) = match &found {
        FoundLenses::Second { camera_from_lens, .. } => {
            (camera_from_lens.rotation * Vector3::z(), 1.0)
        }
        FoundLenses::Distance { .. } => (-Vector3::x(), 0.5),
    };
    let change = difference(&Isometry3::identity(), &Isometry3::from_parts(apart.into(), turn));
    Ok(LensCalibration {
        found,
        change,
        frames: adjustment.frames.len(),
        left_out,
        sides: sides(&adjustment.frames),
        scatter,
        scatter_before,
        covariance,
        second_axis,
        share,
    })
}

fn undetermined(shift_m: f64, turn_rad: f64) -> CalibrationError {
    let (what, deviation, unit) = match turn_rad / WORST_TURN_RAD > shift_m / WORST_SHIFT_M {
        true => ("the second lens' turn", turn_rad.to_degrees(), "degrees"),
        false => ("the second lens' place", shift_m * 1e3, "mm"),
    };
    CalibrationError::LensesUndetermined { what, deviation, unit }
}

/// Numbers of frames by the body's place on the seam: ahead, back, left, right, above, below.
fn sides(frames: &[SeamFrame]) -> [usize; 6] {
    let mut sides = [0; 6];
    for frame in frames {
        let position = frame.camera_from_markers.translation.vector;
        let axis = position.iamax();
        sides[2 * axis + usize::from(position[axis] < 0.0)] += 1;
    }
    sides
}

/// A body's pose in a frame, by the lens that sees more of it, and its sightings in each lens.
/// `None` if only one lens sees it, or if the pose is ambiguous.
fn seam_frame(
    camera: &Camera,
    positions: &[Vector3<f64>; 2],
    body: &Body,
    rays: &[CornerRay],
) -> Option<SeamFrame> {
    let own: Vec<CornerRay> =
        rays.iter().filter(|ray| body.marker(ray.marker_id).is_some()).copied().collect();
    let own = keep_sharpest(&own);
    let mut by_lens: [Vec<CornerRay>; 2] = [Vec::new(), Vec::new()];
    for marker in markers(&own) {
        let Some((lens, seen)) = by_one_lens(camera, marker) else { continue };
        by_lens[lens].extend(seen);
    }
    if by_lens.iter().any(Vec::is_empty) {
        return None;
    }
    let first = usize::from(by_lens[1].len() > by_lens[0].len());
    let solutions = solve(body, &by_lens[first]).ok()?;
    let least = solutions.first()?.cost;
    let candidates: Vec<PoseCandidate<'_>> = solutions
        .iter()
        // Poses that do not fit the first lens are no candidates.
        .take_while(|solution| solution.cost < 1.5 * least + 20.0)
        .map(|solution| {
            let mut camera_from_markers = solution.camera_from_markers;
            camera_from_markers.translation.vector += positions[first];
            let mut angles: Vec<f64> = markers(&by_lens[1 - first])
                .filter_map(|marker| {
                    angles(body, &camera_from_markers, &positions[1 - first], marker)
                })
                .flatten()
                .collect();
            angles.sort_by(f64::total_cmp);
            PoseCandidate {
                camera_from_markers,
                inliers: &solution.inlier_markers,
                near: angles.len(),
                off_rad: median(&angles).unwrap_or(f64::INFINITY),
            }
        })
        .collect();
    let best = clearly_nearest(&candidates)?;
    let sighting = |lens: usize, marker: &[CornerRay]| {
        let rays = <&[CornerRay; 4]>::try_from(marker).ok()?;
        let corners = body.marker(rays[0].marker_id)?.corners;
        let is_the_bodys = match lens == first {
            true => best.inliers.contains(&rays[0].marker_id),
            false => angles(body, &best.camera_from_markers, &positions[lens], marker).is_some(),
        };
        let rays = rays.each_ref().map(WeightedRay::new);
        is_the_bodys.then_some(LensSighting { lens, corners, rays })
    };
    let of_lens =
        |lens: usize| markers(&by_lens[lens]).filter_map(move |marker| sighting(lens, marker));
    let sightings: Vec<LensSighting> = of_lens(0).chain(of_lens(1)).collect();
    let is_seen = |lens: usize| sightings.iter().any(|seen| seen.lens == lens);
    let camera_from_markers = best.camera_from_markers;
    (is_seen(0) && is_seen(1)).then_some(SeamFrame { camera_from_markers, sightings })
}

/// The rays, grouped by marker.
fn markers(rays: &[CornerRay]) -> impl Iterator<Item = &[CornerRay]> {
    rays.chunk_by(|a, b| a.marker_id == b.marker_id)
}

/// A pose by one lens, with its errors in the other lens.
struct PoseCandidate<'a> {
    camera_from_markers: Isometry3<f64>,
    inliers: &'a [u32],
    /// Number of the other lens' corners near their expected directions, and the median of their
    /// angles, radians.
    near: usize,
    off_rad: f64,
}

/// The candidate that explains most corners of the other lens. `None` if there is none, or if a
/// candidate with another rotation is nearly as good. A few markers in one plane have a mirrored
/// pose.
fn clearly_nearest<'a, 'b>(candidates: &'a [PoseCandidate<'b>]) -> Option<&'a PoseCandidate<'b>> {
    let rank = |a: &&PoseCandidate<'_>, b: &&PoseCandidate<'_>| {
        b.near.cmp(&a.near).then(a.off_rad.total_cmp(&b.off_rad))
    };
    let best = candidates.iter().filter(|candidate| candidate.near > 0).min_by(rank)?;
    let rivals = candidates.iter().any(|other| {
        let rotations = [best, other].map(|candidate| candidate.camera_from_markers.rotation);
        rotations[0].angle_to(&rotations[1]) > SAME_TURN_RAD
            && other.near >= best.near
            && other.off_rad < CLEARLY * best.off_rad
    });
    (!rivals).then_some(best)
}

/// Angles between the rays of a marker and its corners at a pose, seen from a lens. `None` if one
/// of them exceeds [`FARTHEST_RAD`].
fn angles(
    body: &Body,
    camera_from_markers: &Isometry3<f64>,
    lens: &Vector3<f64>,
    marker: &[CornerRay],
) -> Option<Vec<f64>> {
    let angle = |ray: &CornerRay| {
        let corner = body.marker(ray.marker_id)?.corners[ray.corner];
        let angle = ray.ray_in_camera.angle(&((camera_from_markers * corner).coords - lens));
        (angle < FARTHEST_RAD).then_some(angle)
    };
    marker.iter().map(angle).collect()
}

/// The lens that sees the whole marker, and the four rays from that lens in the camera's axes.
/// `None` for a marker across the seam or next to it.
fn by_one_lens(camera: &Camera, marker: &[CornerRay]) -> Option<(usize, Vec<CornerRay>)> {
    let seen: Option<Vec<LensRay>> =
        marker.iter().map(|ray| camera.lens_ray(&ray.ray_in_camera)).collect();
    let seen = seen.filter(|seen| seen.len() == 4)?;
    let lens = seen[0].lens;
    let is_clear = |ray: &LensRay| ray.lens == lens && ray.from_seam_rad > SEAM_MARGIN_RAD;
    let rays = marker.iter().zip(&seen);
    let rays = rays.map(|(ray, seen)| CornerRay { ray_in_camera: seen.ray, ..*ray });
    seen.iter().all(is_clear).then(|| (lens, rays.collect()))
}

#[cfg(test)]
mod tests;
