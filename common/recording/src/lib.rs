//! Recordings: MCAP files with all messages of a pipeline. The tools of ROS 2 and Foxglove can read
//! them.
//!
//! Each topic of the contract is a channel. Its messages are ROS 2 messages. The file contains
//! their definitions, which follow from the contract's own description. CDR keeps every bit of
//! every number, so a message of the contract is read back byte by byte.
//!
//! | module | content |
//! | --- | --- |
//! | [`layout`] | positions of the fields in a topic's messages |
//! | [`message`] | a message of the contract as a ROS 2 message, and back |
//! | [`definition`] | message definitions in the form of ROS 2 |
//! | [`images`] | pictures and video |
//! | [`poses`] | neighbours' poses and transforms |
//! | [`channel`] | the channels of a recording |
//! | [`file`](mod@file) | a file of whole records, even if the disk is full |
//! | [`writer`] | writes a recording |
//! | [`reader`] | reads a recording in order, also an incomplete one |
//! | `parts` | the next file of a split recording |
//! | [`indexed`] | random access to a recording |
//! | [`losses`] | messages that are missing in a recording |
//! | [`recover`](mod@recover) | makes a whole recording from a damaged one |
//! | [`error`] | errors and their cures |
//!
//! `docs/RECORDING.md` describes the files for their users.

mod cdr;
mod chunk;
mod parts;

pub mod channel;
pub mod definition;
pub mod error;
pub mod file;
pub mod images;
pub mod indexed;
pub mod layout;
pub mod losses;
pub mod message;
pub mod poses;
pub mod reader;
pub mod recover;
pub mod writer;

pub use channel::ChannelKind;
pub use error::RecordingError;
pub use indexed::{ChunkPlace, IndexedMessage, IndexedRecording};
pub use layout::{TopicLayout, layouts};
pub use message::ContractMessage;
pub use reader::{Ending, RecordedMessage, RecordingReader};
pub use writer::{About, RecordingWriter};
