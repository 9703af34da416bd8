//! Messages of the stages about one frame, and the last ones about one target before it.

use std::collections::{BTreeMap, BTreeSet};

use flockeye_contract::{
    BodyTruth, FrameEnd, FrameOrder, FrameStamp, MeasuredBy, PlanHeader, PlannedView, Track,
    TruthHeader, ViewHeader,
};

use crate::recorded::{FlightMessage, RecordedPixels};
use flockeye_fusion::Record;

/// Number of plans that are kept for frames that still follow them.
const PLANS: usize = 16;

/// Messages about a frame.
#[derive(Debug)]
pub(super) struct StageMessages {
    stamp: FrameStamp,
    target: u32,
    plans: BTreeMap<u64, (PlanHeader, Vec<PlannedView>)>,
    /// Views of the frame by their index in the plan, with their pixels if recorded.
    pub views: BTreeMap<u32, (ViewHeader, Option<RecordedPixels>)>,
    /// Detection records of the views.
    pub records: BTreeMap<u32, Record>,
    pub end: Option<FrameEnd>,
    /// Tracks that fusion sent for the frame, in their order.
    pub tracks: Vec<Track>,
    /// Whether fusion has sent the last message about the frame.
    has_last: bool,
    /// The truth from a simulated source.
    pub truth: Option<(TruthHeader, Vec<BodyTruth>)>,
    /// The last track of the target in an earlier frame, and that frame.
    pub before: Option<(FrameStamp, Track)>,
    /// The last earlier frame that measured the target, and the method.
    pub measured_before: Option<(FrameStamp, MeasuredBy)>,
    /// Views of later frames.
    pub later: Vec<ViewHeader>,
    later_frames: BTreeSet<FrameOrder>,
}

/// The frame of a message.
pub(super) fn stamp_of(message: &FlightMessage) -> Option<FrameStamp> {
    match message {
        FlightMessage::Frame(header) => Some(header.stamp),
        FlightMessage::Header(header) | FlightMessage::View(header, _) => Some(header.stamp),
        FlightMessage::Searched(record) => Some(record.header.stamp),
        FlightMessage::FrameEnd(end) => Some(end.stamp),
        FlightMessage::Rotation(rotation) => Some(rotation.stamp),
        FlightMessage::Tracks(header, ..) => Some(header.stamp),
        FlightMessage::Truth(header, _) => Some(header.stamp),
        FlightMessage::Plan(..) | FlightMessage::Journal(..) => None,
    }
}

impl StageMessages {
    /// Begins for this frame and target, before the first message.
    pub(super) fn of(stamp: FrameStamp, target: u32) -> Self {
        Self {
            stamp,
            target,
            plans: BTreeMap::new(),
            views: BTreeMap::new(),
            records: BTreeMap::new(),
            end: None,
            tracks: Vec::new(),
            has_last: false,
            truth: None,
            before: None,
            measured_before: None,
            later: Vec::new(),
            later_frames: BTreeSet::new(),
        }
    }

    /// Whether fusion has sent its last message about the frame, or several later frames were seen.
    pub(super) fn is_over(&self) -> bool {
        // Frames end in order, and only a few may be open at a time.
        self.has_last || self.later_frames() > PLANS
    }

    /// The number of later frames that were seen.
    pub(super) fn later_frames(&self) -> usize {
        self.later_frames.len()
    }

    /// Whether fusion has ended the frame.
    pub(super) fn has_ended(&self) -> bool {
        self.has_last
    }

    /// The plan that the frame followed.
    pub(super) fn plan(&self) -> Option<&(PlanHeader, Vec<PlannedView>)> {
        let by_end = self.end.map(|end| end.plan_id);
        let plan_id = by_end.or_else(|| self.views.values().next().map(|(view, _)| view.plan_id));
        self.plans.get(&plan_id?)
    }

    /// Takes a message of the recording.
    pub(super) fn on(&mut self, message: &FlightMessage) {
        let (own, order) = (self.stamp.order(), stamp_of(message).map(|stamp| stamp.order()));
        match message {
            FlightMessage::Plan(header, views, _) => {
                if self.later_frames.is_empty() {
                    self.plans.insert(header.plan_id, (*header, views.clone()));
                }
                while self.plans.len() > PLANS {
                    self.plans.pop_first();
                }
            }
            FlightMessage::Tracks(header, tracks, _) if order < Some(own) => {
                let of_target = tracks.iter().filter(|track| track.target == self.target);
                for track in of_target {
                    self.before = Some((header.stamp, *track));
                    match MeasuredBy::try_from(track.measured_by) {
                        Ok(MeasuredBy::Nothing) | Err(_) => {}
                        Ok(by) => self.measured_before = Some((header.stamp, by)),
                    }
                }
            }
            _ if order == Some(own) => self.on_own(message),
            FlightMessage::Header(header) if order > Some(own) => self.later.push(*header),
            _ => {}
        }
        if let Some(order) = order.filter(|order| *order > own) {
            self.later_frames.insert(order);
        }
    }

    fn on_own(&mut self, message: &FlightMessage) {
        match message {
            FlightMessage::Header(header) => {
                self.views.insert(header.view_index, (*header, None));
            }
            FlightMessage::View(header, pixels) => {
                self.views.insert(header.view_index, (*header, Some(pixels.clone())));
            }
            FlightMessage::Searched(record) => {
                // The first answer counts.
                self.records.entry(record.header.view_index).or_insert_with(|| record.clone());
            }
            FlightMessage::FrameEnd(end) => self.end = Some(*end),
            FlightMessage::Tracks(header, tracks, _) => {
                self.tracks.extend(tracks);
                self.has_last |= header.is_last == 1;
            }
            FlightMessage::Truth(header, bodies) => self.truth = Some((*header, bodies.clone())),
            FlightMessage::Frame(_)
            | FlightMessage::Rotation(_)
            | FlightMessage::Plan(..)
            | FlightMessage::Journal(..) => {}
        }
    }

    /// The last track of the target in this frame; one that measured it comes first.
    pub(super) fn track(&self) -> Option<&Track> {
        let own = || self.tracks.iter().filter(|track| track.target == self.target);
        let measured = own().rfind(|track| track.is_measured());
        measured.or_else(|| own().next_back())
    }

    /// The truth about the target.
    pub(super) fn true_body(&self) -> Option<&BodyTruth> {
        let (_, bodies) = self.truth.as_ref()?;
        bodies.iter().find(|body| body.target == self.target)
    }
}
