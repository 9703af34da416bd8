//! Puts a frame together from what the stages say of it, in whatever order that comes.
//!
//! A frame is complete when rectification has ended it and every view it issued is acknowledged.
//! A stage that died would leave it open for ever: after a deadline it leaves as it is. So does, as soon
//! as a newer one is complete, a frame that follows no plan of this process: it was under way when the
//! process began, which never hears what was said of it before. Frames leave in the order of their
//! exposure.

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

/// Why a frame left.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Leave {
    /// All was said of it.
    Complete,
    /// Its deadline has passed, or too many are open.
    Overdue,
    /// It was under way when this process began.
    HalfHeard,
}

/// The open frames.
#[derive(Debug)]
pub struct FrameAssembly {
    deadline_ns: i64,
    open: BTreeMap<Order, Frame>,
    last_left: Option<Order>,
    /// The newest plan of this process; 0 before the first.
    plan_id: u64,
}

impl FrameAssembly {
    /// None open yet; a frame stays open for `deadline_ns` at most.
    pub fn new(deadline_ns: i64) -> Self {
        Self { deadline_ns, open: BTreeMap::new(), last_left: None, plan_id: 0 }
    }

    /// This process made a plan; they are numbered from 1.
    pub fn planned(&mut self, plan_id: u64) {
        self.plan_id = plan_id;
    }

    /// The last frame that has left.
    pub fn last_left(&self) -> Option<Order> {
        self.last_left
    }

    /// Takes this frame, and all before it, as left: another process has ended them.
    pub fn begin_after(&mut self, left: Option<Order>) {
        self.last_left = self.last_left.max(left);
    }

    /// How many frames are open.
    pub fn open_frames(&self) -> usize {
        self.open.len()
    }

    /// Whether a frame has left, or one behind it.
    pub fn has_left(&self, stamp: &FrameStamp) -> bool {
        self.last_left.is_some_and(|last| stamp.order() <= last)
    }

    /// The open frame of this stamp; `None` if it has left already.
    fn frame(&mut self, stamp: &FrameStamp, plan_id: u64, now_ns: i64) -> Option<&mut Frame> {
        let order = stamp.order();
        if self.has_left(stamp) {
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

    /// The open frame in this place.
    pub fn of_order(&self, order: Order) -> Option<&Frame> {
        self.open.get(&order)
    }

    /// The open frame of this stamp.
    pub fn open_frame(&self, stamp: &FrameStamp) -> Option<&Frame> {
        self.open.get(&stamp.order()).filter(|frame| frame.stamp.is_same_frame(stamp))
    }

    /// Takes the oldest frame out if nothing more is to be waited for.
    pub fn take(&mut self, now_ns: i64) -> Option<(Frame, Leave)> {
        let (_, oldest) = self.open.first_key_value()?;
        let leave = if oldest.is_complete() {
            Leave::Complete
        } else if now_ns >= oldest.deadline_ns || self.open.len() > MAX_OPEN_FRAMES {
            Leave::Overdue
        } else if !(1..=self.plan_id).contains(&oldest.plan_id)
            && self.open.values().any(Frame::is_complete)
        {
            Leave::HalfHeard
        } else {
            return None;
        };
        let (order, frame) = self.open.pop_first()?;
        self.last_left = Some(order);
        Some((frame, leave))
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
        let header = DetectionHeader {
            stamp: stamp(sequence),
            plan_id: 1,
            view_index,
            ..DetectionHeader::default()
        };
        Record { header, markers: Vec::new() }
    }

    fn end(sequence: u64, views_issued: u32) -> FrameEnd {
        FrameEnd { stamp: stamp(sequence), plan_id: 1, views_issued, ..FrameEnd::default() }
    }

    fn planned(deadline_ns: i64) -> FrameAssembly {
        let mut assembly = FrameAssembly::new(deadline_ns);
        assembly.planned(1);
        assembly
    }

    #[test]
    fn a_frame_leaves_when_all_its_views_are_in() {
        let mut assembly = planned(1000);
        assert!(assembly.add_record(record(0, 1), 0));
        assembly.add_end(end(0, 2), 0);
        assert_eq!(assembly.take(1), None);
        assert!(assembly.add_record(record(0, 0), 2));
        assert!(!assembly.add_record(record(0, 0), 2), "a second answer counts for nothing");
        let (frame, leave) = assembly.take(2).expect("complete");
        assert_eq!((leave, frame.records.len()), (Leave::Complete, 2));
        assert!(!assembly.add_record(record(0, 5), 3), "the frame has left");
    }

    #[test]
    fn frames_leave_in_order() {
        let mut assembly = planned(1000);
        assembly.add_end(end(7, 1), 0);
        assembly.add_end(end(8, 0), 0);
        assert_eq!(assembly.take(1), None, "8 is complete but 7 is older");
        assembly.add_record(record(7, 0), 1);
        assert_eq!(assembly.take(1).expect("7").0.stamp.sequence, 7);
        assert_eq!(assembly.take(1).expect("8").0.stamp.sequence, 8);
    }

    #[test]
    fn a_dead_stage_holds_a_frame_only_to_its_deadline() {
        let mut assembly = planned(1000);
        assembly.add_record(record(0, 0), 5);
        assert_eq!(assembly.next_deadline_ns(), Some(1005));
        assert_eq!(assembly.take(1004), None);
        assert_eq!(assembly.take(1005).expect("overdue").1, Leave::Overdue);
    }

    #[test]
    fn what_was_said_before_this_process_began_is_not_waited_for() {
        let mut assembly = planned(1000);
        let of_predecessor = |mut record: Record| {
            record.header.plan_id = 24;
            record
        };
        assert!(assembly.add_record(of_predecessor(record(6, 3)), 0));
        assembly.add_end(FrameEnd { plan_id: 24, ..end(6, 4) }, 0);
        assert!(assembly.add_record(record(7, 0), 1));
        assert_eq!(assembly.take(2), None, "its records may still come");
        assembly.add_end(end(7, 1), 3);
        let left = [(); 2].map(|()| assembly.take(4).expect("both leave"));
        let left = left.map(|(frame, leave)| (frame.stamp.sequence, leave));
        assert_eq!(left, [(6, Leave::HalfHeard), (7, Leave::Complete)]);
        // What follows its own plan is waited for, whoever else is complete.
        assert!(assembly.add_record(record(8, 1), 5));
        assembly.add_end(end(8, 2), 5);
        assembly.add_end(end(9, 0), 5);
        assert_eq!(assembly.take(6), None);
    }

    #[test]
    fn a_flood_of_frames_is_bounded() {
        let mut assembly = planned(i64::MAX / 2);
        for sequence in 0..100 {
            assembly.add_record(record(sequence, 0), 0);
            while assembly.take(0).is_some() {}
            assert!(assembly.open.len() <= MAX_OPEN_FRAMES);
        }
    }
}
