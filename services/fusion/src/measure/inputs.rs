//! Inputs for the measurement of one target in a frame, collected once.

use flockeye_geometry::body::Body;
use flockeye_geometry::pose::{CornerRay, PoseSolution, choose, lead, solve};
use nalgebra::Isometry3;

use crate::account::{Pass, Trial};
use crate::aligner::{Aligner, BestView, Sought, Start};
use crate::decide::markers::supports;
use crate::decide::{self, Decision};
use crate::frame::parts::{Attempt, Part};
use crate::hypothesis::{CornerPose, Hypothesis, StartSource};
use crate::policy::TimeBudget;
use crate::track_prior::TrackPrior;

/// Most solutions from corners as starts, lowest cost first: the right one may cost more than its
/// mirror pose.
const STARTS_FROM_CORNERS: usize = 3;

/// Inputs for the measurement of one target in a frame.
#[derive(Debug, Clone)]
pub(crate) struct PassInputs<'f> {
    pub(crate) target: usize,
    pub(crate) body: &'f Body,
    /// Rays of its decoded markers' corners.
    pub(crate) decoded: Vec<CornerRay>,
    /// Distance for which the rays are exact, metres; infinite where it does not matter.
    pub(crate) rays_m: f64,
    pub(crate) prior: TrackPrior,
    pub(crate) best_view: Option<BestView<'f>>,
    /// The trial that begins: the kind of pass, and its thoroughness.
    pub(crate) trial: Trial,
    /// The target's part in the frame, with the results of earlier passes. `None` where that does
    /// not count.
    pub(crate) part: Option<&'f Part>,
}

