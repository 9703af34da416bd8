//! Calibration of a body: the real poses of its markers, from frames in which several are seen.
//!
//! Printed and glued markers have errors of a millimetre and a degree, which limit the accuracy of
//! every pose. [`calibrate`] refines every marker's pose on the body, together with the body's pose
//! in every frame. It uses all corner rays at once (bundle adjustment: Triggs, McLauchlan, Hartley,
//! Fitzgibbon, "Bundle Adjustment: A Modern Synthesis", 2000):
//! - Unknowns are `camera_from_markers` of each frame and `markers_from_marker` of each marker. The
//!   markers' printed size is known and gives the scale.
//! - The solver is Levenberg-Marquardt over the angular errors with Cauchy's robust cost. The scale
//!   of the cost follows the spread of the errors. Frames are eliminated (Schur's complement), so
//!   the size of the system is that of the body.
//! - Rays do not determine the pose of the body as a whole. It is the least-squares fit of the
//!   corners to the designed ones.

use nalgebra::{Isometry3, Matrix6, Vector3};

use flockeye_geometry::body::{Body, Marker};
use flockeye_geometry::pose::{
    CornerRay, keep_sharpest, position_deviation_m, rotation_deviation_rad, solve,
};

use super::CalibrationError;
use super::adjust::{Bundle, MarkerSighting};
use super::descent::{Adjust, BundleFrame};
use super::weighted_ray::WeightedRay;

/// Fewest frames with two markers or more.
const LEAST_FRAMES: usize = 30;
/// Fewest frames in which a marker is seen beside another one. Markers with fewer stay as designed.
const LEAST_SIGHTINGS: usize = 10;

type BodyFrame = BundleFrame<MarkerSighting>;

/// The calibrated pose of a marker.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct CalibratedMarker {
    /// The marker at its calibrated pose, in its printed size.
    pub marker: Marker,
    /// Shift from the designed centre to the calibrated one, in the markers' frame, metres.
    pub shift_m: Vector3<f64>,
    /// Rotation vector from the designed orientation to the calibrated one, in the markers' frame.
    pub turn_rad: Vector3<f64>,
    /// Covariance of shift, then turn, from the normal matrix. It is enlarged if the rays scatter
    /// more than stated.
    pub covariance: Matrix6<f64>,
    /// Number of frames in which the marker was seen.
    pub frames: usize,
}

impl CalibratedMarker {
    /// Standard deviation of the position: the root of the expected squared distance, metres.
    pub(crate) fn shift_deviation_m(&self) -> f64 {
        position_deviation_m(&self.covariance)
    }

    /// Standard deviation of the orientation: the root of the expected squared angle, radians.
    pub(crate) fn turn_deviation_rad(&self) -> f64 {
        rotation_deviation_rad(&self.covariance)
    }
}

/// The result for a body.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct BodyCalibration {
    /// The body with its calibrated markers. Markers that were seen too seldom stay as designed.
    pub body: Body,
    /// The calibrated markers, by rising id.
    pub markers: Vec<CalibratedMarker>,
    /// Ids and frame counts of markers that were seen too seldom, by rising id.
    pub left: Vec<(u32, usize)>,
    /// Number of frames that were used.
    pub frames: usize,
    /// Remaining errors of the rays, in stated standard deviations: 1 if these are right.
    pub scatter: f64,
}

/// Calibrates the markers of `body` from the rays of many frames. A frame contains all corners that
/// were seen in it, also of other bodies, and each corner as often as it was seen.
///
/// Frames with an ambiguous pose are skipped, and so are markers that do not fit a frame's pose.
pub(crate) fn calibrate(
    body: &Body,
    frames: &[Vec<CornerRay>],
) -> Result<BodyCalibration, CalibrationError> {
    let mut seen: Vec<BodyFrame> = frames.iter().filter_map(|rays| frame(body, rays)).collect();
    let sightings = keep_connected(body, &mut seen)?;
    let designed: Vec<Isometry3<f64>> =
        body.markers.iter().map(Marker::markers_from_marker).collect();
    let found: Vec<usize> =
        (0..sightings.len()).filter(|&k| sightings[k] >= LEAST_SIGHTINGS).collect();
    let mut bundle = Bundle::new(body, &found, seen);
    bundle.adjust();
    bundle.align();
    let undetermined = || CalibrationError::BodyUndetermined { body: body.name.clone() };
    let (covariances, scatter) = bundle.covariances().ok_or_else(undetermined)?;
    let markers: Vec<CalibratedMarker> = found
        .iter()
        .zip(covariances)
        .enumerate()
        .map(|(index, (&k, covariance))| {
            let pose = &bundle.markers_from_marker[index];
            CalibratedMarker {
                marker: Marker { id: body.markers[k].id, corners: bundle.corners(index) },
                shift_m: pose.translation.vector - designed[k].translation.vector,
                turn_rad: (pose.rotation * designed[k].rotation.inverse()).scaled_axis(),
                covariance,
                frames: sightings[k],
            }
        })
        .collect();
    let left = (0..sightings.len()).filter(|k| !found.contains(k));
    let left = left.map(|k| (body.markers[k].id, sightings[k])).collect();
    let mut all = body.markers.clone();
    for (&k, calibrated) in found.iter().zip(&markers) {
        all[k] = calibrated.marker.clone();
    }
    let body = body.with_markers(all).ok_or_else(undetermined)?;
    Ok(BodyCalibration { body, markers, left, frames: bundle.frames.len(), scatter })
}

