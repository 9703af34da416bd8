//! What a frame offers to measure one target by, collected once.

use flockeye_geometry::body::Body;
use flockeye_geometry::pose::{CornerRay, PoseOptions, PoseSolution, choose, solve};
use flockeye_imaging::align::Place;
use nalgebra::Isometry3;

use super::Row;
use super::comparison::Comparison;
use crate::account::{Pass, Trial};
use crate::aligner::{Aligner, BestView, Sought, Start};
use crate::decide::{self, Decision};
use crate::frame::parts::{Attempt, Part};
use crate::hypothesis::{CornerPose, Hypothesis, Source};
use crate::measurement::marker_ids;
use crate::policy::TimeBudget;
use crate::track_prior::TrackPrior;

/// Solutions from corners that alignment starts from, lowest cost first: the right one may cost more
/// than its mirror pose.
const STARTS_FROM_CORNERS: usize = 3;

/// What the policy allows a pass to do for a target.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Permit {
    /// The pass.
    pub row: &'static Row,
    /// How much time there is.
    pub budget: TimeBudget,
    /// Whether rough starts and the search are left to the background pass.
    pub is_deferred: bool,
    /// Whether the target may be searched for round its prediction where nothing else finds it.
    pub may_search: bool,
}

/// What a frame offers to measure one target by.
#[derive(Debug, Clone)]
pub struct Inputs<'f> {
    /// The target's number.
    pub target: usize,
    /// Its body.
    pub body: &'f Body,
    /// Rays of its decoded markers' corners.
    pub decoded: Vec<CornerRay>,
    /// Rays of squares that are probably its markers: alignment may start from them.
    pub candidates: Vec<CornerRay>,
    /// The distance that the rays are right for, metres; infinite where it does not matter.
    pub rays_m: f64,
    /// What its track predicts.
    pub prior: TrackPrior,
    /// The best view of it.
    pub best_view: Option<BestView<'f>>,
    /// The place in that view at which it is looked for in any attitude.
    pub place: Option<Place>,
    /// What may be done.
    pub permit: Permit,
    /// The target's part in the frame: what earlier passes did. `None` where that does not count.
    pub part: Option<&'f Part>,
}

impl<'f> Inputs<'f> {
    /// A view alone, without any marker.
    pub fn of_view(
        pass: Pass,
        target: usize,
        body: &'f Body,
        prior: TrackPrior,
        view: BestView<'f>,
    ) -> Self {
        let (row, budget) = (Row::of(pass), TimeBudget::OneFrame);
        Self {
            target,
            body,
            decoded: Vec::new(),
            candidates: Vec::new(),
            rays_m: view.rays_m,
            prior,
            best_view: Some(view),
            place: None,
            permit: Permit { row, budget, is_deferred: false, may_search: false },
            part: None,
        }
    }
}

