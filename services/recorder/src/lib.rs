//! The recorder: writes all messages of a running pipeline to MCAP files. It only subscribes, so
//! its failure affects no stage.
//!
//! It has two threads. One receives, so that no message is lost while the disk is slow. The other
//! encodes and writes. A bounded queue connects them.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`arguments`] | the command line |
//! | `message` | a received message |
//! | [`inputs`] | receives all topics of the contract, and detects losses |
//! | `queue` | the queue between the two threads |
//! | `core` | conversion of messages to recorded messages: no I/O |
//! | `about` | metadata of a recording |
//! | `ring` | the newest messages, for recordings of the time before an event |
//! | `files` | the files: begin, split and end |
//! | `jpeg` | JPEG encoding of frames |
//! | `loss_reports` | losses, in the log and in the recording |
//! | `stage` | the receiving thread |
//! | `writer` | the writing thread |

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

/// Runs the command line.
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
