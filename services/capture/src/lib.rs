//! Sources of frames: a camera, a video file, a folder of images or a recorded flight, read through
//! GStreamer.
//!
//! A [`FrameSource`] hands out luma planes directly from the decoder's memory. Markers need no
//! colour, so formats with a luma plane are not converted:
//!
//! ```no_run
//! use std::time::Duration;
//! use flockeye_capture::{Event, FrameSource, SourceParameters, SourceSpec};
//!
//! # fn main() -> Result<(), flockeye_capture::CaptureError> {
//! let spec: SourceSpec = "flight.mp4".parse()?;
//! let mut source = FrameSource::open(spec, SourceParameters::new(3840, 1920))?;
//! println!("{}", source.describe());
//! loop {
//!     match source.next(Duration::from_millis(100))? {
//!         Event::Frame(picture) => {
//!             println!("{}: {} bytes", picture.sequence(), picture.luma().len());
//!         }
//!         Event::Idle => {}
//!         Event::Looped { .. } | Event::NewEpoch => println!("it begins anew"),
//!         Event::Lost { reason, retry_in } => println!("{reason}; trying again in {retry_in:?}"),
//!         Event::Late { what } => println!("{what}"),
//!         Event::Skipped { what, why } => println!("{what} skipped: {why}"),
//!         Event::End(reason) => break println!("{reason}"),
//!     }
//! }
//! # Ok(())
//! # }
//! ```
//!
//! Threads: GStreamer decodes in its own threads and puts each frame into a mailbox;
//! [`FrameSource::next`] takes from it. In [`Flow::Latest`](flockeye_config::Flow) a new frame
//! replaces a waiting one; in `Flow::Lossless` the decoder waits until there is room.

mod arrivals;
mod byte_stream;
mod census;
pub mod core;
mod decoder;
mod error;
mod event;
mod examine;
mod explain;
mod file;
mod folder;
mod holding;
mod inertial;
mod input;
mod late_frames;
mod mailbox;
mod packet_port;
mod packet_tap;
mod parameters;
mod picture;
mod pipeline;
mod playback;
mod recorded_flight;
mod source;
mod source_reports;
mod spec;
mod stage;

pub use error::CaptureError;
pub use event::{EndReason, Event};
pub use packet_tap::Packet;
pub use parameters::SourceParameters;
pub use picture::SourcePicture;
pub use source::FrameSource;
pub use spec::SourceSpec;

/// The capture stage's process. It is part of the library, so that it is compiled once.
pub fn main() -> std::process::ExitCode {
    flockeye_runtime::stage::main::<stage::CaptureStage>()
}