impl Inputs<'_> {
    /// What these inputs are, to compare them with later ones.
    pub fn attempt(&self) -> Attempt {
        Attempt {
            view_index: self.best_view.map(|view| view.view_index),
            decoded: self.decoded.len(),
            candidates: self.candidates.len(),
            budget: self.permit.budget,
        }
    }

    /// Whether an attempt, made from the failed one, is worth its time.
    fn is_new(&self, attempt: impl Fn(&Attempt) -> Attempt) -> bool {
        let failed = self.part.and_then(Part::failed);
        failed.is_none_or(|failed| !attempt(&failed).is_pointless_after(&failed))
    }

    /// Measures the target: by the picture from the starts of the pass, and by corners alone. The
    /// decision between them is in the trial.
    pub fn measure(&self, aligner: &Aligner) -> Trial {
        let row = self.permit.row;
        let solutions =
            solve(self.body, &self.decoded, &PoseOptions::default()).unwrap_or_default();
        let chosen = choose(&solutions, self.prior.confirmed()).map(|choice| choice.solution);
        let is_confirmed = self.prior.confirmed().is_some();
        let corner_poses: Vec<CornerPose> = solutions
            .iter()
            .map(|solution| CornerPose {
                is_chosen: chosen.is_some_and(|chosen| std::ptr::eq(chosen, solution)),
                verdict: decide::of_corners(solution, is_confirmed, row.min_markers()),
                solution: solution.clone(),
            })
            .collect();
        let mut hypotheses = Vec::new();
        let by_picture = self.best_view.as_ref().map(|view| {
            let others = solutions.iter().filter(|solution| Some(*solution) != chosen);
            let corners: Vec<&PoseSolution> = chosen.into_iter().chain(others).collect();
            self.compare(aligner, view, &corners, &mut hypotheses)
        });
        let decision =
            decide::with_corners(by_picture.unwrap_or_default(), &hypotheses, &corner_poses);
        Trial { corner_poses, hypotheses, decision, ..self.trial(row.pass) }
    }

    /// The prediction that is searched round, where that is not left to the background pass.
    fn search_round(&self) -> Option<&Isometry3<f64>> {
        let may_search = self.permit.may_search && !self.permit.is_deferred;
        self.prior.predicted().filter(|_| may_search)
    }

    /// The body compared with the picture, but not again from what failed before. `corners` are what
    /// the decoded markers give, the best first.
    fn compare(
        &self,
        aligner: &Aligner,
        view: &BestView<'_>,
        corners: &[&PoseSolution],
        tried: &mut Vec<Hypothesis>,
    ) -> Decision {
        let picture = &view.picture;
        if let Some(place) = &self.place {
            return aligner.find_at(self.target, picture, place, tried);
        }
        let (attempt, Permit { row, budget, is_deferred, .. }) = (self.attempt(), self.permit);
        let fine_is_new =
            self.is_new(|failed| Attempt { candidates: failed.candidates, ..attempt });
        let squares_are_new = self.is_new(|_| attempt);
        let starts = self.starts(row, corners, |source| match source {
            Source::DoubtfulSquares => squares_are_new && !is_deferred,
            Source::RoughPrediction => fine_is_new && !is_deferred,
            _ => fine_is_new,
        });
        let comparison = Comparison {
            sought: Sought { target: self.target, picture, starts: &starts, budget },
            body: self.body,
            decoded: &self.decoded,
            confirmed: self.prior.confirmed().map(|prior| &prior.camera_from_markers),
            // A pose must win against all starts, the deferred ones too.
            needs_facets: is_deferred && self.prior.predicted().is_none(),
            round: self.search_round(),
        };
        let decision = comparison.run(aligner, tried);
        // A direct pass takes only what is certain. The decision above also takes what is merely supported.
        match tried.first() {
            Some(only) if row.is_certain => decide::of_direct_pass(only),
            _ => decision,
        }
    }

    /// What a pass of this `row` starts from, as far as it `is_worth` the time.
    fn starts(
        &self,
        row: &Row,
        corners: &[&PoseSolution],
        is_worth: impl Fn(Source) -> bool,
    ) -> Vec<(Source, Start)> {
        let mut starts = Vec::new();
        let predicted = self.prior.predicted();
        for source in row.starts.iter().copied().filter(|source| is_worth(*source)) {
            match source {
                Source::Corners => {
                    let best = corners.iter().take(STARTS_FROM_CORNERS);
                    starts.extend(best.map(|solution| corner_start(solution)));
                }
                Source::DoubtfulSquares => starts.extend(self.candidate_starts()),
                Source::Prediction => starts.extend(predicted.map(|predicted| {
                    let fine = (Source::Prediction, Start::Fine(*predicted));
                    self.rejected_start(predicted).unwrap_or(fine)
                })),
                Source::RoughPrediction => starts.extend(predicted.map(rough_start)),
                // These follow from other starts, or the aligner finds them itself.
                Source::DirectPass | Source::Mirror | Source::Search | Source::Place => {}
            }
        }
        starts
    }

    fn candidate_starts(&self) -> impl Iterator<Item = (Source, Start)> {
        let solutions = solve(self.body, &self.candidates, &PoseOptions::default());
        let solutions = solutions.unwrap_or_default().into_iter().take(STARTS_FROM_CORNERS);
        let start = |solution: PoseSolution| Start::Rough(solution.camera_from_markers);
        solutions.map(move |solution| (Source::DoubtfulSquares, start(solution)))
    }

    /// What the direct pass found from the same start in the same view.
    fn rejected_start(&self, predicted: &Isometry3<f64>) -> Option<(Source, Start)> {
        let view_index = self.best_view?.view_index;
        let rejected = self.part?.rejected.as_ref()?;
        let is_same = rejected.view_index == view_index && rejected.predicted == *predicted;
        is_same.then(|| (Source::DirectPass, Start::Tried(rejected.found.clone())))
    }

    /// Whether a background pass has something to start from that no other of this frame had.
    pub fn wants_background(&self) -> bool {
        let has_time =
            self.permit.budget == TimeBudget::OneFrame || self.prior.confirmed().is_none();
        let asked = self.part.and_then(|part| part.background);
        self.permit.is_deferred
            && has_time
            && asked.is_none_or(|asked| !self.attempt().is_pointless_after(&asked))
    }

    /// What a background pass starts from. Without a confirmed track the corners' solutions are
    /// among it again, because what one start leads to is compared with what the others do.
    pub fn background_starts(&self) -> Vec<(Source, Start)> {
        let solutions = match self.prior.confirmed() {
            Some(_) => Vec::new(),
            None => solve(self.body, &self.decoded, &PoseOptions::default()).unwrap_or_default(),
        };
        let corners: Vec<&PoseSolution> = solutions.iter().collect();
        self.starts(Row::of(Pass::Background), &corners, |_| true)
    }

    /// A pass with these inputs that begins, for an account of it.
    pub fn trial(&self, pass: Pass) -> Trial {
        Trial {
            view_index: self.best_view.map(|view| view.view_index),
            is_deferred: self.permit.is_deferred,
            decoded: marker_ids(&self.decoded),
            doubtful: marker_ids(&self.candidates),
            ..Trial::of(pass, &self.prior, self.permit.budget)
        }
    }
}

