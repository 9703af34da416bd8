//! Rules on which pass may run for a target in a frame, and on its thoroughness.

/// Time budget for the measurement of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TimeBudget {
    /// Unlimited: every pass runs for every frame, and none waits in the background.
    Unlimited,
    /// Until the next frame comes.
    OneFrame,
    /// The budget is spent: newer frames wait already.
    Overspent,
}

/// Number of frames for which a target's direct pass is suspended after markers contradicted its
/// pose.
pub(crate) const SUSPENDED_FRAMES: u64 = 15;

/// Period in frames at which targets of the direct pass are searched for markers too, for
/// comparison. A search costs four times as much as the direct pass.
pub(crate) const MARKERS_EVERY_FRAMES: u32 = 4;
