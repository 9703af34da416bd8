//! The facets of a body in a patch, and their derivatives by the pose.

use nalgebra::{Isometry3, Matrix2, Matrix3, Point2, Vector2, Vector3};

use crate::align::pinhole::Pinhole;
use crate::align::print::{BodyPrint, PrintedFacet};

/// A facet is drawn if the cosine of its angle of incidence is at least this. A facet seen more
/// edge-on is too narrow to read; its edges count as silhouette.
const MIN_COSINE: f64 = 0.17;

/// A facet that faces the camera, at one pose.
#[derive(Debug, Clone)]
pub(in crate::align) struct VisibleFacet {
    /// Axes of the facet's frame, in the camera frame.
    x: Vector3<f64>,
    y: Vector3<f64>,
    z: Vector3<f64>,
    /// Origin of the facet's frame.
    origin: Vector3<f64>,
    /// Origin of the markers' frame.
    markers: Vector3<f64>,
    /// Distance of the facet's plane from the camera, along z.
    offset: f64,
    /// Derivative of the plane's coordinates (metres) by the pixel, at the facet's middle.
    pub facet_from_pixel: Matrix2<f64>,
    /// The outline in the patch, pixels.
    pub outline_px: Vec<Vector2<f64>>,
}

/// Motion of the facet's point under a fixed pixel with the pose.
#[derive(Debug, Clone, Copy)]
pub(in crate::align) struct PointFlow {
    /// The point of the plane under the pixel, in the facet's frame, metres.
    pub at: Vector2<f64>,
    /// The point relative to the markers' origin, in the camera's axes.
    arm: Vector3<f64>,
    along_x: Vector3<f64>,
    along_y: Vector3<f64>,
}

impl VisibleFacet {
    /// The facet at a pose; `None` if it faces away, is seen edge-on or lies behind the camera.
    pub(crate) fn new(
        facet: &PrintedFacet,
        camera_from_markers: &Isometry3<f64>,
        pinhole: &Pinhole,
    ) -> Option<Self> {
        let camera_from_facet = camera_from_markers * facet.markers_from_facet;
        let axes = camera_from_facet.rotation.to_rotation_matrix();
        let column = |k: usize| axes.matrix().column(k).into_owned();
        let (x, y, z) = (column(0), column(1), column(2));
        let origin = camera_from_facet.translation.vector;
        let in_camera = |point: &Point2<f64>| origin + x * point.x + y * point.y;
        let middle = in_camera(&facet.middle());
        let cosine = z.dot(&middle) / middle.norm();
        // False for a NaN.
        let faces_camera = cosine >= MIN_COSINE;
        if !faces_camera {
            return None;
        }
        let outline_px = facet
            .outline
            .iter()
            .map(|corner| pinhole.project(&in_camera(corner)))
            .collect::<Option<Vec<_>>>()?;
        let scale = pinhole.focal_px / middle.z;
        let across = |axis: &Vector3<f64>| (axis.xy() - middle.xy() * (axis.z / middle.z)) * scale;
        let facet_from_pixel = Matrix2::from_columns(&[across(&x), across(&y)]).try_inverse()?;
        let markers = camera_from_markers.translation.vector;
        let offset = z.dot(&origin);
        Some(Self { x, y, z, origin, markers, offset, facet_from_pixel, outline_px })
    }

    /// Least and largest coordinate of the outline along an axis of the patch, pixels.
    pub(crate) fn span_px(&self, axis: usize) -> (f64, f64) {
        let along = self.outline_px.iter().map(|corner| corner[axis]);
        along.fold((f64::MAX, f64::MIN), |(low, high), at| (low.min(at), high.max(at)))
    }

    /// The point of the plane in this `direction`, in the facet's frame.
    #[inline]
    pub(crate) fn point(&self, direction: &Vector3<f64>) -> Vector2<f64> {
        let from_origin = direction * (self.offset / self.z.dot(direction)) - self.origin;
        Vector2::new(self.x.dot(&from_origin), self.y.dot(&from_origin))
    }

    /// The point in this `direction`, and its derivative by the pose.
    ///
    /// When the body moves by d, its point leaves the pixel. The point that takes its place lies at
    /// l e - d from it, with e the direction of the pixel and l such that it lies in the plane.
    #[inline(always)]
    pub(crate) fn flow(&self, direction: &Vector3<f64>) -> PointFlow {
        let slope = 1.0 / self.z.dot(direction);
        let point = direction * (self.offset * slope);
        let from_origin = point - self.origin;
        PointFlow {
            at: Vector2::new(self.x.dot(&from_origin), self.y.dot(&from_origin)),
            arm: point - self.markers,
            along_x: self.z * (self.x.dot(direction) * slope) - self.x,
            along_y: self.z * (self.y.dot(direction) * slope) - self.y,
        }
    }

    /// Homography from pixels to the facet's plane, used to find the covered pixels.
    pub(crate) fn plane_from_pixel(&self, pinhole: &Pinhole) -> Matrix3<f64> {
        let (f, c) = (pinhole.focal_px, pinhole.centre_px);
        let camera_from_pixel =
            Matrix3::new(1.0 / f, 0.0, -c.x / f, 0.0, 1.0 / f, -c.y / f, 0.0, 0.0, 1.0);
        // point = direction * offset / (z . direction): linear before the division.
        let row = |axis: &Vector3<f64>| axis * self.offset - self.z * axis.dot(&self.origin);
        Matrix3::from_rows(&[
            row(&self.x).transpose(),
            row(&self.y).transpose(),
            self.z.transpose(),
        ]) * camera_from_pixel
    }
}

impl PointFlow {
    /// Derivative of a value by the pose: by the shift of the markers' origin, then by the rotation
    /// about it, both in the camera's axes. `slope` is its derivative by the facet's coordinates.
    #[inline(always)]
    pub(crate) fn by_pose(&self, slope: Vector2<f64>) -> [f64; 6] {
        let shift = self.along_x * slope.x + self.along_y * slope.y;
        let turn = self.arm.cross(&shift);
        [shift.x, shift.y, shift.z, turn.x, turn.y, turn.z]
    }
}

/// The facets of a body at a pose; `None` for those that do not face the camera.
pub(in crate::align) fn visible_facets(
    print: &BodyPrint,
    camera_from_markers: &Isometry3<f64>,
    pinhole: &Pinhole,
) -> Vec<Option<VisibleFacet>> {
    let visible = |facet| VisibleFacet::new(facet, camera_from_markers, pinhole);
    print.facets.iter().map(visible).collect()
}
