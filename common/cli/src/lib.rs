//! What the command lines of `flockeye` and of the programs that do some of its commands share.
//!
//! | module | what it holds |
//! | --- | --- |
//! | [`arguments`] | the arguments that choose a configuration, and durations |
//! | [`dated`] | names of files that say when they were begun |
//! | [`lab`] | the commands that `flockeye` passes on to `flockeye-lab` |
//! | [`program`] | where those programs are |
//! | [`replay`] | the commands that `flockeye` passes on to `flockeye-replay` |
//! | [`running`] | which of the running pipelines is meant, and its messages |
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
