//! Replacing the process of a stage in flight, so that no frame is lost.
//!
//! A stage that owns no device runs twice for a while. The new process starts in the *shadow* of
//! the old one. It receives all messages, and only the launcher uses its answers: it compares them
//! with the old process's. When they are as good, it *takes over* at a frame that is announced
//! before its exposure. The old process stays beside it for the first frames of this *probation*,
//! so that the hand-over can be taken back. The generation in each message identifies its process
//! ([`HandOver`](flockeye_contract::HandOver)).
//!
//! A stage that owns a device cannot run twice: its old process ends first.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`changeover`] | state of a swap |
//! | [`shadow`] | receives the messages of both processes |
//! | [`comparison`] | compares them, and finds shortcomings |
//! | [`judge`] | decides when the new process takes over, stays or goes |
//! | [`replacement`] | decides whether a process works that was started after the old one's end |
//! | [`verdict`] | next step of a swap |

pub(crate) mod changeover;
pub(crate) mod comparison;
pub(crate) mod judge;
pub(crate) mod replacement;
pub(crate) mod shadow;
pub(crate) mod verdict;
