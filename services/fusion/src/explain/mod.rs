//! `flockeye explain`: why a frame of a recording gave this pose of a neighbour, or none.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`asked`] | the command line |
//! | [`frames`] | which frames a recording has, and which one is meant |
//! | [`gathered`] | what the stages said of that frame |
//! | [`explanation`] | the answer, as data |
//! | [`facts`] | makes it of what was gathered, and of the replayed core's account |
//! | [`passes`] | that account as data |
//! | [`judgement`] | the step that decided, in plain words |
//! | [`text`], [`picture`] | the answer as text, and as a picture |

pub mod asked;
pub mod explanation;
pub mod facts;
pub mod frames;
pub mod gathered;
pub mod judgement;
pub mod passes;
pub mod picture;
pub mod text;

#[cfg(test)]
mod tests;

use std::path::Path;

use anyhow::{Context as _, bail};
use flockeye_config::Resolved;
use flockeye_contract::{FrameOrder, FrameStamp};
use flockeye_geometry::filter::TrackState;
use nalgebra::{Isometry3, Matrix6};

use self::asked::{Asked, ExplainArguments};
use self::explanation::Explanation;
use self::frames::Frames;
use self::gathered::Gathered;
use crate::account::Decision;
use crate::core::Core;
use crate::recorded::{Lost, Message, Recorded, RecordedPixels};
use crate::replay::{NO_JOURNAL, Replay, names_message};

/// So many frames after the one that is explained are looked through for its next search.
pub const LOOK_AHEAD: usize = 60;
/// For so many frames the answer of a background pass is waited for.
const ANSWER_FRAMES: usize = 4;

/// All that is known of one target in one frame.
pub struct Known {
    /// The target's number.
    pub target: usize,
    /// The frame.
    pub stamp: FrameStamp,
    /// When it was exposed, seconds since the recording began.
    pub at_s: f64,
    /// What the stages said.
    pub gathered: Gathered,
    /// What the core knew before the frame; `None` where it was not replayed.
    pub before: Option<Before>,
    /// What the core decided, in this order.
    pub decisions: Vec<Decision>,
    /// Whether the replayed core said all that was recorded, up to and with this frame.
    pub replay: Replaying,
    /// What the recording lacks.
    pub lost: Vec<Lost>,
}

/// How the replay went.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Replaying {
    /// The same bytes.
    Same,
    /// Something else, as stated.
    Different(String),
    /// It could not be done, for the stated reason.
    Impossible(String),
}

/// What a track said before a frame.
#[derive(Debug, Clone, PartialEq)]
pub struct Before {
    /// Its state; `None`: there was no track.
    pub state: Option<TrackState>,
    /// `camera_from_markers` at the frame's exposure, with its covariance.
    pub predicted: Option<(Isometry3<f64>, Matrix6<f64>)>,
}

impl Before {
    /// What `core` knows now of a target for a frame that it has not heard of.
    fn of(core: &Core<RecordedPixels>, target: usize, stamp: &FrameStamp) -> Self {
        let tracker = core.tracker();
        let predicted = tracker.prediction(target, stamp.exposure_s());
        Self {
            state: tracker.targets()[target].state(),
            predicted: predicted.map(|found| (found.camera_from_markers, found.pose_covariance())),
        }
    }
}

/// `flockeye-fusion explain ...`, which `flockeye explain` becomes.
///
/// # Errors
/// The recording cannot be read, or has no such frame or body.
pub fn main(arguments: &ExplainArguments) -> anyhow::Result<()> {
    let asked = arguments.asked()?;
    let (resolved, known) = look(&arguments.file, &asked)?;
    let explanation = facts::explanation(&arguments.file, &resolved, &known);
    match arguments.json {
        true => println!("{}", serde_json::to_string_pretty(&explanation)?),
        false => print!("{}", text::of(&explanation)),
    }
    // The answer stands also where there is nothing to draw.
    match &arguments.image {
        Some(path) => picture::write(path, &resolved, &known, &explanation),
        None => Ok(()),
    }
}

