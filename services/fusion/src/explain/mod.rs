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
use crate::recorded::{Lost, Recorded};
use crate::replay::{NOT_REPLAYABLE, Replay, is_replayable};

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
    let mut replaying = Session::begin(&resolved, &recorded, target, stamp);
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
        let is_of_frame = gathered::stamp_of(&message).is_some_and(|of| of.is_same_frame(&stamp));
        replaying.on(message, utc_ns, is_of_frame, &gathered);
        if gathered.is_over() && gathered.later_frames() >= LOOK_AHEAD {
            break;
        }
    }
    let Session { before, decisions, state, .. } = replaying;
    let replay = match state {
        State::Impossible(reason) => Replaying::Impossible(reason),
        State::Different(difference) => Replaying::Different(difference),
        State::UnderWay(_) | State::Over if gathered.has_ended() => Replaying::Same,
        State::UnderWay(_) | State::Over => {
            Replaying::Impossible("the recording ends before the frame does".to_owned())
        }
    };
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
    fn begin(resolved: &Resolved, recorded: &Recorded, target: usize, stamp: FrameStamp) -> Self {
        let state = match is_replayable(resolved) {
            false => State::Impossible(NOT_REPLAYABLE.to_owned()),
            true => match Replay::new(resolved, recorded) {
                Err(error) => State::Impossible(format!("{error:#}")),
                Ok(mut replay) => {
                    replay.core().keep_account(target);
                    State::UnderWay(replay)
                }
            },
        };
        Self { target, stamp, state, before: None, decisions: Vec::new() }
    }

    /// Takes a message, until the frame is over and no answer to it is waited for.
    fn on(
        &mut self,
        message: crate::recorded::Message,
        utc_ns: u64,
        is_of_frame: bool,
        gathered: &Gathered,
    ) {
        let State::UnderWay(replay) = &mut self.state else { return };
        if is_of_frame && self.before.is_none() {
            let tracker = replay.core().tracker();
            let known = &tracker.targets()[self.target];
            let predicted = tracker.prediction(self.target, self.stamp.exposure_s());
            self.before = Some(Before {
                state: known.state(),
                predicted: predicted
                    .map(|found| (found.camera_from_markers, found.pose_covariance())),
            });
        }
        if let Err(error) = replay.on(message, utc_ns) {
            self.stop(State::Impossible(format!("{error:#}")));
            return;
        }
        let order: FrameOrder = self.stamp.order();
        let decided = replay.core().take_account();
        self.decisions
            .extend(decided.into_iter().filter(|(of, _)| *of == order).map(|(_, what)| what));
        let awaits = replay.core().tracker().has_background_of(order);
        if let Some(difference) = replay.difference().map(str::to_owned) {
            self.state = State::Different(difference);
        } else if gathered.is_over() && (!awaits || gathered.later_frames() >= ANSWER_FRAMES) {
            self.state = State::Over;
        }
    }

    /// What was decided does not count where the replay has failed.
    fn stop(&mut self, state: State) {
        (self.before, self.decisions, self.state) = (None, Vec::new(), state);
    }
}
