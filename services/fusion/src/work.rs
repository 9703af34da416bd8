//! The next work of fusion, as data.

use flockeye_contract::FrameOrder;

/// A piece of work, in the order of its urgency: the most urgent is the least. If two pieces are
/// equally urgent, the frame with the earlier exposure comes first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Work {
    /// Make the first plan. It starts the flow: rectification has a plan to follow, and a lossless
    /// source its first credit.
    OpenFlow,
    /// Measure tracked targets in regions of interest that have been cut, from their predictions
    /// alone.
    MeasureRegions {
        /// Arrival of the first of them, as a count of regions.
        arrival: u64,
        order: FrameOrder,
    },
    /// Measure targets whose regions of interest have been searched for markers.
    MeasureRecords { order: FrameOrder },
    /// Handle the result of a background pass.
    TakeAnswer,
    /// Measure the rest of a complete frame.
    MeasureFrame { order: FrameOrder },
    /// Search for an untracked target at some places of a measured frame, or end the frame if none
    /// are left.
    SearchPlaces { order: FrameOrder },
    /// Complete a frame that awaits no more messages.
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
