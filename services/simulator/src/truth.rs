//! What is true of a frame: where the bodies are, and how much of them can be seen.

use flockeye_geometry::body::Marker;
use nalgebra::{Isometry3, Point3, Vector3};

use crate::density::{BodySight, Density};
use crate::drone::DroneShape;
use crate::eyes::Eye;
use crate::moment::{Attitude, Moment, Placement};
use crate::own_airframe;
use crate::parameters::WorldParameters;

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
    /// The camera's attitude in the middle of the exposure.
    pub camera: Attitude,
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
    /// Markers of which at least half of the black square is visible. An image circle is a picture
    /// by itself: a marker counts as it is seen in the better one.
    pub markers_visible_50: u32,
    /// Markers of which at least 90 % of the black square is visible.
    pub markers_visible_90: u32,
    /// Side of the largest marker of those, pixels of the image; 0 without any.
    pub best_side_px: f64,
    /// Length of the motion blur, in pixels as they are in the image where the body is, or at the
    /// border next to it; 0 farther outside.
    pub blur_px: f64,
    /// Whether one of them is seen at less than 65 degrees of incidence. Says nothing about size,
    /// blur or light.
    pub localisable: bool,
}

/// The bodies as one eye sees them: the drone in question, what may hide it, and the image there.
struct EyeView<'a> {
    eye: &'a Eye,
    sight: BodySight,
    hiding: Vec<(&'a DroneShape, Isometry3<f64>)>,
    /// Softness of the own airframe's edges, radians; `None` without one.
    own_airframe: Option<f32>,
}

/// The truth of every body at `moment`, in the order of `drones`. `sights` are, for each body and
/// eye, where the eye has it in its part of the image.
pub(crate) fn targets(
    drones: &[DroneShape],
    moment: &Moment,
    sights: &[Vec<Option<BodySight>>],
    eyes: &[Eye],
    parameters: &WorldParameters,
) -> Vec<TargetTruth> {
    let bodies = drones.iter().zip(&moment.placements).zip(sights).enumerate();
    bodies
        .map(|(target, ((drone, placement), sights))| {
            let views: Vec<EyeView<'_>> = eyes
                .iter()
                .zip(sights)
                .filter_map(|(eye, sight)| Some((eye, sight.as_ref()?)))
                .map(|(eye, sight)| view(drones, moment, target, parameters, eye, sight))
                .collect();
            let exposure_s = parameters.exposure_s;
            // The eye that has the centre; or, in the strip that no lens of a stitched camera sees,
            // one that has what lies beside it.
            let looking = views
                .iter()
                .find(|view| view.eye.project(&view.sight.placement.position()).is_some())
                .or(views.first());
            let mut truth = TargetTruth {
                name: drone.name.clone(),
                target,
                camera_from_markers: placement.camera_from_markers,
                markers_visible_50: 0,
                markers_visible_90: 0,
                best_side_px: 0.0,
                blur_px: looking.map_or(0.0, |EyeView { sight, .. }| {
                    sight.density.motion_px(&sight.placement, exposure_s)
                }),
                localisable: false,
            };
            drone.markers.iter().for_each(|marker| count_marker(&mut truth, marker, &views));
            truth
        })
        .collect()
}

fn view<'a>(
    drones: &'a [DroneShape],
    moment: &Moment,
    target: usize,
    parameters: &WorldParameters,
    eye: &'a Eye,
    sight: &BodySight,
) -> EyeView<'a> {
    let placements = moment.placements.iter().map(|placement| placement.seen_from(eye));
    let hiding = drones
        .iter()
        .zip(placements)
        .enumerate()
        .filter(|(index, (other, place))| {
            let this = (&drones[target], &sight.placement);
            *index == target || may_hide((other, place), this)
        })
        .map(|(_, (drone, place))| (drone, place.camera_from_markers))
        .collect();
    let own_airframe =
        parameters.airframes.then(|| own_airframe::softness(parameters, &sight.density));
    EyeView { eye, sight: *sight, hiding, own_airframe }
}

