//! The view: a page in the browser that shows a running pipeline or a recorded one. `flockeye view`
//! starts it.
//!
//! It is an onlooker: it reads messages beside the stages, and no stage waits for it. While no page
//! is open it reads nothing. Pictures are encoded at a limited rate, and only on request.
//! docs/RECORDING.md describes the messages between the page and this process.
//!
//! | module | what it does |
//! | --- | --- |
//! | `wire` | the messages to the page |
//! | `scene` | core: messages of the contract in, messages to the page out |
//! | `held` | core: the frame from which the next picture is made |
//! | `recorded` | the scene of a recording, at any time of it |
//! | `remote` | core: requests of a page to the player of its recording |
//! | `outbox` | core: messages that wait for one page, bounded, the oldest dropped |
//! | `request` | core: HTTP requests of a browser, and which are allowed |
//! | `setting` | the page's first message: camera, tiles, bodies |
//! | `picture` | a frame as an equirectangular JPEG |
//! | `closeup` | a neighbour as in alignment |
//! | `foxglove_view` | the same scene for Foxglove and Lichtblick |
//! | `explaining` | the explanation of a pose, or of a missing one |
//! | `files` | the page itself |
//! | `pages` | all open pages |
//! | `server` | the sockets |
//! | `connection` | one page's socket |
//! | `audience` | pages and Foxglove's clients together |
//! | `watch` | the ports |
//! | `frame_reader` | the port of frames, while pictures are requested |
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
