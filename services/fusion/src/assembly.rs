//! Puts a frame together from what the stages say of it, in whatever order that comes.
//!
//! A frame is complete when rectification has ended it and every view it issued is acknowledged.
//! A stage that died would leave it open for ever: after a deadline it counts as complete too.
//! Frames leave in the order of their exposure.

use std::collections::BTreeMap;

use flockeye_contract::{DetectedMarker, DetectionHeader, FrameEnd, FrameStamp, ViewHeader};

/// Frames that may be open at once; beyond it the oldest is taken as it is.
const MAX_OPEN_FRAMES: usize = 8;

/// What a worker found in one view.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// What it says of the view.
    pub header: DetectionHeader,
    /// What it found.
    pub markers: Vec<DetectedMarker>,
}

/// Everything said of one frame, by the views' place in the plan.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Which frame.
    pub stamp: FrameStamp,
    /// The plan that was followed; 0: rectification swept on its own.
    pub plan_id: u64,
    /// The views that were seen passing.
    pub views: BTreeMap<u32, ViewHeader>,
    /// The views' records.
    pub records: BTreeMap<u32, Record>,
    /// How it ended, once it has.
    pub end: Option<FrameEnd>,
    deadline_ns: i64,
}

impl Frame {
    fn is_complete(&self) -> bool {
        self.end.is_some_and(|end| {
            self.records.range(..end.views_issued).count() == end.views_issued as usize
        })
    }
}

type Order = (u32, u32, u64);

/// The open frames.
#[derive(Debug)]
pub struct Assembly {
    deadline_ns: i64,
    open: BTreeMap<Order, Frame>,
    last_left: Option<Order>,
}

impl Assembly {
    /// None open yet; a frame stays open for `deadline_ns` at most.
    pub fn new(deadline_ns: i64) -> Self {
        Self { deadline_ns, open: BTreeMap::new(), last_left: None }
    }

    /// How many frames are open.
    pub fn open_frames(&self) -> usize {
        self.open.len()
    }

    /// The open frame of this stamp; `None` if it has left already.
    fn frame(&mut self, stamp: &FrameStamp, plan_id: u64, now_ns: i64) -> Option<&mut Frame> {
        let order = stamp.order();
        if self.last_left.is_some_and(|last| order <= last) {
            return None;
        }
        let deadline_ns = now_ns + self.deadline_ns;
        Some(self.open.entry(order).or_insert_with(|| Frame {
            stamp: *stamp,
            plan_id,
            views: BTreeMap::new(),
            records: BTreeMap::new(),
            end: None,
            deadline_ns,
        }))
    }

    /// A view was issued. False if its frame has left.
    pub fn add_view(&mut self, view: ViewHeader, now_ns: i64) -> bool {
        let Some(frame) = self.frame(&view.stamp, view.plan_id, now_ns) else { return false };
        frame.views.insert(view.view_index, view);
        true
    }

    /// A view was searched. False if nobody waits for it: its frame has left, or another worker
    /// has answered before.
    pub fn add_record(&mut self, record: Record, now_ns: i64) -> bool {
        let header = record.header;
        let Some(frame) = self.frame(&header.stamp, header.plan_id, now_ns) else { return false };
        match frame.records.entry(header.view_index) {
            std::collections::btree_map::Entry::Vacant(place) => {
                place.insert(record);
                true
            }
            std::collections::btree_map::Entry::Occupied(_) => false,
        }
    }

    /// Rectification is done with a frame.
    pub fn add_end(&mut self, end: FrameEnd, now_ns: i64) {
        if let Some(frame) = self.frame(&end.stamp, end.plan_id, now_ns) {
            frame.end = Some(end);
        }
    }

    /// The open frame of this stamp.
    pub fn open_frame(&self, stamp: &FrameStamp) -> Option<&Frame> {
        self.open.get(&stamp.order()).filter(|frame| frame.stamp.is_same_frame(stamp))
    }

    /// Takes the oldest frame out if it is complete, overdue, or one too many. The second value
    /// says whether it is complete.
    pub fn take(&mut self, now_ns: i64) -> Option<(Frame, bool)> {
        let entry = self.open.first_entry()?;
        let is_complete = entry.get().is_complete();
        let is_overdue = now_ns >= entry.get().deadline_ns;
        if !is_complete && !is_overdue && self.open.len() <= MAX_OPEN_FRAMES {
            return None;
        }
        let (order, frame) = self.open.pop_first()?;
        self.last_left = Some(order);
        Some((frame, is_complete))
    }

    /// When the oldest frame will be overdue.
    pub fn next_deadline_ns(&self) -> Option<i64> {
        self.open.first_key_value().map(|(_, frame)| frame.deadline_ns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stamp(sequence: u64) -> FrameStamp {
        FrameStamp { sequence, ..FrameStamp::default() }
    }

    fn record(sequence: u64, view_index: u32) -> Record {
        let header =
            DetectionHeader { stamp: stamp(sequence), view_index, ..DetectionHeader::default() };
        Record { header, markers: Vec::new() }
    }

    fn end(sequence: u64, views_issued: u32) -> FrameEnd {
        FrameEnd { stamp: stamp(sequence), views_issued, ..FrameEnd::default() }
    }

    #[test]
    fn a_frame_leaves_when_all_its_views_are_in() {
        let mut assembly = Assembly::new(1000);
        assert!(assembly.add_record(record(0, 1), 0));
        assembly.add_end(end(0, 2), 0);
        assert_eq!(assembly.take(1), None);
        assert!(assembly.add_record(record(0, 0), 2));
        assert!(!assembly.add_record(record(0, 0), 2), "a second answer counts for nothing");
        let (frame, is_complete) = assembly.take(2).expect("complete");
        assert!(is_complete && frame.records.len() == 2);
        assert!(!assembly.add_record(record(0, 5), 3), "the frame has left");
    }

    #[test]
    fn frames_leave_in_order() {
        let mut assembly = Assembly::new(1000);
        assembly.add_end(end(7, 1), 0);
        assembly.add_end(end(8, 0), 0);
        assert_eq!(assembly.take(1), None, "8 is complete but 7 is older");
        assembly.add_record(record(7, 0), 1);
        assert_eq!(assembly.take(1).expect("7").0.stamp.sequence, 7);
        assert_eq!(assembly.take(1).expect("8").0.stamp.sequence, 8);
    }

    #[test]
    fn a_dead_stage_holds_a_frame_only_to_its_deadline() {
        let mut assembly = Assembly::new(1000);
        assembly.add_record(record(0, 0), 5);
        assert_eq!(assembly.next_deadline_ns(), Some(1005));
        assert_eq!(assembly.take(1004), None);
        let (_, is_complete) = assembly.take(1005).expect("overdue");
        assert!(!is_complete);
    }

    #[test]
    fn a_flood_of_frames_is_bounded() {
        let mut assembly = Assembly::new(i64::MAX / 2);
        for sequence in 0..100 {
            assembly.add_record(record(sequence, 0), 0);
            while assembly.take(0).is_some() {}
            assert!(assembly.open.len() <= MAX_OPEN_FRAMES);
        }
    }
}
