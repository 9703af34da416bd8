//! Replacing the process of a stage in flight, so that no frame is lost.
//!
//! A stage that owns no device runs twice for a while. The new process starts in the *shadow* of
//! the old one: it gets all messages, and nobody listens to it but the launcher, which compares its
//! answers with the old one's. When it does as well, it *takes over* at a frame that everybody
//! knows before it is exposed. The old process stays beside it for the first frames of this
//! *probation*, so that the hand-over can be taken back. Messages say by their generation which
//! process has sent them ([`HandOver`](flockeye_contract::HandOver)).
//!
//! A stage that owns a device cannot run twice: its old process ends first.
//!
//! | module | what it does |
//! | --- | --- |
//! | [`changeover`] | what a swap is doing |
//! | [`shadow`] | reads what both processes send |
//! | [`comparison`] | compares it, and finds what is worse |
//! | [`judge`] | decides when the new process takes over, stays or goes |
//! | [`replacement`] | decides whether a process works that was started after the old one's end |
//! | [`verdict`] | what is to be done about a swap |

pub(crate) mod changeover;
pub(crate) mod comparison;
pub(crate) mod judge;
pub(crate) mod replacement;
pub(crate) mod shadow;
pub(crate) mod verdict;
