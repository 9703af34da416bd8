//! What fusion does next, as data.

use flockeye_contract::FrameOrder;

/// A piece of work, in the order of its urgency: what is due first is the least. Of two alike, the
/// frame that was exposed first has it first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Work {
    /// Make the first plan. It opens the flow: rectification has something to follow, and a
    /// lossless source its first credit.
    OpenFlow,
    /// Measure tracked targets in regions of interest that have been cut, from their predictions
    /// alone.
    MeasureRegions {
        /// When the first of them came, as a count of regions.
        arrival: u64,
        order: FrameOrder,
    },
    /// Measure targets whose regions of interest have been searched for markers.
    MeasureRecords { order: FrameOrder },
    /// Take in what a background pass has found.
    TakeAnswer,
    /// Measure all that is left in a complete frame.
    MeasureFrame { order: FrameOrder },
    /// Look for an untracked target at some places of a measured frame, or end the frame where none
    /// are left.
    SearchPlaces { order: FrameOrder },
    /// Complete a frame for which nothing more is waited.
    CompleteFrame {
        order: FrameOrder,
        /// Whether something is missing: its deadline has passed, or too many frames are open.
        is_overdue: bool,
    },
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pose_that_can_leave_is_more_urgent_than_a_frame_that_can_end() {
        let (older, newer) = ((0, 0, 1), (0, 0, 2));
        let in_order = [
            Work::OpenFlow,
            Work::MeasureRegions { arrival: 7, order: newer },
            Work::MeasureRegions { arrival: 8, order: older },
            Work::MeasureRecords { order: older },
            Work::MeasureRecords { order: newer },
            Work::TakeAnswer,
            Work::MeasureFrame { order: older },
            Work::SearchPlaces { order: older },
            Work::CompleteFrame { order: older, is_overdue: true },
        ];
        assert!(in_order.is_sorted());
    }
}