/// Counts a marker as the picture that shows most of it does.
fn count_marker(truth: &mut TargetTruth, marker: &Marker, views: &[EyeView<'_>]) {
    let shares: Vec<f64> = views.iter().map(|view| view.visible_share(marker)).collect();
    let pictures = views.iter().zip(&shares);
    let in_picture = |picture: usize| -> f64 {
        pictures
            .clone()
            .filter(|(view, _)| view.eye.picture == picture)
            .map(|(_, share)| share)
            .sum()
    };
    let shown = views.iter().map(|view| in_picture(view.eye.picture)).fold(0.0, f64::max);
    truth.markers_visible_50 += u32::from(shown >= 0.5);
    if shown < 0.9 {
        return;
    }
    truth.markers_visible_90 += 1;
    for (view, _) in pictures.filter(|(_, share)| **share > 0.0) {
        truth.best_side_px = truth.best_side_px.max(view.side_px(marker));
        truth.localisable |= view.incidence_deg(marker) < LOCALISABLE_DEG;
    }
}

/// Whether one drone is near enough to the line of sight to another one, and before it.
fn may_hide(
    (one, placed): (&DroneShape, &Placement),
    (other, other_placed): (&DroneShape, &Placement),
) -> bool {
    let (a, b) = (placed.position(), other_placed.position());
    let angular_radius =
        |drone: &DroneShape, at: &Vector3<f64>| (drone.radius / at.norm()).min(1.0).asin();
    a.norm() < b.norm() && a.angle(&b) < angular_radius(one, &a) + angular_radius(other, &b)
}

impl EyeView<'_> {
    /// Pose of the body's markers as the eye sees it, along the camera's axes.
    fn pose(&self) -> &Isometry3<f64> {
        &self.sight.placement.camera_from_markers
    }

    /// Angle between the marker's normal and the way to the eye.
    fn incidence_deg(&self, marker: &Marker) -> f64 {
        let towards_eye = -(self.pose() * marker.centre()).coords;
        (self.pose().rotation * marker.normal()).angle(&towards_eye).to_degrees()
    }

    /// Mean side of the marker's square in the image.
    fn side_px(&self, marker: &Marker) -> f64 {
        let corners = marker.corners.map(|corner| (self.pose() * corner).coords);
        let sides = (0..4).map(|k| (corners[k], corners[(k + 1) % 4]));
        match self.sight.density {
            // Columns are narrower off the equator; angles are not.
            Density::Even(focal) => sides.map(|(a, b)| a.angle(&b)).sum::<f64>() / 4.0 * focal,
            Density::Local(_) => {
                let length = |a: &Vector3<f64>, b: &Vector3<f64>| {
                    let [a, b] = [self.eye.project(a)?, self.eye.project(b)?];
                    Some((a.0 - b.0).norm())
                };
                // A corner may lie just beyond the circle.
                let angle = |a: &Vector3<f64>, b: &Vector3<f64>| {
                    a.angle(b) * self.sight.density.pixels_per_radian()
                };
                sides.map(|(a, b)| length(&a, &b).unwrap_or_else(|| angle(&a, &b))).sum::<f64>()
                    / 4.0
            }
        }
    }

    /// Share of a marker's square that the eye has in its part of the image and nothing hides.
    fn visible_share(&self, marker: &Marker) -> f64 {
        if self.incidence_deg(marker) >= 90.0 {
            return 0.0;
        }
        let [origin, right, _, down] = marker.corners.map(|corner| self.pose() * corner);
        let step = |k: u32| (f64::from(k) + 0.5) / f64::from(GRID);
        let points = (0..GRID * GRID)
            .map(|k| origin + (right - origin) * step(k % GRID) + (down - origin) * step(k / GRID));
        points.filter(|point| self.shows(point)).count() as f64 / f64::from(GRID * GRID)
    }

    /// Whether a point, as the eye sees it, is in its part of the image and before everything.
    fn shows(&self, point: &Point3<f64>) -> bool {
        let behind_own = self.own_airframe.is_some_and(|softness| {
            let longitude = point.y.atan2(point.x) as f32;
            let latitude = point.z.atan2(point.x.hypot(point.y)) as f32;
            own_airframe::cover(longitude, latitude, softness) > 0.5
        });
        !behind_own
            && self.eye.project(&point.coords).is_some()
            && !self.hiding.iter().any(|(drone, eye_from_markers)| {
                let markers_from_eye = eye_from_markers.inverse();
                drone.hides(&(markers_from_eye * Point3::origin()), &(markers_from_eye * point))
            })
    }
}
