//! The adjustment of the lenses and of all frames' poses.

use nalgebra::{DMatrix, DVector, Isometry3, Matrix6, UnitQuaternion, Vector2, Vector3, Vector6};

use super::seam::SeamFrame;
use crate::calibration::descent::Adjust;
use crate::calibration::sight::{ROBUST_SCALE, by_motion, damped, moved, spread, weighted_share};

/// Frames whose rays are off by so many times as much as those of all frames have a wrong pose.
const MISFIT: f64 = 4.0;

/// What is unknown of the lenses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Unknowns {
    /// The distance between them along the camera's x axis; the middle stays.
    Distance,
    /// Shift and turn of the second; the first stays.
    SecondLens,
}

impl Unknowns {
    /// How a lens moves with each of them: shift, then turn, in the camera's axes.
    fn motion(self, lens: usize) -> DMatrix<f64> {
        let mut motion = match self {
            Self::Distance => DMatrix::zeros(6, 1),
            Self::SecondLens => DMatrix::zeros(6, 6),
        };
        match (self, lens) {
            (Self::Distance, 0) => motion[(0, 0)] = 0.5,
            (Self::Distance, _) => motion[(0, 0)] = -0.5,
            (Self::SecondLens, 0) => {}
            (Self::SecondLens, _) => motion.fill_with_identity(),
        }
        motion
    }

    /// How the second lens moves against the first.
    fn relative(self) -> DMatrix<f64> {
        self.motion(1) - self.motion(0)
    }
}

/// Everything that is adjusted together.
pub(super) struct Adjustment {
    pub frames: Vec<SeamFrame>,
    /// Where the lenses are, in the camera's axes, metres.
    pub positions: [Vector3<f64>; 2],
    /// How the second is turned against what was configured.
    pub second_turn: UnitQuaternion<f64>,
    unknowns: Unknowns,
    motions: [DMatrix<f64>; 2],
    /// Scale of the robust cost, in stated deviations.
    scale: f64,
}

/// A step of the lenses, and of each frame: shift, then turn.
pub(super) type Steps = (DVector<f64>, Vec<Vector6<f64>>);

/// The normal equations, with the frames' part kept apart.
pub(super) struct Equations {
    lenses: (DMatrix<f64>, DVector<f64>),
    /// Block, gradient, and block with the lenses, of each frame.
    frames: Vec<(Matrix6<f64>, Vector6<f64>, DMatrix<f64>)>,
    /// Sum of weighted squared errors, and number of rays.
    squares: f64,
    rays: usize,
}

/// The equations of the lenses alone (Schur's complement), with the inverses of the frames' own blocks.
struct Reduced {
    matrix: DMatrix<f64>,
    gradient: DVector<f64>,
    inverses: Vec<Matrix6<f64>>,
}

impl Adjustment {
    pub(super) fn new(
        positions: [Vector3<f64>; 2],
        unknowns: Unknowns,
        frames: Vec<SeamFrame>,
    ) -> Self {
        Self {
            frames,
            positions,
            second_turn: UnitQuaternion::identity(),
            unknowns,
            motions: [0, 1].map(|lens| unknowns.motion(lens)),
            scale: ROBUST_SCALE,
        }
    }

    fn turn(&self, lens: usize) -> UnitQuaternion<f64> {
        if lens == 1 { self.second_turn } else { UnitQuaternion::identity() }
    }

    /// Adjusts the frames' poses alone, and gives the errors that remain then, in stated deviations.
    pub(super) fn scatter_as_configured(&mut self) -> f64 {
        let motions = std::mem::replace(&mut self.motions, [0, 1].map(|_| DMatrix::zeros(6, 0)));
        self.adjust();
        let equations = self.equations();
        let scatter = self.scatter(&equations, 0);
        self.motions = motions;
        scatter.unwrap_or(f64::INFINITY)
    }

