//! The view: a page in the browser that shows what a running pipeline sees, or what a recorded one
//! saw. `flockeye view` starts it.
//!
//! It is an onlooker: it reads messages beside the stages, and nobody waits for it. While no page
//! is open it reads nothing. Pictures are encoded at a limited rate, and only for pages that want
//! them. docs/RECORDING.md has what the page and this process say to each other.
//!
//! | module | what it does |
//! | --- | --- |
//! | `wire` | the messages to the page |
//! | `scene` | core: messages of the contract in, messages to the page out |
//! | `held` | core: which frame a picture is made of |
//! | `recorded` | the same of a recording, at any time of it |
//! | `remote` | core: what a page asks the player of its recording for |
//! | `outbox` | core: what waits for one page, bounded, the oldest dropped |
//! | `request` | core: what a browser asks for, and who may |
//! | `setting` | what a page must know once: camera, tiles, bodies |
//! | `picture` | a frame as an equirectangular JPEG |
//! | `closeup` | a neighbour as alignment sees it |
//! | `foxglove_view` | the same scene for Foxglove and Lichtblick |
//! | `explaining` | why this pose, or why none |
//! | `files` | the page itself |
//! | `pages` | all open pages |
//! | `server` | the sockets |
//! | `connection` | one page's socket |
//! | `audience` | all who watch |
//! | `watch` | the ports |
//! | `frame_reader` | the port of frames, while pictures are wanted |
//! | `program` | the command line |

mod audience;
mod closeup;
mod connection;
mod explaining;
mod files;
mod foxglove_view;
mod frame_reader;
mod held;
mod outbox;
mod pages;
mod picture;
pub mod program;
mod recorded;
mod remote;
mod request;
mod scene;
mod server;
mod setting;
mod watch;
mod wire;
