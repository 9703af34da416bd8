//! Test: for each frame of a flight the output of `explain` is equal to the decisions of fusion.

#![allow(clippy::unwrap_used)]

use flockeye_config::Resolved;
use flockeye_contract::FrameStamp;
use flockeye_fusion::{AccountEntry, Outcome, Trial};

use super::super::explanation::{DecisiveStep, FrameExplanation, PassFacts};
use super::super::gathered::StageMessages;
use super::super::known::{FrameKnowledge, ReplayOutcome};
use super::super::poses::Mounting;
use super::super::session::Session;
use super::super::{facts, text};
use crate::fixtures::stamp;
use crate::tests::flights::{Recording, flown_on_with_account, resolved};

/// Target number of alpha.
const TARGET: usize = 0;
/// Frames of the flight.
const FRAMES: u64 = 7;

/// The known facts about alpha in a frame.
fn known(resolved: &Resolved, recording: &Recording, stamp: FrameStamp) -> FrameKnowledge {
    let mut gathered = StageMessages::of(stamp, TARGET as u32);
    let mut session = Session::begin(resolved, TARGET, stamp);
    for (message, utc_ns) in recording.iter().cloned() {
        gathered.on(&message);
        session.on(message, utc_ns, &gathered);
    }
    let (replay, before, decisions) = session.finish();
    let (target, at_s, lost) = (TARGET, 0.0, Vec::new());
    FrameKnowledge { target, stamp, at_s, gathered, before, decisions, replay, lost }
}

/// Each hypothesis is printed as it was decided, and the chosen one as accepted.
fn assert_same_hypotheses(said: &PassFacts, trial: &Trial) {
    let decided: Vec<_> = trial.decided().collect();
    assert_eq!(decided.len(), trial.hypotheses.len(), "each has its reason");
    assert_eq!(said.hypotheses.len(), decided.len());
    for (index, (said, (hypothesis, _))) in said.hypotheses.iter().zip(decided).enumerate() {
        assert_eq!(said.log_odds, hypothesis.log_odds());
        let is_chosen = trial.decision.hypothesis() == Some(index);
        assert!(!is_chosen || said.verdict == "accepted", "{said:?}");
        assert!(is_chosen || said.verdict != "accepted" || trial.decision.hypothesis().is_none());
    }
}

/// The published pose is the one of the decision.
fn assert_same_result(resolved: &Resolved, explanation: &FrameExplanation, trial: &Trial) {
    let Outcome::Published(measurement) = trial.outcome else { return };
    let result = explanation.result.as_ref().unwrap();
    let by = measurement.measured_by;
    assert_eq!(result.measured_by, Some(by));
    assert_eq!(trial.measurement(), Some(measurement), "this camera's poses need no correction");
    let mounting = Mounting { resolved, target: TARGET };
    let decided = mounting.of_markers(&measurement.pose.camera_from_markers);
    let off = (0..3).map(|axis| {
        (decided.position[axis] - result.measured.as_ref().unwrap().position[axis]).abs()
    });
    assert!(off.fold(0.0, f64::max) < 1e-9);
    assert_eq!(explanation.step, DecisiveStep::Measured);
    if let (true, Some(chosen)) =
        (by == flockeye_contract::MeasuredBy::Aligned, trial.decision.hypothesis())
    {
        let log_odds = trial.hypotheses[chosen].log_odds().unwrap();
        assert!(explanation.why.contains(&format!("with log odds {log_odds:.1}")));
    }
}

#[test]
fn explain_says_what_was_decided_in_flight() {
    let (recording, account) = flown_on_with_account();
    let resolved = resolved();
    let mut published = 0;
    for sequence in 0..FRAMES {
        let known = known(&resolved, &recording, stamp(sequence));
        assert_eq!(known.replay, ReplayOutcome::Same, "frame {sequence}");
        let order = stamp(sequence).order();
        let of_frame = account.iter().filter(|(of, _)| *of == order);
        let decided: Vec<AccountEntry> = of_frame.map(|(_, entry)| entry.clone()).collect();
        assert_eq!(known.decisions, decided, "frame {sequence}");
        let explanation = facts::explanation("flight.mcap".as_ref(), &resolved, &known);
        assert_eq!(explanation.passes.len(), decided.len());
        for (said, entry) in explanation.passes.iter().zip(&decided) {
            let AccountEntry::Ran(trial) = entry else {
                assert!(said.hypotheses.is_empty());
                continue;
            };
            assert_same_hypotheses(said, trial);
            assert_same_result(&resolved, &explanation, trial);
            published += usize::from(matches!(trial.outcome, Outcome::Published(_)));
            let printed = text::of(&explanation);
            said.hypotheses.iter().for_each(|one| assert!(printed.contains(&one.decided)));
        }
    }
    assert!(published >= 5, "alpha is followed: {published}");
}
