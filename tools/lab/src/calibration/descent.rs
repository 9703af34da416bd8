//! Levenberg-Marquardt with a robust cost, common to all adjustments of rays.

use nalgebra::{DMatrix, DVector, Isometry3, Matrix6, Vector2, Vector6};

use super::weighted_ray::{ROBUST_SCALE, cauchy, spread};

/// Most steps for one scale, and most scales.
const MAX_STEPS: usize = 60;
const MAX_SCALES: usize = 12;
/// The first, the least and the largest damping.
const FIRST_DAMPING: f64 = 1e-4;
const LEAST_DAMPING: f64 = 1e-12;
const LARGEST_DAMPING: f64 = 1e6;
/// The descent ends after a step that lowers the cost by a smaller share than this.
const LEAST_GAIN: f64 = 1e-9;

/// A frame with the body's pose and the sightings of its markers.
pub(super) struct BundleFrame<Sighting> {
    pub camera_from_markers: Isometry3<f64>,
    pub sightings: Vec<Sighting>,
}

/// The normal equations, with separate blocks for the frames.
pub(super) struct Equations<Shared, Joint> {
    /// Block of the unknowns that all frames share: the markers or the lenses.
    pub shared: Shared,
    /// Block of each frame, its gradient, and the block that joins it with the shared unknowns.
    pub frames: Vec<(Matrix6<f64>, Vector6<f64>, Joint)>,
    /// Sum of weighted squared errors, and number of rays.
    pub squares: f64,
    pub rays: usize,
}

/// The equations of the shared unknowns alone (Schur's complement).
pub(super) struct Reduced {
    pub matrix: DMatrix<f64>,
    pub gradient: DVector<f64>,
    /// Inverses of the frames' own blocks.
    pub inverses: Vec<Matrix6<f64>>,
}

/// An adjustment: unknowns that are estimated from rays.
pub(super) trait Adjust {
    /// The normal equations, reweighted for the robust cost.
    type Equations;
    /// A step of all unknowns.
    type Step;
    type Unknowns;

    /// Errors of all rays, in stated deviations.
    fn errors(&self) -> impl Iterator<Item = Vector2<f64>>;
    /// Scale of the robust cost, in stated deviations.
    fn scale(&self) -> f64;
    fn set_scale(&mut self, scale: f64);
    /// The equations at the present unknowns.
    fn equations(&self) -> Self::Equations;
    /// The damped step from the equations; `None` if they have no solution.
    fn step(&self, equations: &Self::Equations, damping: f64) -> Option<Self::Step>;
    /// Takes a step.
    fn take(&mut self, step: &Self::Step);
    /// The present unknowns.
    fn unknowns(&self) -> Self::Unknowns;
    /// Restores former unknowns.
    fn restore(&mut self, unknowns: Self::Unknowns);

    /// Finds the unknowns with the least robust cost. The scale of the cost follows the spread of
    /// the errors.
    fn adjust(&mut self) {
        for _ in 0..MAX_SCALES {
            let before = self.scale();
            self.set_scale(ROBUST_SCALE * spread(self.errors()).max(1.0));
            self.descend();
            if (self.scale() / before - 1.0).abs() < 0.01 {
                break;
            }
        }
    }

    /// The robust cost.
    fn cost(&self) -> f64 {
        self.errors().map(|error| cauchy(error.norm_squared(), self.scale())).sum()
    }

    /// Descends with a fixed scale.
    fn descend(&mut self) {
        let mut damping = FIRST_DAMPING;
        let (mut equations, mut cost) = (self.equations(), self.cost());
        for _ in 0..MAX_STEPS {
            let before = self.unknowns();
            let new_cost = self.step(&equations, damping).map(|step| {
                self.take(&step);
                self.cost()
            });
            match new_cost {
                Some(new_cost) if new_cost < cost => {
                    let gain = cost - new_cost;
                    (equations, damping) = (self.equations(), (damping * 0.1).max(LEAST_DAMPING));
                    if gain < LEAST_GAIN * std::mem::replace(&mut cost, new_cost) {
                        break;
                    }
                }
                _ => {
                    self.restore(before);
                    damping *= 10.0;
                    if damping > LARGEST_DAMPING {
                        break;
                    }
                }
            }
        }
    }
}
