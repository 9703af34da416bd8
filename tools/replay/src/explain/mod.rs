//! `flockeye explain`: explains why a frame of a recording gave this pose of a neighbour, or none.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`asked`] | the command line |
//! | [`frames`] | lists the frames of a recording, and finds the requested one |
//! | [`gathered`] | messages of the stages about that frame |
//! | [`session`] | replays fusion up to that frame |
//! | [`known`] | the known facts about the frame |
//! | [`explanation`] | the answer, as data |
//! | [`poses`] | poses of the target: predicted, measured, likeliest |
//! | [`facts`] | makes the answer from the known facts |
//! | [`passes`] | the decisions of fusion as data |
//! | [`judgement`] | the step that decided the result, as a sentence |
//! | [`text`], [`picture`] | the answer as text, and as a picture |

pub(crate) mod asked;
mod explanation;
mod facts;
mod frames;
mod gathered;
mod judgement;
mod known;
mod passes;
mod picture;
mod poses;
mod session;
mod text;

#[cfg(test)]
mod tests;

use std::path::Path;

use anyhow::{Context as _, bail};
use flockeye_config::Resolved;

use self::asked::{ExplainArguments, When};
use self::frames::FrameList;
use self::gathered::StageMessages;
use self::known::FrameKnowledge;
use self::session::Session;
use crate::recorded::RecordedFlight;

/// Number of frames after the explained one in which its next search is looked for.
const LOOK_AHEAD: usize = 60;

/// Prints the answer, and draws the picture if requested.
pub(crate) fn main(arguments: &ExplainArguments) -> anyhow::Result<()> {
    let when = arguments.when()?;
    let (resolved, known) = look(&arguments.file, &arguments.target, when)?;
    let explanation = facts::explanation(&arguments.file, &resolved, &known);
    match arguments.json {
        true => println!("{}", serde_json::to_string_pretty(&explanation)?),
        false => print!("{}", text::of(&explanation)),
    }
    // The answer was printed already, also if the picture cannot be drawn.
    match &arguments.image {
        Some(path) => picture::write(path, &resolved, &known, &explanation),
        None => Ok(()),
    }
}

/// Reads the facts about a target in a frame from a recording.
fn look(path: &Path, name: &str, when: When) -> anyhow::Result<(Resolved, FrameKnowledge)> {
    let mut recorded = RecordedFlight::open(path)?;
    let resolved = recorded.configuration()?;
    let names: Vec<&str> = resolved.bodies.iter().map(|body| body.name.as_str()).collect();
    let Some(target) = names.iter().position(|known| *known == name) else {
        bail!("{} has no body '{name}'. It has {}", path.display(), names.join(", "));
    };
    let frames = FrameList::of(path).with_context(|| path.display().to_string())?;
    let (stamp, at_s) = frames.chosen(when)?;
    let mut gathered = StageMessages::of(stamp, target as u32);
    let mut replaying = Session::begin(&resolved, target, stamp);
    loop {
        let (message, utc_ns) = match recorded.next_message() {
            Ok(Some(read)) => read,
            Ok(None) => break,
            // Messages before the damage are used.
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
    Ok((
        resolved,
        FrameKnowledge { target, stamp, at_s, gathered, before, decisions, replay, lost },
    ))
}
