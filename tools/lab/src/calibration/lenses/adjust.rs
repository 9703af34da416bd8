//! The adjustment of the lenses and of all frames' poses.

use nalgebra::{
    DMatrix, DVector, Isometry3, Matrix6, Point3, UnitQuaternion, Vector2, Vector3, Vector6,
};

use crate::calibration::descent::{Adjust, BundleFrame, Equations, Reduced};
use crate::calibration::weighted_ray::{
    ROBUST_SCALE, WeightedRay, by_motion, damped, moved, spread, weighted_share,
};

/// A frame has a wrong pose if its ray errors exceed those of all frames by this factor.
const MISFIT: f64 = 4.0;

/// A marker as one lens sees it.
pub(super) struct LensSighting {
    pub lens: usize,
    pub corners: [Point3<f64>; 4],
    pub rays: [WeightedRay; 4],
}

/// A frame in which a body spans the seam.
pub(super) type SeamFrame = BundleFrame<LensSighting>;

/// A block and a gradient of the lenses, and a joint block for each frame.
type LensEquations = Equations<(DMatrix<f64>, DVector<f64>), DMatrix<f64>>;

/// The unknowns of the adjustment: the lenses and the poses of all frames.
pub(super) struct Adjustment {
    pub frames: Vec<SeamFrame>,
    /// Positions of the lenses in the camera's axes, metres.
    pub positions: [Vector3<f64>; 2],
    /// Rotation of the second lens from its configured orientation.
    pub second_turn: UnitQuaternion<f64>,
    /// Derivatives of each lens' shift, then turn, by the unknowns, in the camera's axes.
    motions: [DMatrix<f64>; 2],
    /// Scale of the robust cost, in stated deviations.
    scale: f64,
}

/// A step of the lenses, and of each frame: shift, then turn.
type Steps = (DVector<f64>, Vec<Vector6<f64>>);

impl Adjustment {
    /// An adjustment of the distance between the lenses along the camera's x axis. Their middle is
    /// fixed.
    pub(super) fn of_distance(positions: [Vector3<f64>; 2], frames: Vec<SeamFrame>) -> Self {
        let motions = [0.5, -0.5].map(|share| {
            let mut motion = DMatrix::zeros(6, 1);
            motion[(0, 0)] = share;
            motion
        });
        Self::new(positions, motions, frames)
    }

    /// An adjustment of shift and turn of the second lens. The first is fixed.
    pub(super) fn of_second_lens(positions: [Vector3<f64>; 2], frames: Vec<SeamFrame>) -> Self {
        Self::new(positions, [DMatrix::zeros(6, 6), DMatrix::identity(6, 6)], frames)
    }

    fn new(
        positions: [Vector3<f64>; 2],
        motions: [DMatrix<f64>; 2],
        frames: Vec<SeamFrame>,
    ) -> Self {
        let second_turn = UnitQuaternion::identity();
        Self { frames, positions, second_turn, motions, scale: ROBUST_SCALE }
    }

    fn turn(&self, lens: usize) -> UnitQuaternion<f64> {
        if lens == 1 { self.second_turn } else { UnitQuaternion::identity() }
    }

    /// Adjusts only the frames' poses, and returns the remaining errors in stated deviations.
    pub(super) fn scatter_as_configured(&mut self) -> f64 {
        let motions = std::mem::replace(&mut self.motions, [0, 1].map(|_| DMatrix::zeros(6, 0)));
        self.adjust();
        let equations = self.equations();
        let scatter = self.scatter(&equations, 0);
        self.motions = motions;
        scatter.unwrap_or(f64::INFINITY)
    }

    /// Errors of all rays to their body points, seen from their lenses. Each has the index of its
    /// lens.
    fn errors_of(&self, frame: &SeamFrame) -> impl Iterator<Item = (usize, Vector2<f64>)> {
        frame.sightings.iter().flat_map(move |seen| {
            let from_camera = self.turn(seen.lens).inverse();
            let corners = seen.rays.iter().zip(&seen.corners);
            corners.map(move |(ray, corner)| {
                let in_camera = (frame.camera_from_markers * corner).coords;
                let from_lens = in_camera - self.positions[seen.lens];
                (seen.lens, ray.error(&(from_camera * from_lens)))
            })
        })
    }

    /// Drops frames with a wrong pose: the ray errors of one lens are far larger than usual.
    /// Returns the number of dropped frames.
    pub(super) fn leave_out_misfits(&mut self) -> usize {
        let limit = MISFIT * spread(self.errors()).max(1.0);
        let fits = |frame: &SeamFrame| {
            [0, 1].into_iter().all(|lens| {
                let own = self.errors_of(frame).filter(|(of, _)| *of == lens);
                spread(own.map(|(_, error)| error)) <= limit
            })
        };
        let fits: Vec<bool> = self.frames.iter().map(fits).collect();
        let mut fits = fits.into_iter();
        let before = self.frames.len();
        self.frames.retain(|_| fits.next().unwrap_or(true));
        before - self.frames.len()
    }

    fn reduced(equations: &LensEquations, damping: f64) -> Option<Reduced> {
        let (mut matrix, mut gradient) = equations.shared.clone();
        for k in 0..matrix.nrows() {
            matrix[(k, k)] *= 1.0 + damping;
        }
        let mut inverses = Vec::with_capacity(equations.frames.len());
        for (own, of_own, joint) in &equations.frames {
            let inverse = damped(own, damping).try_inverse()?;
            let taken = joint.transpose() * inverse;
            matrix -= &taken * joint;
            gradient -= &taken * of_own;
            inverses.push(inverse);
        }
        Some(Reduced { matrix, gradient, inverses })
    }

