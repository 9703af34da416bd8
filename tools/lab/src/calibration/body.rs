//! A body as it was really glued: its markers' poses from frames in which several are seen.
//!
//! Printed and glued markers are off by a millimetre and a degree, which no pose can be better
//! than. [`calibrate`] refines every marker's pose on the body, together with the body's pose in
//! every frame, on all corner rays at once (bundle adjustment: Triggs, McLauchlan, Hartley,
//! Fitzgibbon, "Bundle Adjustment: A Modern Synthesis", 2000):
//! - unknown are `camera_from_markers` of each frame and `markers_from_marker` of each marker; the
//!   markers' printed size is known, and gives the scale;
//! - Levenberg-Marquardt over the angular errors, with Cauchy's robust cost, whose scale follows the
//!   errors' own spread; frames are eliminated (Schur's complement), so that what is solved is as
//!   large as the body is;
//! - the body as a whole is free to turn and shift: what is kept is the least squares of its corners
//!   against the designed ones.

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

/// A marker as it was found.
#[derive(Debug, Clone, PartialEq)]
pub struct CalibratedMarker {
    /// The marker where it is, as large as it was printed.
    pub marker: Marker,
    /// From the designed centre to the found one, in the markers' frame, metres.
    pub shift_m: Vector3<f64>,
    /// The rotation vector from the designed orientation to the found one, in the markers' frame.
    pub turn_rad: Vector3<f64>,
    /// Covariance of both, shift first, from the normal matrix; enlarged where the rays scatter
    /// more than they state.
    pub covariance: Matrix6<f64>,
    /// Frames that it was found in.
    pub frames: usize,
}

impl CalibratedMarker {
    /// Standard deviation of its place: the root of the expected squared distance, metres.
    pub fn shift_deviation_m(&self) -> f64 {
        position_deviation_m(&self.covariance)
    }

    /// Standard deviation of its orientation: the root of the expected squared angle, radians.
    pub fn turn_deviation_rad(&self) -> f64 {
        rotation_deviation_rad(&self.covariance)
    }
}

/// A body as it was found.
#[derive(Debug, Clone, PartialEq)]
pub struct BodyCalibration {
    /// The body with its markers where they are; those that were seen too seldom, as designed.
    pub body: Body,
    /// The markers that were found, by rising id.
    pub markers: Vec<CalibratedMarker>,
    /// Ids and numbers of frames of those seen too seldom, by rising id.
    pub left: Vec<(u32, usize)>,
    /// Frames that counted.
    pub frames: usize,
    /// Errors of the rays that remain, in their stated standard deviations: 1 if these are right.
    pub scatter: f64,
}

/// Finds the markers of `body` from the rays of many frames, each with the corners that were seen
/// in it (of this body or not, each corner as often as it was seen).
///
/// Frames whose pose is ambiguous do not count, nor do markers that do not fit a frame's pose.
pub fn calibrate(
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

/// What a frame says: the body's pose, and the rays of the markers that fit it. `None` where that
/// is fewer than two, or where another pose explains them nearly as well.
fn frame(body: &Body, rays: &[CornerRay]) -> Option<BodyFrame> {
    let rays = keep_sharpest(rays);
    let solutions = solve(body, &rays).ok()?;
    let (best, others) = solutions.split_first()?;
    // Where facets are off, no pose fits; a mirrored one is worse by much more.
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

/// Drops the markers that are seen too seldom, and the frames that are left with one, until nothing
/// changes. Gives for each marker of the body the frames it is seen in.
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
    // Spread from the first marker over all that are seen together.
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
    // Dropped markers keep the number that was too small.
    let kept = counts.iter().zip(&at_first);
    let seldom = LEAST_SIGHTINGS - 1;
    Ok(kept.map(|(&now, &before)| if now > 0 { now } else { before.min(seldom) }).collect())
}

#[cfg(test)]
mod tests;
