//! The truth of a frame: poses of the bodies, and visibility of their markers.

use flockeye_geometry::body::Marker;
use nalgebra::{Isometry3, Point3, Vector3};

use crate::density::{BodySight, Density};
use crate::drone::DroneShape;
use crate::eyes::Eye;
use crate::moment::{Attitude, Moment, Placement};
use crate::own_airframe;
use crate::parameters::WorldParameters;

/// Points along each side of a marker's black square at which visibility is tested.
const GRID: u32 = 10;
/// Incidence below which a whole marker makes its body localisable, degrees.
const LOCALISABLE_DEG: f64 = 65.0;

/// The truth of one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameTruth {
    /// Number of the frame.
    pub frame: u64,
    /// Middle of the exposure, seconds since the middle of frame 0's exposure.
    pub time_s: f64,
    /// Exposure time, seconds.
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
    /// Number of markers with at least half of the black square visible. Each image circle is one
    /// picture: the better of two counts.
    pub markers_visible_50: u32,
    /// Number of markers with at least 90 % of the black square visible.
    pub markers_visible_90: u32,
    /// Side of the largest of these markers, pixels of the image; 0 without any.
    pub best_side_px: f64,
    /// Length of the motion blur, pixels of the image at the body or at the nearest border; 0
    /// farther outside.
    pub blur_px: f64,
    /// Whether one of these markers has an incidence below 65 degrees. Size, blur and light are not
    /// considered.
    pub localisable: bool,
}

/// One body as seen by one eye: its pose, the image there, and the drones that may hide it.
struct EyeView<'a> {
    eye: &'a Eye,
    sight: BodySight,
    hiding: Vec<(&'a DroneShape, Isometry3<f64>)>,
    /// Width of the own airframe's soft edges, radians; `None` without an airframe.
    own_airframe: Option<f32>,
}

/// The truth of every body at `moment`, in the order of `drones`. `sights` has an entry per body
/// and eye; `None`: the body is not in the eye's part.
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
            // The eye that sees the centre. In the strip that no lens of a stitched camera sees:
            // the first eye that sees a part.
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

/// Counts a marker by the picture that shows its largest share.
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

/// Whether one drone may hide another: it is nearer, and close to the line of sight.
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
    /// Pose of the body's markers relative to the eye, along the camera's axes.
    fn pose(&self) -> &Isometry3<f64> {
        &self.sight.placement.camera_from_markers
    }

    /// Angle between the marker's normal and the direction to the eye.
    fn incidence_deg(&self, marker: &Marker) -> f64 {
        let towards_eye = -(self.pose() * marker.centre()).coords;
        (self.pose().rotation * marker.normal()).angle(&towards_eye).to_degrees()
    }

    /// Mean side of the marker's square in the image.
    fn side_px(&self, marker: &Marker) -> f64 {
        let corners = marker.corners.map(|corner| (self.pose() * corner).coords);
        let sides = (0..4).map(|k| (corners[k], corners[(k + 1) % 4]));
        match self.sight.density {
            // Off the equator, columns are compressed; angles are not.
            Density::Even(focal) => sides.map(|(a, b)| a.angle(&b)).sum::<f64>() / 4.0 * focal,
            Density::Local(_) => {
                let length = |a: &Vector3<f64>, b: &Vector3<f64>| {
                    let [a, b] = [self.eye.project(a)?, self.eye.project(b)?];
                    Some((a.0 - b.0).norm())
                };
                // A corner may be just outside the circle.
                let angle = |a: &Vector3<f64>, b: &Vector3<f64>| {
                    a.angle(b) * self.sight.density.pixels_per_radian()
                };
                sides.map(|(a, b)| length(&a, &b).unwrap_or_else(|| angle(&a, &b))).sum::<f64>()
                    / 4.0
            }
        }
    }

    /// Share of a marker's square that is in the eye's part of the image and not hidden.
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

    /// Whether a point relative to the eye is in the eye's part of the image and not hidden.
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