/// The answer as data.
///
/// # Errors
/// As [`main`].
pub fn explain(path: &Path, asked: &Asked) -> anyhow::Result<Explanation> {
    let (resolved, known) = look(path, asked)?;
    Ok(facts::explanation(path, &resolved, &known))
}

/// Reads all that a recording has on what is asked.
fn look(path: &Path, asked: &Asked) -> anyhow::Result<(Resolved, Known)> {
    let mut recorded = Recorded::open(path)?;
    let resolved = recorded.configuration()?;
    let names: Vec<&str> = resolved.bodies.iter().map(|body| body.name.as_str()).collect();
    let Some(target) = names.iter().position(|name| *name == asked.target) else {
        bail!("{} has no body '{}'. It has {}", path.display(), asked.target, names.join(", "));
    };
    let frames = Frames::of(path).with_context(|| path.display().to_string())?;
    let (stamp, at_s) = frames.chosen(asked.when)?;
    let mut gathered = Gathered::of(stamp, target as u32);
    let mut replaying = Session::begin(&resolved, target, stamp);
    loop {
        let (message, utc_ns) = match recorded.next_message() {
            Ok(Some(read)) => read,
            Ok(None) => break,
            // What comes before the damage counts.
            Err(error) if gathered.is_over() => {
                tracing::warn!("{error:#}");
                break;
            }
            Err(error) => return Err(error),
        };
        gathered.on(&message);
        replaying.on(message, utc_ns, &gathered);
        if gathered.is_over() && gathered.later_frames() >= LOOK_AHEAD {
            break;
        }
    }
    let (replay, before, decisions) = replaying.finish();
    let lost = frames.lost;
    Ok((resolved, Known { target, stamp, at_s, gathered, before, decisions, replay, lost }))
}

/// The replay of a recording up to one frame.
struct Session {
    target: usize,
    stamp: FrameStamp,
    state: State,
    before: Option<Before>,
    decisions: Vec<Decision>,
}

#[allow(clippy::large_enum_variant, reason = "there is one")]
enum State {
    UnderWay(Replay),
    Over,
    Different(String),
    Impossible(String),
}

impl Session {
    fn begin(resolved: &Resolved, target: usize, stamp: FrameStamp) -> Self {
        let state = match Replay::new(resolved) {
            Err(error) => State::Impossible(format!("{error:#}")),
            Ok(mut replay) => {
                replay.core().keep_account(target);
                State::UnderWay(replay)
            }
        };
        Self { target, stamp, state, before: None, decisions: Vec::new() }
    }

    /// Takes a message, until the frame is over and no answer to it is waited for.
    fn on(&mut self, message: Message, utc_ns: u64, gathered: &Gathered) {
        let State::UnderWay(replay) = &mut self.state else { return };
        let order: FrameOrder = self.stamp.order();
        // The first that fusion heard of the frame.
        let heard = replay.on(message, utc_ns, |core, entry| {
            if self.before.is_none() && names_message(entry) && entry.order() == order {
                self.before = Some(Before::of(core, self.target, &self.stamp));
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

    /// How it went, what the core knew before the frame, and what it decided.
    fn finish(self) -> (Replaying, Option<Before>, Vec<Decision>) {
        let Self { stamp, state, before, decisions, .. } = self;
        let impossible =
            |reason: &str| (Replaying::Impossible(reason.to_owned()), None, Vec::new());
        match state {
            State::Impossible(reason) => impossible(&reason),
            State::Different(difference) => (Replaying::Different(difference), before, decisions),
            State::Over => (Replaying::Same, before, decisions),
            State::UnderWay(replay) if replay.has_ended(stamp.order()) => {
                (Replaying::Same, before, decisions)
            }
            State::UnderWay(replay) if !replay.has_journal() => impossible(NO_JOURNAL),
            State::UnderWay(_) => impossible("the recording ends before the frame does"),
        }
    }

    /// What was decided does not count where the replay has failed.
    fn stop(&mut self, state: State) {
        (self.before, self.decisions, self.state) = (None, Vec::new(), state);
    }
}
