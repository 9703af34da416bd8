//! The recorder: writes all messages of a running pipeline to MCAP files. It looks on, so it can
//! die without harm to any stage.
//!
//! Two threads share the work. One receives, so that no message is lost while the disk is slow. The
//! other makes the recording of what was received, and writes it. Between them is a queue of
//! bounded size.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`arguments`] | the command line |
//! | `message` | a message as it was received, and what it means for the recording: pure |
//! | [`inputs`] | receives every topic of the contract, and notices what was lost |
//! | `queue` | from the thread that receives to the one that writes |
//! | `core` | what of a message is recorded: pure |
//! | `about` | the facts about a pipeline that stand in its recording |
//! | `ring` | the newest messages, for recordings of what led to something |
//! | `files` | the files: begun, split, ended |
//! | `jpeg` | frames as pictures |
//! | `loss_reports` | what is missing, in the log and in the recording |
//! | `stage` | the thread that receives |
//! | `writer` | the thread that writes |

#![warn(unreachable_pub)]

mod about;
pub mod arguments;
mod core;
mod files;
pub mod inputs;
mod jpeg;
mod loss_reports;
mod message;
mod queue;
mod ring;
mod stage;
mod writer;

use anyhow::{Context, ensure};
use clap::Parser;
use flockeye_cli::{Screen, running};
use flockeye_recording::recover::recover;
use flockeye_runtime::recorders;

use crate::arguments::RecordArguments;

/// Does what the command line asks for.
///
/// # Errors
/// No such pipeline runs, a file cannot be written, or the disk is full.
pub fn run() -> anyhow::Result<()> {
    let arguments = RecordArguments::parse();
    if arguments.now {
        let instance = running::choose(&arguments.running)?;
        let asked = recorders::ask_to_write(&instance);
        ensure!(
            asked > 0,
            "no recorder of the pipeline '{}' keeps the past. Cure: `flockeye record OUT.mcap --trigger request`",
            instance.name()
        );
        Screen::new().line(&format!("asked to write what came before: {asked}"));
        return Ok(());
    }
    let out = arguments.out.as_deref().context("no file to write to. Cure: name one")?;
    if let Some(broken) = &arguments.recover {
        let recovered = recover(broken, out)?;
        let ending = match (&recovered.damage, recovered.was_whole) {
            (Some(damage), _) => format!("; {damage}"),
            (None, true) => "; nothing was wrong with it".to_owned(),
            (None, false) => "; it had been cut off".to_owned(),
        };
        let messages = recovered.messages;
        Screen::new().line(&format!("{messages} messages are in {}{ending}", out.display()));
        return Ok(());
    }
    stage::record(&arguments, out)
}
