//! The replay of a recording up to one frame.

use std::ops::ControlFlow;

use flockeye_config::Resolved;
use flockeye_contract::{FrameOrder, FrameStamp};
use flockeye_fusion::AccountEntry;

use super::gathered::StageMessages;
use super::known::{ReplayOutcome, TrackBefore};
use crate::recorded::FlightMessage;
use crate::replay::{FusionReplay, NO_JOURNAL, names_message};

/// Frames after the explained one that may still bring the answer of its background pass.
const ANSWER_FRAMES: usize = 4;

/// The replay of a recording up to one frame.
pub(super) struct Session {
    target: usize,
    stamp: FrameStamp,
    /// The replay while it is under way, then its outcome.
    state: ControlFlow<ReplayOutcome, Box<FusionReplay>>,
    before: Option<TrackBefore>,
    decisions: Vec<AccountEntry>,
}

impl Session {
    pub(super) fn begin(resolved: &Resolved, target: usize, stamp: FrameStamp) -> Self {
        let state = match FusionReplay::new(resolved) {
            Err(error) => ControlFlow::Break(ReplayOutcome::Impossible(format!("{error:#}"))),
            Ok(mut replay) => {
                replay.core().keep_account(target);
                ControlFlow::Continue(Box::new(replay))
            }
        };
        Self { target, stamp, state, before: None, decisions: Vec::new() }
    }

    /// Takes a message, until the frame is over and the answer of its background pass has come.
    pub(super) fn on(&mut self, message: FlightMessage, utc_ns: u64, gathered: &StageMessages) {
        let ControlFlow::Continue(replay) = &mut self.state else { return };
        let order: FrameOrder = self.stamp.order();
        // The track is read before the first entry about the frame.
        let heard = replay.on(message, utc_ns, |core, entry| {
            if self.before.is_none() && names_message(entry) && entry.order() == order {
                self.before = Some(TrackBefore::of(core, self.target, &self.stamp));
            }
        });
        if let Err(error) = heard {
            self.stop(format!("{error:#}"));
            return;
        }
        let decided = replay.core().take_account();
        self.decisions
            .extend(decided.into_iter().filter(|(of, _)| *of == order).map(|(_, what)| what));
        let awaits = replay.core().tracker().has_background_of(order);
        let is_answered = !awaits || gathered.later_frames() >= ANSWER_FRAMES;
        let so_far = replay.so_far();
        if let Some(difference) = so_far.difference.clone() {
            self.state = ControlFlow::Break(ReplayOutcome::Different(difference));
        } else if replay.has_ended(order) && (is_answered || so_far.end.is_some()) {
            self.state = ControlFlow::Break(ReplayOutcome::Same);
        } else if let Some(end) = so_far.end.clone() {
            self.stop(end);
        }
    }

    /// The result of the replay, the track before the frame, and the account of the frame.
    pub(super) fn finish(self) -> (ReplayOutcome, Option<TrackBefore>, Vec<AccountEntry>) {
        let Self { stamp, state, before, decisions, .. } = self;
        let impossible = |reason: &str| ReplayOutcome::Impossible(reason.to_owned());
        let outcome = match state {
            ControlFlow::Break(outcome) => outcome,
            ControlFlow::Continue(replay) if replay.has_ended(stamp.order()) => ReplayOutcome::Same,
            ControlFlow::Continue(replay) if !replay.has_journal() => impossible(NO_JOURNAL),
            ControlFlow::Continue(_) => impossible("the recording ends before the frame does"),
        };
        match outcome {
            // The account does not count where the replay has failed.
            ReplayOutcome::Impossible(_) => (outcome, None, Vec::new()),
            _ => (outcome, before, decisions),
        }
    }

    fn stop(&mut self, reason: String) {
        self.state = ControlFlow::Break(ReplayOutcome::Impossible(reason));
    }
}
