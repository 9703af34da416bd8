//! Stage: detections to tracks, and plans for where to look next.
//!
//! It takes views, detections and frame ends; it gives tracks and plans. Between frames it keeps a
//! filter for each target and what was searched when. The core is pure: events with their times go
//! in, messages come out. The stage around it moves messages.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`stage`] | moves messages between the ports, the core and the background pass |
//! | [`inbox`] | the ports that are read, and in which order |
//! | [`core`] | decides what is done next; the one place where a pose leaves |
//! | [`journal`] | notes each call of the core for recorders, so that a flight can be repeated |
//! | [`frame`] | a frame as one value: its phase, views, records, and each target's part in it; all open frames |
//! | [`work`] | what is done next, in order of urgency |
//! | [`record`], [`pictures`] | what was found in a view; held views as images |
//! | [`planning`] | the plan for the next frame, and what was searched when |
//! | [`tracker`] | all targets; the one place where a measurement enters a track |
//! | [`target`] | one neighbour: its body and its track |
//! | [`track_prior`] | what a track says of a target before a frame measures it |
//! | [`measure`] | the measurement pass, with a table of what differs between its kinds |
//! | [`hypothesis`] | poses with their evidence, and the decision |
//! | [`measurement`] | a measured pose, and corners as rays |
//! | [`account`] | what was decided of one target, and why |
//! | [`schedule`] | when passes run, and how much time they have: by the clock or by stated costs |
//! | [`policy`] | which pass may run, and how thorough it may be |
//! | [`exposure`] | how long frames are exposed |
//! | [`parallax`] | rays of lenses that lie off the camera's centre |
//! | [`readout`] | rows that are exposed one after the other |
//! | [`output`] | tracks and plans as messages |
//! | [`refusal`], [`notices`] | messages that cannot be true; what a person should know of |
//! | [`background_runner`] | where background passes run |
//! | [`parallel`] | a parallel map that keeps order |
//! | [`snapshot`], [`succession`] | what a process leaves to its successor, and where it is kept |
//! | [`recorded`] | a recording as the messages that fusion got and gave |
//! | [`replay`] | the core again as a journal says, compared with what it gave |
//! | [`explain`] | why a frame of a recording gave a pose of a target, or none |
//! | [`settings`] | the core as the configuration asks for it |

pub mod account;
pub mod background_runner;
pub mod core;
pub mod explain;
pub mod exposure;
pub mod frame;
pub mod hypothesis;
pub mod inbox;
pub mod journal;
pub mod measure;
pub mod measurement;
pub mod notices;
pub mod output;
pub mod parallax;
pub mod parallel;
pub mod pictures;
pub mod planning;
pub mod policy;
pub mod readout;
pub mod record;
pub mod recorded;
pub mod refusal;
pub mod replay;
pub mod schedule;
pub mod settings;
pub mod snapshot;
pub mod stage;
pub mod succession;
pub mod target;
pub mod track_prior;
pub mod tracker;
pub mod work;

#[cfg(test)]
#[path = "../../../common/imaging/tests/drawn_body/mod.rs"]
mod drawn_body;
#[cfg(test)]
mod fixtures;

/// The fusion stage's process. It is here so that it is compiled once, with the library.
pub fn main() -> std::process::ExitCode {
    let arguments: Vec<_> = std::env::args_os().skip(1).collect();
    match &arguments[..] {
        [word, file] if word == "replay" => replay_main(file.as_ref()),
        [word, ..] if word == "explain" => explain_main(&arguments),
        _ => flockeye_runtime::stage::main::<stage::FusionStage>(),
    }
}

/// `flockeye-fusion explain ...`, which `flockeye explain` becomes. The first argument stands for
/// the program.
fn explain_main(arguments: &[std::ffi::OsString]) -> std::process::ExitCode {
    flockeye_runtime::logs::init();
    let asked = <explain::asked::ExplainArguments as clap::Parser>::parse_from(arguments);
    match explain::main(&asked) {
        Ok(()) => std::process::ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("flockeye explain: {error:#}");
            std::process::ExitCode::FAILURE
        }
    }
}

/// `flockeye-fusion replay FILE`, which `flockeye replay` becomes: fails unless all is the same.
fn replay_main(file: &std::path::Path) -> std::process::ExitCode {
    flockeye_runtime::logs::init();
    match replay::report(file) {
        Ok(true) => std::process::ExitCode::SUCCESS,
        Ok(false) => std::process::ExitCode::FAILURE,
        Err(error) => {
            eprintln!("flockeye replay: {error:#}");
            std::process::ExitCode::FAILURE
        }
    }
}
