//! Recordings: MCAP files of all messages of a pipeline, which the tools of ROS 2 and Foxglove
//! read.
//!
//! Each topic of the contract is a channel. Its messages are ROS 2 messages whose definitions
//! follow from the contract's own description, and stand in the file. CDR keeps every bit of every
//! number, so the message of the contract is read back byte by byte.
//!
//! | module | what it has |
//! | --- | --- |
//! | [`layout`] | where each field of a topic's messages lies |
//! | [`message`] | a message of the contract as a ROS 2 message, and back |
//! | [`definition`] | the messages' definitions, as ROS 2 writes them |
//! | [`images`] | pictures and video |
//! | [`poses`] | neighbours' poses and transforms |
//! | [`channel`] | the channels of a recording |
//! | [`file`](mod@file) | a file that keeps what is whole, also where the disk is full |
//! | [`writer`] | writes a recording |
//! | [`reader`] | reads one, also one that was not ended |
//! | `parts` | goes on with the next file of one that was split |
//! | [`indexed`] | reads one from any place on |
//! | [`losses`] | what a recording says that it lacks |
//! | [`recover`](mod@recover) | makes a whole recording of a broken one |
//! | [`error`] | what can go wrong, and the cure |
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
