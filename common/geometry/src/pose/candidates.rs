//! Pose hypotheses, their score on all rays, and the choice of the best.

use nalgebra::{Isometry3, Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

use super::rays::{CornerRay, SightedMarker, sighted};
use super::refine::{refine_sighted, rough_cost};
use super::{PoseError, PoseSolution, ippe};
use crate::body::Body;

/// Most hypotheses to refine.
const REFINED_MAX: usize = 6;

/// Solutions nearer to each other than this count as one: radians, and share of the range.
const DISTINCT: f64 = 0.02;

/// Every distinct pose of `body` that explains its rays in one frame, cheapest first: usually one,
/// or two where the rays leave a mirror image open.
///
/// Rays of markers that the body does not have, rays that are not finite, and corners seen twice
/// are left out here. For a marker seen at two places, the place that fits the other markers
/// counts. With three or more markers, up to 30 % of them may be misread, or 30 % of all corners be
/// wrong. The same rays always give the same solutions.
///
/// # Errors
/// Too few rays, no whole marker, or nothing that fits: [`PoseError`].
pub fn solve(body: &Body, rays: &[CornerRay]) -> Result<Vec<PoseSolution>, PoseError> {
    let markers = sighted(body, rays);
    let usable = markers.iter().map(|marker| marker.sights.len()).sum();
    if usable < 4 {
        return Err(PoseError::TooFewRays { usable, given: rays.len() });
    }
    if markers.iter().all(|marker| marker.sights.len() < 4) {
        return Err(PoseError::NoWholeMarker { markers: markers.len() });
    }
    let mut solutions: Vec<PoseSolution> = Vec::new();
    refine_best(&mut solutions, &markers, whole_marker_poses);
    // If rays are left over, some rays are wrong, possibly one in each whole marker.
    if cheapest(&solutions).is_none_or(|best| best.inlier_corners < usable) {
        refine_best(&mut solutions, &markers, three_corner_poses);
    }
    // The mirror image of all markers of the best solution together, which no single marker may
    // show.
    if let Some(mirrored) = cheapest(&solutions).and_then(|best| mirror(&markers, best)) {
        keep_if_distinct(&mut solutions, refine_sighted(&markers, &mirrored));
    }
    solutions.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    // A solution with less than half of the best one's rays started from a misread marker.
    let needed = solutions.first().map_or(0, |best| best.inlier_corners.div_ceil(2));
    solutions.retain(|solution| solution.inlier_corners >= needed);
    if solutions.is_empty() {
        return Err(PoseError::NothingFits { markers: markers.len() });
    }
    Ok(solutions)
}

/// Refines the hypotheses that fit all rays best, and keeps the new ones.
fn refine_best(
    solutions: &mut Vec<PoseSolution>,
    markers: &[SightedMarker<'_>],
    poses: fn(&SightedMarker<'_>) -> Vec<Isometry3<f64>>,
) {
    let mut hypotheses: Vec<(f64, Isometry3<f64>)> =
        markers.iter().flat_map(poses).map(|pose| (rough_cost(markers, &pose), pose)).collect();
    // The sort is stable: equal hypotheses stay in the order of their markers.
    hypotheses.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut refined = 0;
    for (_, start) in &hypotheses {
        if refined >= REFINED_MAX {
            break;
        }
        // A hypothesis at an existing solution would converge to it.
        let is_known =
            |known: &PoseSolution| is_near(&known.camera_from_markers, start, 2.0 * DISTINCT);
        if solutions.iter().any(is_known) {
            continue;
        }
        refined += 1;
        keep_if_distinct(solutions, refine_sighted(markers, start));
    }
}

/// `camera_from_markers` of both mirror solutions of a marker seen whole.
fn whole_marker_poses(sighted: &SightedMarker<'_>) -> Vec<Isometry3<f64>> {
    let [a, b, c, d] = sighted.sights.as_slice() else { return Vec::new() };
    poses_of(sighted, &[a.ray, b.ray, c.ray, d.ray])
}

/// Poses from three corners: each corner in turn is replaced by the point at which the other three
/// complete a parallelogram.
fn three_corner_poses(sighted: &SightedMarker<'_>) -> Vec<Isometry3<f64>> {
    let [a, b, c, d] = sighted.sights.as_slice() else { return Vec::new() };
    let rays = [a.ray, b.ray, c.ray, d.ray];
    let completed = |k: usize| {
        let mut completed = rays;
        completed[k] = (rays[(k + 1) % 4] + rays[(k + 3) % 4] - rays[(k + 2) % 4]).normalize();
        poses_of(sighted, &completed)
    };
    (0..4).flat_map(completed).collect()
}

fn poses_of(sighted: &SightedMarker<'_>, rays: &[Vector3<f64>; 4]) -> Vec<Isometry3<f64>> {
    let Some(poses) = ippe::poses_of_square(sighted.marker.side(), rays) else { return Vec::new() };
    let marker_from_markers = sighted.marker.markers_from_marker().inverse();
    poses.iter().map(|camera_from_marker| camera_from_marker * marker_from_markers).collect()
}

fn cheapest(solutions: &[PoseSolution]) -> Option<&PoseSolution> {
    solutions.iter().min_by(|a, b| a.cost.total_cmp(&b.cost))
}

fn keep_if_distinct(solutions: &mut Vec<PoseSolution>, found: Option<PoseSolution>) {
    let Some(found) = found else { return };
    let near = solutions
        .iter_mut()
        .find(|known| is_near(&known.camera_from_markers, &found.camera_from_markers, DISTINCT));
    match near {
        Some(known) if found.cost < known.cost => *known = found,
        Some(_) => {}
        None => solutions.push(found),
    }
}

fn is_near(a: &Isometry3<f64>, b: &Isometry3<f64>, limit: f64) -> bool {
    let range = a.translation.vector.norm().max(b.translation.vector.norm());
    a.rotation.angle_to(&b.rotation) < limit
        && (a.translation.vector - b.translation.vector).norm() < limit * range
}

/// The mirror image of the solution's inliers, flattened onto their common plane.
fn mirror(markers: &[SightedMarker<'_>], solution: &PoseSolution) -> Option<Isometry3<f64>> {
    let points: Vec<Vector3<f64>> = markers
        .iter()
        .filter(|marker| solution.inlier_markers.contains(&marker.marker.id))
        .flat_map(|marker| marker.sights.iter().map(|sight| sight.corner.coords))
        .collect();
    let middle = points.iter().sum::<Vector3<f64>>() / points.len().max(1) as f64;
    let spread: Matrix3<f64> =
        points.iter().map(|point| (point - middle) * (point - middle).transpose()).sum();
    let axes = spread.symmetric_eigen();
    let flattest = axes.eigenvectors.column(axes.eigenvalues.imin()).into_owned();
    mirror_image(&solution.camera_from_markers, &Point3::from(middle), &flattest)
}

/// The other pose in which a flat body looks the same from afar (the ambiguity of weak
/// perspective): `R' = M_v R M_n`. M_v is the reflection at the plane across the line of sight v to
/// its `middle`, M_n that at the plane across its unit `normal` n. Both arguments are in the
/// markers' frame. The direction of the middle stays. `None` where the middle is at the camera.
pub fn mirror_image(
    camera_from_markers: &Isometry3<f64>,
    middle: &Point3<f64>,
    normal: &Vector3<f64>,
) -> Option<Isometry3<f64>> {
    let seen = (camera_from_markers * middle).coords;
    let sight = seen.try_normalize(1e-9)?;
    let reflect = |axis: &Vector3<f64>| Matrix3::identity() - axis * axis.transpose() * 2.0;
    let rotation = camera_from_markers.rotation.to_rotation_matrix().into_inner();
    let rotation = Rotation3::from_matrix_unchecked(reflect(&sight) * rotation * reflect(normal));
    let rotation = UnitQuaternion::from_rotation_matrix(&rotation);
    Some(Isometry3::from_parts(Translation3::from(seen - rotation * middle.coords), rotation))
}
