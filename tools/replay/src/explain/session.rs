//! The replay of a recording up to one frame.

use flockeye_config::Resolved;
use flockeye_contract::{FrameOrder, FrameStamp};
use flockeye_fusion::AccountEntry;

use super::gathered::FrameMessages;
use super::known::{ReplayOutcome, TrackBefore};
use crate::recorded::Message;
use crate::replay::{NO_JOURNAL, Replay, names_message};

/// Frames after the explained one that may still bring the answer of its background pass.
const ANSWER_FRAMES: usize = 4;

/// The replay of a recording up to one frame.
pub(super) struct Session {
    target: usize,
    stamp: FrameStamp,
    state: State,
    before: Option<TrackBefore>,
    decisions: Vec<AccountEntry>,
}

#[allow(clippy::large_enum_variant, reason = "there is one")]
enum State {
    UnderWay(Replay),
    Over,
    Different(String),
    Impossible(String),
}

impl Session {
    pub(super) fn begin(resolved: &Resolved, target: usize, stamp: FrameStamp) -> Self {
        let state = match Replay::new(resolved) {
            Err(error) => State::Impossible(format!("{error:#}")),
            Ok(mut replay) => {
                replay.core().keep_account(target);
                State::UnderWay(replay)
            }
        };
        Self { target, stamp, state, before: None, decisions: Vec::new() }
    }

    /// Takes a message, until the frame is over and the answer of its background pass has come.
    pub(super) fn on(&mut self, message: Message, utc_ns: u64, gathered: &FrameMessages) {
        let State::UnderWay(replay) = &mut self.state else { return };
        let order: FrameOrder = self.stamp.order();
        // This is the first entry about the frame.
        let heard = replay.on(message, utc_ns, |core, entry| {
            if self.before.is_none() && names_message(entry) && entry.order() == order {
                self.before = Some(TrackBefore::of(core, self.target, &self.stamp));
            }
        });
        if let Err(error) = heard {
            self.stop(State::Impossible(format!("{error:#}")));
            return;
        }
        let decided = replay.core().take_account();
        self.decisions
            .extend(decided.into_iter().filter(|(of, _)| *of == order).map(|(_, what)| what));
        let awaits = replay.core().tracker().has_background_of(order);
        let is_answered = !awaits || gathered.later_frames() >= ANSWER_FRAMES;
        let so_far = replay.so_far();
        if let Some(difference) = so_far.difference.clone() {
            self.state = State::Different(difference);
        } else if replay.has_ended(order) && (is_answered || so_far.end.is_some()) {
            self.state = State::Over;
        } else if let Some(end) = so_far.end.clone() {
            self.stop(State::Impossible(end));
        }
    }

    /// The result of the replay, the track before the frame, and the account of the frame.
    pub(super) fn finish(self) -> (ReplayOutcome, Option<TrackBefore>, Vec<AccountEntry>) {
        let Self { stamp, state, before, decisions, .. } = self;
        let impossible =
            |reason: &str| (ReplayOutcome::Impossible(reason.to_owned()), None, Vec::new());
        match state {
            State::Impossible(reason) => impossible(&reason),
            State::Different(difference) => {
                (ReplayOutcome::Different(difference), before, decisions)
            }
            State::Over => (ReplayOutcome::Same, before, decisions),
            State::UnderWay(replay) if replay.has_ended(stamp.order()) => {
                (ReplayOutcome::Same, before, decisions)
            }
            State::UnderWay(replay) if !replay.has_journal() => impossible(NO_JOURNAL),
            State::UnderWay(_) => impossible("the recording ends before the frame does"),
        }
    }

    /// Stops in a state. The account does not count where the replay has failed.
    fn stop(&mut self, state: State) {
        (self.before, self.decisions, self.state) = (None, Vec::new(), state);
    }
}
