//! Where a patch sees a body's facets, and how that moves with the pose.

use nalgebra::{Isometry3, Matrix2, Matrix3, Point2, Vector2, Vector3};

use super::print::{BodyPrint, PrintedFacet};

/// A facet is drawn if the cosine of its incidence is at least this; what is seen more edge on is a
/// sliver of which nothing can be read, and counts as silhouette.
pub(super) const MIN_COSINE: f64 = 0.17;

/// A pinhole camera: where a patch's pixels look. x right, y down, z forward.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Pinhole {
    pub focal_px: f64,
    pub centre_px: Vector2<f64>,
}

impl Pinhole {
    /// The direction that pixel `at` sees, of depth 1.
    #[inline]
    pub fn direction(&self, at: Vector2<f64>) -> Vector3<f64> {
        ((at - self.centre_px) / self.focal_px).push(1.0)
    }

    /// Where `point` is seen; `None` behind the camera or next to it.
    pub fn project(&self, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        (point.z > 1e-3).then(|| point.xy() / point.z * self.focal_px + self.centre_px)
    }
}

/// A facet that faces the camera, at one pose.
#[derive(Debug, Clone)]
pub(super) struct SeenFacet {
    /// Axes of the facet's frame, in the camera's.
    x: Vector3<f64>,
    y: Vector3<f64>,
    z: Vector3<f64>,
    /// The facet's origin.
    origin: Vector3<f64>,
    /// The markers' origin.
    markers: Vector3<f64>,
    /// Distance of the plane along z.
    offset: f64,
    /// The plane's coordinates by pixels, to first order, at the facet's middle.
    pub facet_from_pixel: Matrix2<f64>,
    /// The outline, as the patch sees it.
    pub outline_px: Vec<Vector2<f64>>,
    /// Cosine of the incidence at its middle.
    #[cfg(test)]
    pub cosine: f64,
}

/// How a facet's point under a fixed pixel moves with the pose.
#[derive(Debug, Clone, Copy)]
pub(super) struct Flow {
    /// Where the pixel sees the plane, in the facet's frame, metres.
    pub at: Vector2<f64>,
    /// The same point from the markers' origin, in the camera's axes.
    arm: Vector3<f64>,
    along_x: Vector3<f64>,
    along_y: Vector3<f64>,
}

impl SeenFacet {
    /// The facet at `camera_from_markers`; `None` if it faces away, is seen edge on or lies behind.
    pub fn new(
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
        // A NaN faces nobody.
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
        Some(Self {
            x,
            y,
            z,
            origin,
            markers,
            offset,
            facet_from_pixel,
            outline_px,
            #[cfg(test)]
            cosine,
        })
    }

    /// The plane's point, in the facet's frame, that `direction` sees.
    #[inline]
    pub fn seen(&self, direction: &Vector3<f64>) -> Vector2<f64> {
        let from_origin = direction * (self.offset / self.z.dot(direction)) - self.origin;
        Vector2::new(self.x.dot(&from_origin), self.y.dot(&from_origin))
    }

    /// The point that `direction` sees, and how it moves with the pose.
    ///
    /// A point of the body that moves by d leaves the pixel; what comes in its place lies at
    /// l e - d from it, with e the pixel's direction and l such that it lies in the plane.
    #[inline(always)]
    pub fn flow(&self, direction: &Vector3<f64>) -> Flow {
        let slope = 1.0 / self.z.dot(direction);
        let point = direction * (self.offset * slope);
        let from_origin = point - self.origin;
        Flow {
            at: Vector2::new(self.x.dot(&from_origin), self.y.dot(&from_origin)),
            arm: point - self.markers,
            along_x: self.z * (self.x.dot(direction) * slope) - self.x,
            along_y: self.z * (self.y.dot(direction) * slope) - self.y,
        }
    }

    /// Homography from pixels to the facet's plane, for deciding which pixels it covers.
    pub fn plane_from_pixel(&self, pinhole: &Pinhole) -> Matrix3<f64> {
        let (f, c) = (pinhole.focal_px, pinhole.centre_px);
        let camera_from_pixel =
            Matrix3::new(1.0 / f, 0.0, -c.x / f, 0.0, 1.0 / f, -c.y / f, 0.0, 0.0, 1.0);
        // point = direction * offset / (z . direction), so all is linear before the division.
        let row = |axis: &Vector3<f64>| axis * self.offset - self.z * axis.dot(&self.origin);
        Matrix3::from_rows(&[
            row(&self.x).transpose(),
            row(&self.y).transpose(),
            self.z.transpose(),
        ]) * camera_from_pixel
    }
}

impl Flow {
    /// Derivative of a value by the pose (shift of the markers' origin, then rotation about it,
    /// both in the camera's axes), where `slope` is its derivative by the facet's coordinates.
    #[inline(always)]
    pub fn by_pose(&self, slope: Vector2<f64>) -> [f64; 6] {
        let shift = self.along_x * slope.x + self.along_y * slope.y;
        let turn = self.arm.cross(&shift);
        [shift.x, shift.y, shift.z, turn.x, turn.y, turn.z]
    }
}

/// The facets that face the camera at a pose; `None` in place of the others.
pub(super) fn seen_facets(
    print: &BodyPrint,
    camera_from_markers: &Isometry3<f64>,
    pinhole: &Pinhole,
) -> Vec<Option<SeenFacet>> {
    let see = |facet| SeenFacet::new(facet, camera_from_markers, pinhole);
    print.facets.iter().map(see).collect()
}
