//! What is true of a frame: where the bodies are, and how much of them can be seen.

use nalgebra::{Isometry3, Point3, Vector3};

use crate::drone::Drone;
use crate::own_airframe;
use crate::world::{Moment, Placement};

/// Points along each side of a marker's black square that are tried for visibility.
const GRID: u32 = 10;
/// Incidence below which a whole marker makes its body localisable, degrees.
const LOCALISABLE_DEG: f64 = 65.0;

/// The truth of one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameTruth {
    /// Number of the frame.
    pub frame: u64,
    /// Middle of its exposure, seconds since frame 0's.
    pub time_s: f64,
    /// Length of its exposure, seconds.
    pub exposure_s: f64,
    /// Sensitivity.
    pub iso: u32,
    /// The observer's own yaw in the world, radians, -pi to pi.
    pub observer_yaw: f64,
    /// Every body, by its index in the configuration.
    pub bodies: Vec<TargetTruth>,
}

/// The truth of one body in one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct TargetTruth {
    /// The body's name.
    pub name: String,
    /// Index of the body in the configuration.
    pub target: usize,
    /// Pose of the body's markers in the camera frame.
    pub camera_from_markers: Isometry3<f64>,
    /// Velocity as the turning camera sees it, in its frame, metres per second.
    pub velocity_in_camera: Vector3<f64>,
    /// Distance of the body's centre from the camera, metres.
    pub distance_m: f64,
    /// Azimuth of the centre in the camera frame, radians, to the left of ahead.
    pub azimuth: f64,
    /// Elevation of the centre in the camera frame, radians.
    pub elevation: f64,
    /// Markers of which at least half of the black square is visible.
    pub markers_visible_50: u32,
    /// Markers of which at least 90 % of the black square is visible.
    pub markers_visible_90: u32,
    /// Side of the largest marker of those, pixels of the sphere image; 0 without any.
    pub best_side_px: f64,
    /// Length of the motion blur, pixels of the sphere image.
    pub blur_px: f64,
    /// Whether one of them is seen at less than 65 degrees of incidence. Says nothing about size,
    /// blur or light.
    pub localisable: bool,
}

/// What the counting needs to know of the camera.
#[derive(Debug, Clone, Copy)]
pub struct Viewer {
    /// Pixels of the sphere image for each radian.
    pub pixels_per_radian: f64,
    /// Exposure, seconds.
    pub exposure_s: f64,
    /// Softness of the own airframe's edges, radians; `None` without one.
    pub own_airframe: Option<f32>,
}

/// The truth of every body at `moment`, in the order of `drones`.
pub fn targets(drones: &[Drone], moment: &Moment, viewer: Viewer) -> Vec<TargetTruth> {
    let pairs = || drones.iter().zip(&moment.placements);
    pairs()
        .enumerate()
        .map(|(target, (drone, placement))| {
            let pose = placement.camera_from_markers;
            let at = pose.translation.vector;
            let hiding: Vec<(&Drone, &Placement)> = pairs()
                .enumerate()
                .filter(|(index, (other, place))| {
                    *index == target || may_hide((other, place), (drone, placement))
                })
                .map(|(_, pair)| pair)
                .collect();
            let mut truth = TargetTruth {
                name: drone.name.clone(),
                target,
                camera_from_markers: pose,
                velocity_in_camera: placement.velocity_in_camera,
                distance_m: at.norm(),
                azimuth: at.y.atan2(at.x),
                elevation: at.z.atan2(at.x.hypot(at.y)),
                markers_visible_50: 0,
                markers_visible_90: 0,
                best_side_px: 0.0,
                blur_px: placement.angular_speed() * viewer.exposure_s * viewer.pixels_per_radian,
                localisable: false,
            };
            count_markers(&mut truth, drone, &hiding, viewer);
            truth
        })
        .collect()
}

fn count_markers(
    truth: &mut TargetTruth,
    drone: &Drone,
    hiding: &[(&Drone, &Placement)],
    viewer: Viewer,
) {
    let pose = truth.camera_from_markers;
    for marker in &drone.markers {
        let corners = marker.corners.map(|corner| pose * corner);
        let towards_eye = -(pose * marker.centre()).coords;
        let incidence = (pose.rotation * marker.normal()).angle(&towards_eye).to_degrees();
        if incidence >= 90.0 {
            continue;
        }
        let visible = visible_share(&corners, hiding, viewer);
        truth.markers_visible_50 += u32::from(visible >= 0.5);
        if visible >= 0.9 {
            truth.markers_visible_90 += 1;
            let angles = (0..4).map(|k| corners[k].coords.angle(&corners[(k + 1) % 4].coords));
            let side = angles.sum::<f64>() / 4.0 * viewer.pixels_per_radian;
            truth.best_side_px = truth.best_side_px.max(side);
            truth.localisable |= incidence < LOCALISABLE_DEG;
        }
    }
}

/// Whether one drone is near enough to the line of sight to another one, and before it.
fn may_hide(
    (one, placed): (&Drone, &Placement),
    (other, other_placed): (&Drone, &Placement),
) -> bool {
    let (a, b) = (placed.position(), other_placed.position());
    let angular_radius =
        |drone: &Drone, at: &Vector3<f64>| (drone.radius / at.norm()).min(1.0).asin();
    a.norm() < b.norm() && a.angle(&b) < angular_radius(one, &a) + angular_radius(other, &b)
}

/// Share of a square, its corners in the camera frame, that nothing hides.
fn visible_share(
    corners: &[Point3<f64>; 4],
    hiding: &[(&Drone, &Placement)],
    viewer: Viewer,
) -> f64 {
    let [origin, right, _, down] = corners;
    let step = |k: u32| (f64::from(k) + 0.5) / f64::from(GRID);
    let points = (0..GRID * GRID)
        .map(|k| origin + (right - origin) * step(k % GRID) + (down - origin) * step(k / GRID));
    let seen = points.filter(|point| {
        let behind_own = viewer.own_airframe.is_some_and(|softness| {
            let longitude = point.y.atan2(point.x) as f32;
            let latitude = point.z.atan2(point.x.hypot(point.y)) as f32;
            own_airframe::cover(longitude, latitude, softness) > 0.5
        });
        !behind_own
            && !hiding.iter().any(|(drone, placement)| {
                let markers_from_camera = placement.camera_from_markers.inverse();
                drone.hides(
                    &(markers_from_camera * Point3::origin()),
                    &(markers_from_camera * point),
                )
            })
    });
    seen.count() as f64 / f64::from(GRID * GRID)
}
