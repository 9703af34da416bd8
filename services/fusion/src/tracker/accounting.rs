//! An account of what is decided of one target, for whoever asks. Nothing here changes what is
//! decided.

use flockeye_contract::FrameOrder;

use super::Tracker;
use crate::account::{
    Account, Decision, Hypothesis, NotRun, Outcome, Pass, Source, Trial, Verdict,
};
use crate::frame::parts::Parts;
use crate::hypothesis::turn_log;
use crate::measure::inputs::Inputs;
use crate::measure::prediction::{Candidate, Region, RejectedAlignment};
use crate::policy::TimeBudget;

impl Tracker {
    /// Notes from now on what is decided of a target.
    pub fn keep_account(&mut self, target: usize) {
        self.account = Some(Account::of(target));
        if let Some(queue) = &mut self.background {
            queue.keep_account(target);
        }
    }

    /// What was decided of the target since this was asked last, with the frame of each decision.
    pub fn take_account(&mut self) -> Vec<(FrameOrder, Decision)> {
        self.account.as_mut().map(Account::take).unwrap_or_default()
    }

    fn account_of(&mut self, target: usize) -> Option<&mut Account> {
        self.account.as_mut().filter(|account| account.is_of(target))
    }

    /// Whether an account of a target is kept.
    pub(super) fn is_noted(&self, target: usize) -> bool {
        self.account.as_ref().is_some_and(|account| account.is_of(target))
    }

    pub(super) fn note(
        &mut self,
        order: FrameOrder,
        target: usize,
        decision: impl FnOnce() -> Decision,
    ) {
        if let Some(account) = self.account_of(target) {
            account.note(order, decision());
        }
    }

    /// Notes what the last pass over a target led to.
    pub(super) fn note_outcome(&mut self, order: FrameOrder, target: usize, outcome: Outcome) {
        if let Some(account) = self.account_of(target) {
            account.set_outcome(order, outcome);
        }
    }

    /// Why a region is no candidate of the direct pass.
    pub(super) fn note_no_direct_pass(&mut self, order: FrameOrder, target: usize, parts: &Parts) {
        if !self.is_noted(target) {
            return;
        }
        let reason = if parts.is_published(target) {
            NotRun::Published
        } else if self.direct_policy.is_suspended(target) {
            NotRun::Suspended
        } else {
            NotRun::NotMeasuredBefore
        };
        self.note(order, target, || Decision::NotRun(Pass::Direct, reason));
    }

    /// A direct pass that accepted nothing by itself, or what the track does not allow.
    pub(super) fn note_direct_pass(
        &mut self,
        order: FrameOrder,
        candidate: &Candidate<'_>,
        found: &RejectedAlignment,
        outcome: Outcome,
    ) {
        let Candidate { region: Region { target, .. }, predicted } = candidate;
        if !self.is_noted(*target) {
            return;
        }
        let aligned = found.found.clone().map(|found| *found);
        let turn = aligned.as_ref().ok().map(|found| turn_log(found, predicted));
        let mut hypothesis =
            Hypothesis { turn_log: turn, ..Hypothesis::of(Source::Prediction, aligned) };
        if let (Ok(aligned), Some(turn)) = (&hypothesis.found, turn) {
            hypothesis.verdict = match outcome {
                Outcome::Nothing
                    if aligned.is_accepted() && aligned.is_accepted_with_track_prior(turn) =>
                {
                    Verdict::Imprecise
                }
                Outcome::Nothing => Verdict::BelowThreshold,
                Outcome::OutsideGate(_) => Verdict::OutsideGate,
                _ => Verdict::Accepted,
            };
        }
        let trial = Trial {
            view_index: Some(found.view_index),
            is_confirmed: true,
            predicted: Some(*predicted),
            hypotheses: vec![hypothesis],
            outcome,
            ..Trial::of(
                Pass::Direct,
                &crate::track_prior::TrackPrior::Untracked,
                TimeBudget::OneFrame,
            )
        };
        self.note(order, *target, || Decision::Ran(trial));
    }

    /// Why there is nothing that a corner pass could measure a target by.
    pub(super) fn note_no_inputs(
        &mut self,
        order: FrameOrder,
        at_s: f64,
        target: usize,
        pass: Pass,
    ) {
        if self.is_noted(target) {
            let is_tracked = self.prior(target, at_s).predicted().is_some();
            let reason = if is_tracked { NotRun::NoView } else { NotRun::NothingKnown };
            self.note(order, target, || Decision::NotRun(pass, reason));
        }
    }

    /// The answer of a background pass, whose outcome is not known yet unless it was cancelled.
    pub(super) fn note_answer(
        &mut self,
        order: FrameOrder,
        trial: Option<Box<Trial>>,
        is_cancelled: bool,
    ) {
        let (Some(mut trial), Some(account)) = (trial, &mut self.account) else { return };
        if is_cancelled {
            trial.outcome = Outcome::Cancelled;
        }
        account.note(order, Decision::Ran(*trial));
    }

    /// The account of a corner pass with these inputs, if one is kept.
    pub(super) fn trial_of(&self, inputs: &Inputs<'_>, pass: Pass) -> Option<Trial> {
        self.is_noted(inputs.target).then(|| inputs.trial(pass))
    }
}