fn corner_start(solution: &PoseSolution) -> (Source, Start) {
    (Source::Corners, Start::Fine(solution.camera_from_markers))
}

fn rough_start(predicted: &Isometry3<f64>) -> (Source, Start) {
    (Source::RoughPrediction, Start::Rough(*predicted))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used)]
    use super::*;
    use crate::fixtures::{aligner, error_m, facing_markers};
    use crate::measurement::{Measurement, decoded_rays};
    use flockeye_geometry::body::{Bodies, squares};
    use flockeye_geometry::pose::PosePrior;
    use nalgebra::{Matrix6, Translation3, UnitQuaternion};

    /// The measurement by corners alone.
    fn measure(body: &Body, decoded: Vec<CornerRay>, prior: TrackPrior) -> Option<Measurement> {
        let bodies = Bodies::new("DICT_5X5_250".into(), vec![body.clone()]).expect("one body");
        let (row, budget) = (Row::of(Pass::Complete), TimeBudget::Unlimited);
        let inputs = Inputs {
            target: 0,
            body,
            decoded,
            candidates: Vec::new(),
            rays_m: f64::INFINITY,
            prior,
            best_view: None,
            place: None,
            permit: Permit { row, budget, is_deferred: false, may_search: false },
            part: None,
        };
        inputs.measure(&aligner(&bodies)).measurement()
    }

    #[test]
    fn without_a_track_two_markers_are_needed() {
        let body = squares("alpha", 0.0625, 0.05, 0);
        let pose = Isometry3::from_parts(
            Translation3::new(-0.7, 0.5, 0.3),
            UnitQuaternion::from_euler_angles(0.2, 0.1, 0.7),
        );
        let rays = |most| decoded_rays(&body, &facing_markers(&body, &pose, most));
        let found = measure(&body, rays(8), TrackPrior::Untracked).expect("several agree");
        assert!(error_m(&found.pose.camera_from_markers, &pose) < 1e-6);
        assert!(found.markers >= 2);
        assert_eq!(measure(&body, rays(1), TrackPrior::Untracked), None);
        let covariance = Matrix6::identity() * 1e-4;
        let prior = PosePrior { camera_from_markers: pose, covariance };
        let found = measure(&body, rays(1), TrackPrior::Confirmed(prior));
        let found = found.expect("the track decides").pose.camera_from_markers;
        assert!(error_m(&found, &pose) < 1e-3);
    }
}
