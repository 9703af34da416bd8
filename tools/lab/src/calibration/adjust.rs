//! Bundle adjustment of a body's markers.

use nalgebra::{
    Cholesky, DMatrix, DVector, Isometry3, Matrix2x6, Matrix6, Point3, Vector2, Vector6,
};

use super::descent::{Adjust, BundleFrame, Equations, Reduced};
use super::gauge;
use super::weighted_ray::{ROBUST_SCALE, WEIGHTED_SHARE, WeightedRay, by_motion, damped, moved};
use flockeye_geometry::body::{Body, Marker};

/// The rays of a marker in a frame.
pub(super) struct MarkerSighting {
    /// Index of the marker: first in the body, later among the adjusted markers.
    pub marker: usize,
    /// One ray for each corner.
    pub rays: [WeightedRay; 4],
}

/// The unknowns of the adjustment: poses of all frames and markers.
pub(super) struct Bundle {
    pub frames: Vec<BundleFrame<MarkerSighting>>,
    pub markers_from_marker: Vec<Isometry3<f64>>,
    /// The printed corners in each marker's own frame.
    in_marker: Vec<[Point3<f64>; 4]>,
    /// The corners as designed, in the markers' frame.
    designed: Vec<[Point3<f64>; 4]>,
    /// Scale of the robust cost, in stated deviations.
    scale: f64,
}

/// A block and a gradient for each marker, and a joint block for each sighting of a frame.
type MarkerEquations = Equations<Vec<(Matrix6<f64>, Vector6<f64>)>, Vec<Matrix6<f64>>>;

/// A step of each frame and of each marker: shift, then turn.
type Steps = (Vec<Vector6<f64>>, Vec<Vector6<f64>>);

impl Bundle {
    /// A bundle of the markers `found`, which are indices into the body's markers. Other sightings
    /// are dropped.
    pub(super) fn new(
        body: &Body,
        found: &[usize],
        mut frames: Vec<BundleFrame<MarkerSighting>>,
    ) -> Self {
        for frame in &mut frames {
            // Replaces the index in the body by the index among the adjusted markers.
            frame.sightings.retain_mut(|seen| match found.binary_search(&seen.marker) {
                Ok(index) => {
                    seen.marker = index;
                    true
                }
                Err(_) => false,
            });
        }
        let markers: Vec<&Marker> = found.iter().map(|&k| &body.markers[k]).collect();
        let poses: Vec<_> = markers.iter().map(|marker| marker.markers_from_marker()).collect();
        let in_marker = markers
            .iter()
            .zip(&poses)
            .map(|(marker, pose)| marker.corners.map(|corner| pose.inverse() * corner));
        Self {
            frames,
            in_marker: in_marker.collect(),
            designed: markers.iter().map(|marker| marker.corners).collect(),
            markers_from_marker: poses,
            scale: ROBUST_SCALE,
        }
    }

    /// The present corners of a marker, in the markers' frame.
    pub(super) fn corners(&self, marker: usize) -> [Point3<f64>; 4] {
        self.in_marker[marker].map(|corner| self.markers_from_marker[marker] * corner)
    }

    /// The equations of the markers alone (Schur's complement), with the inverses that give the
    /// frames' steps.
    fn reduced(&self, equations: &MarkerEquations, damping: f64) -> Option<Reduced> {
        let count = equations.shared.len();
        let (mut matrix, mut gradient) =
            (DMatrix::<f64>::zeros(6 * count, 6 * count), DVector::<f64>::zeros(6 * count));
        for (k, (own, of_own)) in equations.shared.iter().enumerate() {
            matrix.fixed_view_mut::<6, 6>(6 * k, 6 * k).copy_from(&damped(own, damping));
            gradient.fixed_rows_mut::<6>(6 * k).copy_from(of_own);
        }
        let mut inverses = Vec::with_capacity(self.frames.len());
        for (frame, (own, of_own, joint)) in self.frames.iter().zip(&equations.frames) {
            let inverse = damped(own, damping).try_inverse()?;
            for (a, with_a) in frame.sightings.iter().zip(joint) {
                let taken = with_a.transpose() * inverse;
                let mut rows = gradient.fixed_rows_mut::<6>(6 * a.marker);
                rows -= taken * of_own;
                for (b, with_b) in frame.sightings.iter().zip(joint) {
                    let mut block = matrix.fixed_view_mut::<6, 6>(6 * a.marker, 6 * b.marker);
                    block -= taken * with_b;
                }
            }
            inverses.push(inverse);
        }
        Some(Reduced { matrix, gradient, inverses })
    }

