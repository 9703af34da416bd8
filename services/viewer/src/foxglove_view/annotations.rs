//! Bodies, markers and regions of interest of a picture, as Foxglove's annotations.

use flockeye_config::Resolved;
use flockeye_contract::{Track, TrackState};
use flockeye_convert::isometry;
use flockeye_geometry::Ray;
use flockeye_geometry::camera::{Equirectangular, SpherePixel};
use foxglove::messages::{
    Color, ImageAnnotations, Point2, PointsAnnotation, TextAnnotation, Timestamp, points_annotation,
};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

use super::values::{colour, of_bytes};
use crate::scene::EndedFrame;
use crate::wire::RegionView;

/// Colour of markers.
const MARKER: [u8; 3] = [0x4d, 0xe3, 0xe3];
/// Points along each side of a region, whose image is curved.
const STEPS: u32 = 8;

/// The annotations of an equirectangular picture of `size` pixels.
pub(super) fn annotations(
    resolved: &Resolved,
    ended: &EndedFrame,
    size: [u32; 2],
    at: Timestamp,
) -> ImageAnnotations {
    let [width, height] = size;
    let picture = Equirectangular { width, height };
    let mut drawn = ImageAnnotations { timestamp: Some(at), ..ImageAnnotations::default() };
    for region in &ended.message.regions {
        let outline = outline(region);
        drawn.points.extend(lines(&picture, at, &outline, colour(region.target, 0.6), 1.0));
    }
    for marker in &ended.message.markers {
        let corners = marker.rays.map(|ray| Vector3::from(ray.map(f64::from)));
        drawn.points.extend(lines(&picture, at, &corners, of_bytes(MARKER, 1.0), 1.0));
    }
    for track in &ended.tracks {
        draw_body(&picture, at, resolved, track, &mut drawn);
    }
    drawn
}

fn draw_body(
    picture: &Equirectangular,
    at: Timestamp,
    resolved: &Resolved,
    track: &Track,
    drawn: &mut ImageAnnotations,
) {
    let Some(body) = resolved.bodies.get(track.target as usize) else { return };
    if track.state == TrackState::Lost.code() {
        return;
    }
    let camera_from_markers = resolved.observer_from_camera.inverse()
        * isometry(&track.observer_from_target)
        * body.target_from_markers;
    for facet in body.facets() {
        let corners: Vec<Vector3<f64>> =
            facet.outline.iter().map(|corner| (camera_from_markers * corner).coords).collect();
        let faces_camera = (camera_from_markers * facet.normal).dot(&corners[0]) < 0.0;
        if faces_camera {
            drawn.points.extend(lines(picture, at, &corners, colour(track.target, 1.0), 1.5));
        }
    }
    let middle = camera_from_markers.translation.vector;
    if let Some(place) = place(picture, &middle) {
        drawn.texts.push(TextAnnotation {
            timestamp: Some(at),
            position: Some(place),
            text: format!("{} {:.2} m", body.name, middle.norm()),
            font_size: 14.0,
            text_color: Some(colour(track.target, 1.0)),
            background_color: Some(of_bytes([0; 3], 0.5)),
            ..TextAnnotation::default()
        });
    }
}

/// A closed line through points of the camera frame. It is cut in two where it leaps from one
/// border of the picture to the other.
fn lines(
    picture: &Equirectangular,
    at: Timestamp,
    points: &[Vector3<f64>],
    colour: Color,
    thickness: f64,
) -> Vec<PointsAnnotation> {
    let closed = points.iter().chain(points.first());
    let mut parts: Vec<Vec<Point2>> = vec![Vec::new()];
    let half = f64::from(picture.width) / 2.0;
    for place in closed.filter_map(|point| place(picture, point)) {
        let leaps =
            |part: &Vec<Point2>| part.last().is_some_and(|last| (last.x - place.x).abs() > half);
        if parts.last().is_some_and(leaps) {
            parts.push(Vec::new());
        }
        if let Some(part) = parts.last_mut() {
            part.push(place);
        }
    }
    let drawn = parts.into_iter().filter(|part| part.len() > 1).map(|points| PointsAnnotation {
        timestamp: Some(at),
        r#type: points_annotation::Type::LineStrip as i32,
        points,
        outline_color: Some(colour),
        thickness,
        ..PointsAnnotation::default()
    });
    drawn.collect()
}

/// Position of a point in the picture, if it has one. Foxglove puts the middle of the first pixel
/// at (0.5, 0.5).
fn place(picture: &Equirectangular, point: &Vector3<f64>) -> Option<Point2> {
    let SpherePixel(at) = picture.project(&Ray::try_new(*point, 1e-9)?);
    Some(Point2 { x: at.x + 0.5, y: at.y + 0.5 })
}

/// Directions along the sides of a region's view, in the camera frame.
fn outline(region: &RegionView) -> Vec<Vector3<f64>> {
    let camera_from_view =
        UnitQuaternion::from_quaternion(Quaternion::from(region.view.q.map(f64::from)));
    let half = f64::from(region.view.half);
    let corners = [[-half, -half], [half, -half], [half, half], [-half, half]];
    let side = |k: usize| {
        let ([x, y], [to_x, to_y]) = (corners[k], corners[(k + 1) % 4]);
        (0..STEPS).map(move |step| {
            let share = f64::from(step) / f64::from(STEPS);
            camera_from_view * Vector3::new(x + share * (to_x - x), y + share * (to_y - y), 1.0)
        })
    };
    (0..4).flat_map(side).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_over_the_seam_is_cut_in_two() {
        let picture = Equirectangular { width: 200, height: 100 };
        let at = Timestamp::new(0, 0);
        let behind = [[-1.0, 0.1, 0.0], [-1.0, -0.1, 0.0], [-1.0, -0.1, 0.1], [-1.0, 0.1, 0.1]];
        let behind = behind.map(Vector3::from);
        let found = lines(&picture, at, &behind, of_bytes([0; 3], 1.0), 1.0);
        assert!(found.len() >= 2, "{found:?}");
        for line in &found {
            let columns: Vec<f64> = line.points.iter().map(|point| point.x).collect();
            let apart = columns.iter().fold(0f64, |most, x| most.max((x - columns[0]).abs()));
            assert!(apart < 10.0, "{columns:?}");
        }
        let ahead = behind.map(|point| Vector3::new(-point.x, point.y, point.z));
        let found = lines(&picture, at, &ahead, of_bytes([0; 3], 1.0), 1.0);
        assert_eq!((found.len(), found[0].points.len()), (1, 5), "it is closed");
    }
}