    /// The remaining errors, in stated deviations.
    fn scatter(&self, equations: &LensEquations, unknown: usize) -> Option<f64> {
        let unknowns = 6 * self.frames.len() + unknown;
        let freedom = (2 * equations.rays).checked_sub(unknowns).filter(|&left| left > 0)?;
        // Poses of frames with few rays absorb much of the errors, so the robust weights reduce
        // less.
        let kept = freedom as f64 / (2 * equations.rays) as f64;
        let squares = equations.squares / freedom as f64;
        let of = |scatter: f64| {
            let share = weighted_share(2.0 * kept * scatter * scatter, self.scale);
            (squares / share).sqrt()
        };
        Some((0..20).fold(squares.sqrt(), |scatter, _| of(scatter)))
    }

    /// The covariance of the second lens relative to the first, shift and turn in the camera's
    /// axes, and the remaining errors in stated deviations.
    pub(super) fn covariance(&self) -> Option<(Matrix6<f64>, f64)> {
        let equations = self.equations();
        let scatter = self.scatter(&equations, self.motions[0].ncols())?;
        let inverse = Self::reduced(&equations, 0.0)?.matrix.cholesky()?.inverse();
        // Derivatives of the second lens' motion relative to the first.
        let relative = &self.motions[1] - &self.motions[0];
        let whole = &relative * inverse * relative.transpose();
        let covariance: Matrix6<f64> = whole.fixed_view::<6, 6>(0, 0).into_owned();
        let is_sound = covariance.iter().all(|number| number.is_finite());
        is_sound.then_some((covariance * (scatter * scatter).max(1.0), scatter))
    }
}

impl Adjust for Adjustment {
    type Equations = LensEquations;
    type Step = Steps;
    type Unknowns = (Vec<Isometry3<f64>>, [Vector3<f64>; 2], UnitQuaternion<f64>);

    fn errors(&self) -> impl Iterator<Item = Vector2<f64>> {
        self.frames.iter().flat_map(move |frame| self.errors_of(frame).map(|(_, error)| error))
    }

    fn scale(&self) -> f64 {
        self.scale
    }

    fn set_scale(&mut self, scale: f64) {
        self.scale = scale;
    }

    fn take(&mut self, (lenses, frames): &Steps) {
        for (frame, step) in self.frames.iter_mut().zip(frames) {
            frame.camera_from_markers = moved(&frame.camera_from_markers, step);
        }
        for (position, motion) in self.positions.iter_mut().zip(&self.motions) {
            *position += (motion * lenses).fixed_rows::<3>(0).into_owned();
        }
        let turn = (&self.motions[1] * lenses).fixed_rows::<3>(3).into_owned();
        self.second_turn = UnitQuaternion::from_scaled_axis(turn) * self.second_turn;
        self.second_turn.renormalize();
    }

    fn unknowns(&self) -> Self::Unknowns {
        let poses = self.frames.iter().map(|frame| frame.camera_from_markers);
        (poses.collect(), self.positions, self.second_turn)
    }

    fn restore(&mut self, (poses, positions, second_turn): Self::Unknowns) {
        for (frame, pose) in self.frames.iter_mut().zip(poses) {
            frame.camera_from_markers = pose;
        }
        (self.positions, self.second_turn) = (positions, second_turn);
    }

    fn equations(&self) -> LensEquations {
        let count = self.motions[0].ncols();
        let mut equations = Equations {
            shared: (DMatrix::zeros(count, count), DVector::zeros(count)),
            frames: Vec::with_capacity(self.frames.len()),
            squares: 0.0,
            rays: 0,
        };
        for frame in &self.frames {
            let (mut own, mut gradient) = (Matrix6::zeros(), Vector6::zeros());
            let mut joint = DMatrix::zeros(6, count);
            for seen in &frame.sightings {
                let from_camera = self.turn(seen.lens).inverse().to_rotation_matrix();
                let motion = &self.motions[seen.lens];
                for (ray, corner) in seen.rays.iter().zip(&seen.corners) {
                    let arm = frame.camera_from_markers.rotation * corner.coords;
                    let in_camera = arm + frame.camera_from_markers.translation.vector;
                    let from_lens = in_camera - self.positions[seen.lens];
                    let (error, by_point) = ray.linearized(&(from_camera * from_lens));
                    let by_point = by_point * from_camera.matrix();
                    let by_frame = by_motion(&by_point, &arm);
                    // A motion of the lens moves all points in the opposite direction.
                    let by_lenses = -by_motion(&by_point, &from_lens) * motion;
                    let squared = error.norm_squared();
                    let weight = 1.0 / (1.0 + squared / (self.scale * self.scale));
                    let of_frame = by_frame.transpose() * weight;
                    let of_lenses = by_lenses.transpose() * weight;
                    own += of_frame * by_frame;
                    gradient += of_frame * error;
                    joint += of_frame * &by_lenses;
                    equations.shared.0 += &of_lenses * &by_lenses;
                    equations.shared.1 += &of_lenses * error;
                    equations.squares += weight * squared;
                    equations.rays += 1;
                }
            }
            equations.frames.push((own, gradient, joint));
        }
        equations
    }

    /// The damped step of the lenses and of every frame.
    fn step(&self, equations: &LensEquations, damping: f64) -> Option<Steps> {
        let Reduced { matrix, gradient, inverses } = Self::reduced(equations, damping)?;
        let lenses = match gradient.len() {
            0 => gradient,
            _ => matrix.cholesky()?.solve(&-gradient),
        };
        let frames = equations.frames.iter().zip(&inverses);
        let frames = frames.map(|((_, of_own, joint), inverse)| {
            let taken: DVector<f64> = joint * &lenses;
            -(inverse * (of_own + taken.fixed_rows::<6>(0)))
        });
        let frames = frames.collect();
        Some((lenses, frames))
    }
}