    /// The factor of the markers' matrix with the conditions of [`gauge`], and these conditions.
    /// Without them the body's pose is not determined.
    fn held(&self, matrix: DMatrix<f64>) -> Option<(Cholesky<f64, nalgebra::Dyn>, DMatrix<f64>)> {
        let corners: Vec<_> =
            (0..self.markers_from_marker.len()).map(|k| self.corners(k)).collect();
        let conditions = gauge::conditions(&corners);
        let strength = matrix.trace() / matrix.nrows().max(1) as f64;
        let held = matrix + conditions.transpose() * &conditions * strength;
        Some((Cholesky::new(held)?, conditions))
    }

    /// Moves the whole body to its designed pose.
    pub(super) fn align(&mut self) {
        let count = self.markers_from_marker.len();
        let found: Vec<_> = (0..count).flat_map(|k| self.corners(k)).collect();
        let designed_from_found = gauge::alignment(&found, self.designed.as_flattened());
        for pose in &mut self.markers_from_marker {
            *pose = designed_from_found * *pose;
        }
        for frame in &mut self.frames {
            frame.camera_from_markers *= designed_from_found.inverse();
        }
    }

    /// The covariance of each marker's pose, with the body's pose fixed, and the remaining errors
    /// in stated deviations.
    pub(super) fn covariances(&self) -> Option<(Vec<Matrix6<f64>>, f64)> {
        let equations = self.equations();
        let count = equations.shared.len();
        let unknowns = 6 * (self.frames.len() + count).saturating_sub(1);
        let freedom = (2 * equations.rays).checked_sub(unknowns).filter(|&left| left > 0)?;
        let scatter = equations.squares / (WEIGHTED_SHARE * freedom as f64);
        let (held, conditions) = self.held(self.reduced(&equations, 0.0)?.matrix)?;
        // Removes the covariance that the conditions add.
        let by_conditions = held.solve(&conditions.transpose());
        let inner = (&conditions * &by_conditions).try_inverse()?;
        let covariance = held.inverse() - &by_conditions * inner * by_conditions.transpose();
        let enlarged =
            |k: usize| covariance.fixed_view::<6, 6>(6 * k, 6 * k).into_owned() * scatter.max(1.0);
        let all: Vec<_> = (0..count).map(enlarged).collect();
        let is_sound = all.iter().all(|block| block.diagonal().iter().all(|x| *x > 0.0));
        is_sound.then_some((all, scatter.sqrt()))
    }
}

impl Adjust for Bundle {
    type Equations = MarkerEquations;
    type Step = Steps;
    type Unknowns = (Vec<Isometry3<f64>>, Vec<Isometry3<f64>>);

    fn errors(&self) -> impl Iterator<Item = Vector2<f64>> {
        self.frames.iter().flat_map(move |frame| {
            frame.sightings.iter().flat_map(move |seen| {
                let corners = self.corners(seen.marker);
                (0..4).map(move |k| {
                    let in_camera = frame.camera_from_markers * corners[k];
                    seen.rays[k].error(&in_camera.coords)
                })
            })
        })
    }

    fn scale(&self) -> f64 {
        self.scale
    }

    fn set_scale(&mut self, scale: f64) {
        self.scale = scale;
    }

    fn take(&mut self, (frames, markers): &Steps) {
        for (frame, step) in self.frames.iter_mut().zip(frames) {
            frame.camera_from_markers = moved(&frame.camera_from_markers, step);
        }
        for (pose, step) in self.markers_from_marker.iter_mut().zip(markers) {
            *pose = moved(pose, step);
        }
    }

