//! Shared parts of the command lines of `flockeye` and of the programs that run some of its
//! commands.
//!
//! | module | what it holds |
//! | --- | --- |
//! | [`arguments`] | the arguments that choose a configuration, and durations |
//! | [`dated`] | file names that contain a time |
//! | [`lab`] | the commands that `flockeye` passes on to `flockeye-lab` |
//! | [`program`] | paths of those programs |
//! | [`replay`] | the commands that `flockeye` passes on to `flockeye-replay` |
//! | [`running`] | choice of a running pipeline, and access to its messages |
//! | [`screen`] | the terminal: log lines above, a live table below |
//! | [`signals`] | a flag that Ctrl-C raises |
//! | [`text_table`] | tables of plain text |
//! | [`workshop`] | the commands that `flockeye` passes on to `flockeye-workshop` |

pub mod arguments;
pub mod dated;
pub mod lab;
pub mod program;
pub mod replay;
pub mod running;
pub mod screen;
pub mod signals;
pub mod text_table;
pub mod workshop;

pub use arguments::{Configuration, duration};
pub use screen::Screen;