/// The body's pose in a frame, and the rays of the markers that fit it. `None` if fewer than two
/// markers fit, or if another pose fits nearly as well.
fn frame(body: &Body, rays: &[CornerRay]) -> Option<BodyFrame> {
    let rays = keep_sharpest(rays);
    let solutions = solve(body, &rays).ok()?;
    let (best, others) = solutions.split_first()?;
    // With misplaced facets no pose fits exactly. The mirrored pose must be much worse.
    if others.iter().any(|other| other.cost < 1.5 * best.cost + 20.0) {
        return None;
    }
    let sightings: Vec<MarkerSighting> = best
        .inlier_markers
        .iter()
        .filter_map(|&id| {
            let marker = body.markers.iter().position(|marker| marker.id == id)?;
            let own: Vec<CornerRay> =
                rays.iter().filter(|ray| ray.marker_id == id).copied().collect();
            let rays: [CornerRay; 4] = own.try_into().ok()?;
            Some(MarkerSighting { marker, rays: rays.each_ref().map(WeightedRay::new) })
        })
        .collect();
    let camera_from_markers = best.camera_from_markers;
    (sightings.len() >= 2).then_some(BodyFrame { camera_from_markers, sightings })
}

/// Drops markers that are seen too seldom and frames with fewer than two markers, until nothing
/// changes. Returns for each marker of the body the number of its frames.
fn keep_connected(
    body: &Body,
    frames: &mut Vec<BodyFrame>,
) -> Result<Vec<usize>, CalibrationError> {
    let count = |frames: &[BodyFrame]| {
        let mut counts = vec![0usize; body.markers.len()];
        frames.iter().flat_map(|f| &f.sightings).for_each(|seen| counts[seen.marker] += 1);
        counts
    };
    let at_first = count(frames);
    loop {
        let (counts, before) = (count(frames), frames.len());
        for frame in frames.iter_mut() {
            frame.sightings.retain(|seen| counts[seen.marker] >= LEAST_SIGHTINGS);
        }
        frames.retain(|frame| frame.sightings.len() >= 2);
        let is_stable = counts.iter().all(|&n| n == 0 || n >= LEAST_SIGHTINGS);
        if is_stable && frames.len() == before {
            break;
        }
    }
    let (needed, counts) = (LEAST_FRAMES, count(frames));
    if frames.len() < needed {
        let (body, frames) = (body.name.clone(), frames.len());
        return Err(CalibrationError::BodySeldomSeen { body, frames, needed });
    }
    // Marks all markers that are connected with the first one by common frames.
    let Some(first) = counts.iter().position(|&n| n > 0) else { return Ok(at_first) };
    let mut reached = vec![false; counts.len()];
    reached[first] = true;
    loop {
        let before = reached.iter().filter(|&&is| is).count();
        for frame in frames.iter() {
            if frame.sightings.iter().any(|seen| reached[seen.marker]) {
                frame.sightings.iter().for_each(|seen| reached[seen.marker] = true);
            }
        }
        if reached.iter().filter(|&&is| is).count() == before {
            break;
        }
    }
    let id = |k: usize| body.markers[k].id;
    let apart: Vec<u32> =
        (0..counts.len()).filter(|&k| counts[k] > 0 && !reached[k]).map(id).collect();
    if !apart.is_empty() {
        let (body, with, needed) = (body.name.clone(), id(first), LEAST_SIGHTINGS);
        return Err(CalibrationError::MarkersApart { body, apart, with, needed });
    }
    // Dropped markers keep their count, which was too small.
    let kept = counts.iter().zip(&at_first);
    let seldom = LEAST_SIGHTINGS - 1;
    Ok(kept.map(|(&now, &before)| if now > 0 { now } else { before.min(seldom) }).collect())
}

#[cfg(test)]
mod tests;
