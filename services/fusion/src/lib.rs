//! Stage: detections to tracks, and plans for where to look next.
//!
//! It receives views, detections, rotations and frame ends, and sends tracks and plans. Between
//! frames it keeps a filter for each target and a record of searches. The core is pure: its inputs
//! are events with their times, its outputs are messages. The stage around it moves messages.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`stage`] | moves messages between the ports, the core and the background pass |
//! | [`inbox`] | the ports that are read, and in which order |
//! | [`core`] | decides what is done next; the one place where a pose is published |
//! | [`journal`] | notes each call of the core for recorders, so that a flight can be repeated |
//! | [`frame`] | a frame as one value: its phase, views, records, and each target's part in it; all open frames |
//! | [`work`] | what is done next, in order of urgency |
//! | [`record`], [`pictures`] | the detections in a view; held views as images |
//! | [`planning`] | the plan for the next frame, and what was searched when |
//! | [`tracker`] | all targets; the one place where a measurement enters a track |
//! | [`target`] | one neighbour: its body and its track |
//! | [`track_prior`] | a track's prediction of a target before a frame measures it |
//! | [`measure`] | the measurement pass, with what differs between its kinds |
//! | [`aligner`] | tries poses: aligns bodies with pictures |
//! | [`hypothesis`] | poses that were tried |
//! | [`decide`] | all decisions about them |
//! | [`measurement`] | a measured pose, and corners as rays |
//! | [`account`] | the trials of one target with their decisions, for `flockeye explain` |
//! | [`schedule`] | when passes run, and how much time they have: by the clock or by stated costs |
//! | [`policy`] | which pass may run, and how thorough it may be |
//! | [`exposure`] | how long frames are exposed |
//! | [`parallax`] | rays of lenses that lie off the camera's centre |
//! | [`readout`] | rows that are exposed one after the other |
//! | [`output`] | tracks and plans as messages |
//! | [`refusal`], [`notices`] | impossible messages; notices to the operator |
//! | [`background_runner`] | where background passes run |
//! | [`parallel`] | a parallel map that keeps order |
//! | [`snapshot`], [`succession`] | the state that a process leaves to its successor, and its storage |
//! | [`settings`] | the core for a configuration |

mod account;
mod aligner;
mod background_runner;
mod core;
mod decide;
mod exposure;
mod frame;
mod hypothesis;
mod inbox;
mod journal;
mod measure;
mod measurement;
mod notices;
mod output;
mod parallax;
mod parallel;
mod pictures;
mod planning;
mod policy;
mod readout;
mod record;
mod refusal;
mod response;
mod schedule;
mod settings;
mod snapshot;
mod stage;
mod stitching;
mod succession;
mod target;
mod track_prior;
mod tracker;
mod twins;
mod work;

// For `flockeye-replay`: the core, its inputs and outputs, and the account of its decisions.
pub use self::account::{AccountEntry, NotRun, Pass, Trial};
pub use self::background_runner::BackgroundRunner;
pub use self::core::{Core, Event, Outputs};
pub use self::decide::outcome::Outcome;
pub use self::decide::{Decision, PoseIndex, Verdict};
pub use self::hypothesis::{CornerPose, CornerVerdict, Hypothesis, StartSource};
pub use self::journal::{Journal, entry_of};
pub use self::measurement::{PoseMeasurement, Shown, decoded_rays};
pub use self::output::Writer;
pub use self::policy::TimeBudget;
pub use self::record::Record;
pub use self::settings::configured;
pub use self::track_prior::TrackPrior;

// For benchmarks.
pub use self::aligner::{Aligner, Sought, Start};
pub use self::decide::{of_tracked, turn_log};

#[cfg(test)]
#[path = "../../../common/imaging/tests/drawn_body/mod.rs"]
mod drawn_body;
#[cfg(test)]
mod fixtures;

/// Entry point of the fusion process, in the library so that it is compiled once.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::FusionStage>()
}