impl PassInputs<'_> {
    /// Summary of these inputs, to compare them with later ones.
    pub(crate) fn attempt(&self) -> Attempt {
        Attempt {
            view_index: self.best_view.map(|view| view.view_index),
            decoded: self.decoded.len(),
            budget: self.trial.budget,
        }
    }

    /// Measures the target: by the picture from the starts of the pass, and by corners alone. The
    /// decision between them is in the trial.
    pub(crate) fn measure(&self, aligner: &Aligner) -> Trial {
        let solutions = solve(self.body, &self.decoded).unwrap_or_default();
        let chosen = choose(&solutions, self.prior.confirmed());
        let corner_poses: Vec<CornerPose> = solutions
            .iter()
            .map(|solution| CornerPose {
                is_chosen: chosen.is_some_and(|chosen| std::ptr::eq(chosen, solution)),
                verdict: decide::of_corners(
                    solution,
                    self.prior.confirmed(),
                    self.trial.pass.min_markers(),
                    lead(&solutions, solution, self.prior.confirmed()),
                ),
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
        Trial { corner_poses, hypotheses, decision, ..self.trial.clone() }
    }

    /// Compares the body with the picture, but not again from a failed start. `corners` are the
    /// solutions from the decoded markers, the best first.
    fn compare(
        &self,
        aligner: &Aligner,
        view: &BestView<'_>,
        corners: &[&PoseSolution],
        tried: &mut Vec<Hypothesis>,
    ) -> Decision {
        let attempt = self.attempt();
        let Trial { pass, budget, is_deferred, .. } = self.trial;
        let failed = self.part.and_then(Part::failed);
        let is_new = failed.is_none_or(|failed| !attempt.is_pointless_after(&failed));
        let starts = self.starts(pass, corners, |source| {
            is_new && !(is_deferred && source == StartSource::RoughPrediction)
        });
        let sought =
            Sought { target: self.target, picture: &view.picture, starts: &starts, budget };
        let is_marked = |pose: &Isometry3<f64>| supports(self.body, &self.decoded, pose);
        let confirmed = self.prior.confirmed();
        let decision = aligner.find(&sought, is_marked, confirmed, tried);
        // A direct pass accepts only a certain pose: others wait for markers. The decision above
        // also accepts a supported one.
        match pass {
            Pass::Direct if !tried.is_empty() => decide::of_direct_pass(tried),
            _ => decision,
        }
    }

    /// Starts of a pass, if `is_worth` the time.
    fn starts(
        &self,
        pass: Pass,
        corners: &[&PoseSolution],
        is_worth: impl Fn(StartSource) -> bool,
    ) -> Vec<(StartSource, Start)> {
        let mut starts = Vec::new();
        let predicted = self.prior.predicted().map(|known| known.camera_from_markers);
        let predicted = predicted.into_iter().chain(self.prior.rival().copied());
        for source in pass.starts().iter().copied().filter(|source| is_worth(*source)) {
            match source {
                StartSource::Corners => {
                    let best = corners.iter().take(STARTS_FROM_CORNERS);
                    starts.extend(best.map(|solution| {
                        (StartSource::Corners, Start::Fine(solution.camera_from_markers))
                    }));
                }
                StartSource::Prediction => starts.extend(predicted.clone().map(|predicted| {
                    let fine = (source, Start::Fine(predicted));
                    self.rejected_start(&predicted).unwrap_or(fine)
                })),
                StartSource::RoughPrediction => {
                    starts.extend(predicted.clone().map(|pose| (source, Start::Rough(pose))));
                }
                // These follow from other starts, or the aligner adds them itself.
                StartSource::DirectPass | StartSource::Mirror | StartSource::Place => {}
            }
        }
        starts
    }

    /// Result of the direct pass from the same start in the same view.
    fn rejected_start(&self, predicted: &Isometry3<f64>) -> Option<(StartSource, Start)> {
        let view_index = self.best_view?.view_index;
        let rejected = self.part?.rejected.as_ref()?;
        let tried = rejected.hypotheses.first()?;
        let is_same =
            rejected.view_index == Some(view_index) && rejected.predicted == Some(*predicted);
        is_same.then(|| (StartSource::DirectPass, Start::Tried(tried.found.clone().map(Box::new))))
    }

    /// Whether a background pass has a start that no other of this frame had.
    pub(crate) fn wants_background(&self) -> bool {
        let has_time =
            self.trial.budget == TimeBudget::OneFrame || self.prior.confirmed().is_none();
        let asked = self.part.and_then(|part| part.background);
        self.trial.is_deferred
            && has_time
            && asked.is_none_or(|asked| !self.attempt().is_pointless_after(&asked))
    }

    /// Starts of a background pass. Without a confirmed track they include the corners' solutions
    /// again, because the results of all starts compete.
    pub(crate) fn background_starts(&self) -> Vec<(StartSource, Start)> {
        let solutions = match self.prior.confirmed() {
            Some(_) => Vec::new(),
            None => solve(self.body, &self.decoded).unwrap_or_default(),
        };
        let corners: Vec<&PoseSolution> = solutions.iter().collect();
        self.starts(Pass::Background, &corners, |_| true)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::expect_used)]
    use super::*;
    use crate::fixtures::{aligner, alpha, error_m, facing_markers};
    use crate::measurement::{PoseMeasurement, decoded_rays, marker_ids};
    use flockeye_geometry::body::Bodies;
    use flockeye_geometry::pose::PoseEstimate;
    use nalgebra::{Matrix6, Translation3, UnitQuaternion};

    /// The measurement by corners alone.
    fn measure(body: &Body, decoded: Vec<CornerRay>, prior: TrackPrior) -> Option<PoseMeasurement> {
        let bodies = Bodies::new("DICT_5X5_250".into(), vec![body.clone()]).expect("one body");
        let begun = Trial::of(Pass::Complete, &prior, TimeBudget::Unlimited);
        let inputs = PassInputs {
            target: 0,
            body,
            trial: Trial { decoded: marker_ids(&decoded), ..begun },
            decoded,
            rays_m: f64::INFINITY,
            prior,
            best_view: None,
            part: None,
        };
        inputs.measure(&aligner(&bodies)).measurement()
    }

    #[test]
    fn without_a_track_two_markers_are_needed() {
        let body = alpha();
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
        let prior = PoseEstimate { camera_from_markers: pose, covariance };
        let found = measure(&body, rays(1), TrackPrior::Confirmed(prior));
        let found = found.expect("the track decides").pose.camera_from_markers;
        assert!(error_m(&found, &pose) < 1e-3);
    }
}