    fn unknowns(&self) -> Self::Unknowns {
        let poses = self.frames.iter().map(|frame| frame.camera_from_markers);
        (poses.collect(), self.markers_from_marker.clone())
    }

    fn restore(&mut self, (poses, markers): Self::Unknowns) {
        for (frame, pose) in self.frames.iter_mut().zip(poses) {
            frame.camera_from_markers = pose;
        }
        self.markers_from_marker = markers;
    }

    fn equations(&self) -> MarkerEquations {
        let count = self.markers_from_marker.len();
        let mut equations = Equations {
            shared: vec![(Matrix6::zeros(), Vector6::zeros()); count],
            frames: Vec::with_capacity(self.frames.len()),
            squares: 0.0,
            rays: 0,
        };
        for frame in &self.frames {
            let (mut own, mut gradient) = (Matrix6::zeros(), Vector6::zeros());
            let mut joint = vec![Matrix6::zeros(); frame.sightings.len()];
            for (seen, joint) in frame.sightings.iter().zip(&mut joint) {
                let of_marker = &mut equations.shared[seen.marker];
                let pose = &self.markers_from_marker[seen.marker];
                for (ray, corner) in seen.rays.iter().zip(&self.in_marker[seen.marker]) {
                    let (error, by_frame, by_marker) =
                        linearized(ray, &frame.camera_from_markers, pose, corner);
                    let squared = error.norm_squared();
                    let weight = 1.0 / (1.0 + squared / (self.scale * self.scale));
                    let (of_frame, of_own) =
                        (by_frame.transpose() * weight, by_marker.transpose() * weight);
                    own += of_frame * by_frame;
                    gradient += of_frame * error;
                    *joint += of_frame * by_marker;
                    of_marker.0 += of_own * by_marker;
                    of_marker.1 += of_own * error;
                    equations.squares += weight * squared;
                    equations.rays += 1;
                }
            }
            equations.frames.push((own, gradient, joint));
        }
        equations
    }

    /// The damped step of every frame and every marker. It does not move the body as a whole.
    fn step(&self, equations: &MarkerEquations, damping: f64) -> Option<Steps> {
        let reduced = self.reduced(equations, damping)?;
        let solved = self.held(reduced.matrix)?.0.solve(&-reduced.gradient);
        let markers: Vec<Vector6<f64>> = (0..equations.shared.len())
            .map(|k| solved.fixed_rows::<6>(6 * k).into_owned())
            .collect();
        let frames = self.frames.iter().zip(&equations.frames).zip(&reduced.inverses);
        let frames = frames.map(|((frame, (_, of_own, joint)), inverse)| {
            let taken = frame.sightings.iter().zip(joint);
            let taken: Vector6<f64> = taken.map(|(seen, with)| with * markers[seen.marker]).sum();
            -(inverse * (of_own + taken))
        });
        Some((frames.collect(), markers))
    }
}

/// A ray's error with its derivatives by the frame's pose and by the marker's pose. Each is shift,
/// then turn about the own origin, in the camera's or the markers' axes.
fn linearized(
    ray: &WeightedRay,
    camera_from_markers: &Isometry3<f64>,
    markers_from_marker: &Isometry3<f64>,
    corner: &Point3<f64>,
) -> (Vector2<f64>, Matrix2x6<f64>, Matrix2x6<f64>) {
    let arm_of_marker = markers_from_marker.rotation * corner.coords;
    let in_markers = arm_of_marker + markers_from_marker.translation.vector;
    let arm_of_body = camera_from_markers.rotation * in_markers;
    let in_camera = arm_of_body + camera_from_markers.translation.vector;
    let (error, by_point) = ray.linearized(&in_camera);
    let by_point_of_body = by_point * camera_from_markers.rotation.to_rotation_matrix().matrix();
    (error, by_motion(&by_point, &arm_of_body), by_motion(&by_point_of_body, &arm_of_marker))
}