    /// Errors of all rays to their body points as seen from their lenses, each with its lens, in the
    /// axes that its rays are given in.
    fn errors_of(&self, frame: &SeamFrame) -> impl Iterator<Item = (usize, Vector2<f64>)> {
        frame.sightings.iter().flat_map(move |seen| {
            let from_camera = self.turn(seen.lens).inverse();
            let corners = seen.sights.iter().zip(&seen.corners);
            corners.map(move |(sight, corner)| {
                let in_camera = (frame.camera_from_markers * corner).coords;
                let from_lens = in_camera - self.positions[seen.lens];
                (seen.lens, sight.error(&(from_camera * from_lens)))
            })
        })
    }

    /// Leaves out frames in which the rays of either lens are off by far more than all rays are, and says how
    /// many: their pose is a wrong one.
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

    fn reduced(equations: &Equations, damping: f64) -> Option<Reduced> {
        let (mut matrix, mut gradient) = equations.lenses.clone();
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

    /// Errors that remain, in stated deviations.
    fn scatter(&self, equations: &Equations, unknown: usize) -> Option<f64> {
        let unknowns = 6 * self.frames.len() + unknown;
        let freedom = (2 * equations.rays).checked_sub(unknowns).filter(|&left| left > 0)?;
        // Frames with few rays take much of the errors themselves, so weights take less.
        let kept = freedom as f64 / (2 * equations.rays) as f64;
        let squares = equations.squares / freedom as f64;
        let of = |scatter: f64| {
            let share = weighted_share(2.0 * kept * scatter * scatter, self.scale);
            (squares / share).sqrt()
        };
        Some((0..20).fold(squares.sqrt(), |scatter, _| of(scatter)))
    }

    /// The covariance of the second lens against the first, shift and turn in the camera's axes, and the errors
    /// that remain, in stated deviations.
    pub(super) fn covariance(&self) -> Option<(Matrix6<f64>, f64)> {
        let equations = self.equations();
        let scatter = self.scatter(&equations, self.motions[0].ncols())?;
        let inverse = Self::reduced(&equations, 0.0)?.matrix.cholesky()?.inverse();
        let relative = self.unknowns.relative();
        let whole = &relative * inverse * relative.transpose();
        let covariance: Matrix6<f64> = whole.fixed_view::<6, 6>(0, 0).into_owned();
        let is_sound = covariance.iter().all(|number| number.is_finite());
        is_sound.then_some((covariance * (scatter * scatter).max(1.0), scatter))
    }
}

impl Adjust for Adjustment {
    type Equations = Equations;
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

    fn equations(&self) -> Equations {
        let count = self.motions[0].ncols();
        let mut equations = Equations {
            lenses: (DMatrix::zeros(count, count), DVector::zeros(count)),
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
                for (sight, corner) in seen.sights.iter().zip(&seen.corners) {
                    let arm = frame.camera_from_markers.rotation * corner.coords;
                    let in_camera = arm + frame.camera_from_markers.translation.vector;
                    let from_lens = in_camera - self.positions[seen.lens];
                    let (error, by_point) = sight.linearized(&(from_camera * from_lens));
                    let by_point = by_point * from_camera.matrix();
                    let by_frame = by_motion(&by_point, &arm);
                    // What moves a lens moves everything the other way.
                    let by_lenses = -by_motion(&by_point, &from_lens) * motion;
                    let squared = error.norm_squared();
                    let weight = 1.0 / (1.0 + squared / (self.scale * self.scale));
                    let of_frame = by_frame.transpose() * weight;
                    let of_lenses = by_lenses.transpose() * weight;
                    own += of_frame * by_frame;
                    gradient += of_frame * error;
                    joint += of_frame * &by_lenses;
                    equations.lenses.0 += &of_lenses * &by_lenses;
                    equations.lenses.1 += &of_lenses * error;
                    equations.squares += weight * squared;
                    equations.rays += 1;
                }
            }
            equations.frames.push((own, gradient, joint));
        }
        equations
    }

    /// The damped step of the lenses and of every frame.
    fn step(&self, equations: &Equations, damping: f64) -> Option<Steps> {
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
