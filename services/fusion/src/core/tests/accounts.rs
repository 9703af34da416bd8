//! What the core notes where somebody asks.

use super::*;
use crate::account::{NotRun, Pass};
use crate::decide::Verdict;
use crate::decide::outcome::Outcome;
use crate::hypothesis::StartSource;

/// What was decided of alpha in a frame since this was asked last.
fn decided(core: &mut Core<Vec<u8>>, sequence: u64) -> Vec<AccountEntry> {
    let decisions = core.take_account().into_iter();
    decisions.filter(|(order, _)| *order == stamp(sequence).order()).map(|(_, said)| said).collect()
}

fn the_trial(decisions: &[AccountEntry]) -> &Trial {
    match decisions {
        [AccountEntry::Ran(trial)] => trial,
        other => panic!("{other:?}"),
    }
}

#[test]
fn nothing_is_noted_of_whom_nobody_asks() {
    let (mut core, plan_id) = tracking(Schedule::Flight);
    core.on(region(3, plan_id), 0);
    assert_eq!(poses(&drain(&mut core, 0)), [0]);
    assert!(core.take_account().is_empty());
    core.keep_account(1);
    core.on(region(4, plan_id), 0);
    assert_eq!(poses(&drain(&mut core, 0)), [0]);
    assert!(core.take_account().is_empty(), "it is another target");
}

#[test]
fn a_direct_pass_is_noted_with_its_hypothesis() {
    let (mut core, plan_id) = tracking(Schedule::Flight);
    core.keep_account(0);
    core.on(region(3, plan_id), 0);
    drain(&mut core, 0);
    let decisions = decided(&mut core, 3);
    let trial = the_trial(&decisions);
    assert_eq!((trial.pass, trial.view_index, trial.is_confirmed), (Pass::Direct, Some(0), true));
    assert!(matches!(trial.outcome, Outcome::Published(_)), "{:?}", trial.outcome);
    let [hypothesis] = &trial.hypotheses[..] else { panic!("{trial:?}") };
    assert_eq!(hypothesis.source, StartSource::Prediction);
    assert_eq!(trial.decision.reasons, [Verdict::Accepted]);
    // A grey picture shows nothing.
    let Event::View(header, mut pixels) = region(4, plan_id) else { unreachable!() };
    pixels.fill(128);
    core.on(Event::View(header, pixels), 0);
    drain(&mut core, 0);
    let decisions = decided(&mut core, 4);
    let trial = the_trial(&decisions);
    assert_eq!(trial.outcome, Outcome::Nothing);
    assert!(!trial.decision.reasons.contains(&Verdict::Accepted), "{trial:?}");
}

#[test]
fn a_corner_pass_is_noted_with_its_corners_and_hypotheses() {
    let mut core = core(Schedule::Flight);
    core.keep_account(0);
    drain(&mut core, 0);
    core.on(region(0, 0), 0);
    drain(&mut core, 0);
    let not_measured = AccountEntry::NotRun(Pass::Direct, NotRun::NotConfirmed);
    assert_eq!(decided(&mut core, 0), [not_measured]);
    core.on(searched(0, 0), 0);
    drain(&mut core, 0);
    let decisions = decided(&mut core, 0);
    let trial = the_trial(&decisions);
    assert_eq!((trial.pass, trial.predicted), (Pass::Region, None));
    assert!(trial.decoded.len() >= 2);
    assert!(trial.corner_poses.iter().any(|pose| pose.is_chosen));
    assert!(matches!(trial.outcome, Outcome::Published(_)), "{:?}", trial.outcome);
    let accepted = trial.decision.hypothesis().map(|index| trial.hypotheses[index].source);
    assert_eq!(accepted, Some(StartSource::Corners));
}

#[test]
fn passes_that_have_nothing_to_go_by_are_noted() {
    let mut unseen = core(Schedule::Flight);
    unseen.keep_account(0);
    drain(&mut unseen, 0);
    unseen.on(frame_end(0, 0, 0), 0);
    drain(&mut unseen, 0);
    let nothing = AccountEntry::NotRun(Pass::Complete, NotRun::NothingKnown);
    assert_eq!(decided(&mut unseen, 0), [nothing]);
    let (mut tracked, plan_id) = tracking(Schedule::Flight);
    tracked.keep_account(0);
    tracked.on(frame_end(3, plan_id, 0), 0);
    drain(&mut tracked, 0);
    let no_view = AccountEntry::NotRun(Pass::Complete, NotRun::NoView);
    assert_eq!(decided(&mut tracked, 3), [no_view]);
}

#[test]
fn markers_that_contradict_a_direct_pose_are_noted_and_suspend_its_pass() {
    let (mut core, plan_id) = tracking(Schedule::Flight);
    core.keep_account(0);
    core.on(region(3, plan_id), 0);
    drain(&mut core, 0);
    core.on(searched_at(3, plan_id, &pose(1.7)), 0);
    core.on(frame_end(3, plan_id, 1), 0);
    drain(&mut core, 0);
    assert!(decided(&mut core, 3).contains(&AccountEntry::Contradicted));
    core.on(region(4, plan_id), 0);
    drain(&mut core, 0);
    let suspended = AccountEntry::NotRun(Pass::Direct, NotRun::Suspended);
    assert_eq!(decided(&mut core, 4), [suspended]);
}

#[test]
fn a_background_pass_is_noted_with_when_its_answer_came() {
    let outcomes = |core: &mut Core<Vec<u8>>| -> Vec<(Pass, Outcome)> {
        let decisions = decided(core, 4).into_iter();
        decisions
            .filter_map(|decision| match decision {
                AccountEntry::Ran(trial) => Some((trial.pass, trial.outcome)),
                _ => None,
            })
            .collect()
    };
    let (mut core, answer) = answered_in_background(Schedule::Flight);
    assert!(outcomes(&mut core).contains(&(Pass::Region, Outcome::InBackground)));
    core.on(Event::Background(answer), 0);
    drain(&mut core, 0);
    let said = outcomes(&mut core);
    assert!(matches!(said[..], [(Pass::Background, Outcome::Published(_))]), "{said:?}");
    // The frame has ended when it comes.
    let costs = Costs { background_pass_ms: 50.0, ..Costs::default() };
    let (mut core, answer) = answered_in_background(virtual_clock(costs));
    core.on(Event::Background(answer), 0);
    drain(&mut core, 0);
    drop(outcomes(&mut core));
    core.on(frame_end(5, 0, 0), 0);
    core.on(frame_end(6, 0, 0), 0);
    drain(&mut core, 0);
    let said = outcomes(&mut core);
    assert!(matches!(said[..], [(Pass::Background, Outcome::Late(_))]), "{said:?}");
}
