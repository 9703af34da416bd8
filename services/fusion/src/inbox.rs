//! The input ports of fusion, and the order in which they are read.

use std::collections::VecDeque;

use flockeye_config::{Flow, Pipeline};
use flockeye_contract::{Detections, FrameEnd, FrameEnds, FrameOrder, Rotations, StageName, Views};
use flockeye_runtime::ports::{Message, PortError, Ports, Sender, Subscriber};

use crate::core::{Core, Event};
use crate::record::Record;

/// The input ports of fusion.
pub(crate) struct Inbox {
    /// One lane for each detection worker.
    views: Vec<Subscriber<Views>>,
    detections: Subscriber<Detections>,
    frame_ends: Subscriber<FrameEnds>,
    rotations: Subscriber<Rotations>,
    flow: Flow,
    /// Records of a lossless run that arrived before their views.
    early: Vec<(Record, Sender)>,
    /// Ends of frames, with their times of arrival, nanoseconds, and their senders.
    ends: VecDeque<(i64, FrameEnd, Sender)>,
    /// Whether the ends wait until the camera's rotation is known: in a lossless run with
    /// egomotion.
    awaits_rotations: bool,
    /// Whether the wait for egomotion has timed out, and nothing has arrived from it since.
    is_egomotion_away: bool,
    patience_ns: i64,
    /// The newest frame whose rotation has arrived.
    newest_rotation: Option<FrameOrder>,
}

impl Inbox {
    /// Opens the ports.
    ///
    /// # Errors
    /// A port that cannot be opened.
    pub(crate) fn open(ports: &mut Ports, pipeline: &Pipeline) -> Result<Self, PortError> {
        Ok(Self {
            views: ports.subscribers_of_all_lanes()?,
            detections: ports.subscriber()?,
            frame_ends: ports.subscriber()?,
            rotations: ports.subscriber()?,
            flow: pipeline.flow(),
            early: Vec::new(),
            ends: VecDeque::new(),
            awaits_rotations: pipeline.flow() == Flow::Lossless
                && pipeline.runs(StageName::Egomotion),
            is_egomotion_away: false,
            // A frame itself times out later.
            patience_ns: pipeline.frame_deadline().as_nanos() as i64 / 2,
            newest_rotation: None,
        })
    }

    /// Signals to rectification that it must wait for this stage where a lane is full. False while
    /// rectification is not there.
    ///
    /// # Errors
    /// A port that fails.
    pub(crate) fn connect(&self) -> Result<bool, PortError> {
        let lanes: Result<Vec<bool>, _> = self.views.iter().map(Subscriber::connect).collect();
        Ok(lanes?.iter().all(|is_published| *is_published))
    }

    /// Passes all arrived messages to the core, at `now_ns`.
    ///
    /// In flight, views are received as they arrive, as many as the core can hold. In a lossless
    /// run the result must not depend on the speed of stages. There each view is received with its
    /// record, and the others stay in the lane.
    ///
    /// # Errors
    /// A port that fails.
    pub(crate) fn receive(
        &mut self,
        core: &mut Core<Message<Views>>,
        now_ns: i64,
    ) -> Result<(), PortError> {
        self.take_all_views(core, now_ns)?;
        let mut records = std::mem::take(&mut self.early);
        while let Some(message) = self.detections.receive()? {
            let sender = message.sender();
            let record = Record { header: message.header, markers: message.items().to_vec() };
            records.push((record, sender));
        }
        for (record, sender) in records {
            self.take_view_of(core, &record, now_ns)?;
            if self.flow == Flow::Lossless && is_early(core, &record) {
                self.early.push((record, sender));
            } else if let Some(refusal) = core.on(Event::Searched(record), now_ns) {
                self.detections.refuse(sender, &refusal);
            }
        }
        self.take_all_views(core, now_ns)?;
        while let Some(message) = self.rotations.receive()? {
            self.is_egomotion_away = false;
            self.newest_rotation = self.newest_rotation.max(Some(message.header.stamp.order()));
            core.on(Event::Rotation(message.header), now_ns);
        }
        while let Some(message) = self.frame_ends.receive()? {
            self.ends.push_back((now_ns, message.header, message.sender()));
        }
        while let Some((end, sender)) = self.take_end(now_ns) {
            if let Some(refusal) = core.on(Event::FrameEnd(end), now_ns) {
                self.frame_ends.refuse(sender, &refusal);
            }
        }
        Ok(())
    }

    /// Timeout of a frame's wait for its rotation, nanoseconds.
    pub(crate) fn next_deadline_ns(&self) -> Option<i64> {
        self.ends.front().map(|(since_ns, ..)| since_ns + self.patience_ns)
    }

    fn take_all_views(
        &mut self,
        core: &mut Core<Message<Views>>,
        now_ns: i64,
    ) -> Result<(), PortError> {
        if self.flow == Flow::Lossless {
            return Ok(());
        }
        (0..self.views.len())
            .try_for_each(|lane| self.take_views(core, lane, now_ns, |core| core.frames.is_full()))
    }

    /// Receives the view of a record, which passed before it in its worker's lane.
    fn take_view_of(
        &mut self,
        core: &mut Core<Message<Views>>,
        record: &Record,
        now_ns: i64,
    ) -> Result<(), PortError> {
        let lane = record.header.worker as usize;
        if lane >= self.views.len() {
            return Ok(());
        }
        self.take_views(core, lane, now_ns, |core| core.has_view_of(record))
    }

    /// Receives the views that have arrived in a lane, until `is_enough`.
    fn take_views(
        &mut self,
        core: &mut Core<Message<Views>>,
        lane: usize,
        now_ns: i64,
        is_enough: impl Fn(&Core<Message<Views>>) -> bool,
    ) -> Result<(), PortError> {
        while !is_enough(core)
            && let Some(message) = self.views[lane].receive()?
        {
            let sender = message.sender();
            if let Some(refusal) = core.on(Event::View(message.header, message), now_ns) {
                self.views[lane].refuse(sender, &refusal);
            }
        }
        Ok(())
    }

    /// The next end of a frame that need not wait any longer. After a timeout no end waits until a
    /// rotation arrives.
    fn take_end(&mut self, now_ns: i64) -> Option<(FrameEnd, Sender)> {
        let (since_ns, end, sender) = *self.ends.front()?;
        let is_known = self.newest_rotation >= Some(end.stamp.order());
        if self.awaits_rotations && !self.is_egomotion_away && !is_known {
            if now_ns - since_ns < self.patience_ns {
                return None;
            }
            self.is_egomotion_away = true;
            let frame = end.stamp.sequence;
            tracing::warn!(frame, "no rotation of the camera has come: egomotion is away");
        }
        self.ends.pop_front();
        Some((end, sender))
    }
}

/// Whether a record's view is still on its way here: rectification sent it to the worker first,
/// while it waited for room in this stage's lane.
fn is_early(core: &Core<Message<Views>>, record: &Record) -> bool {
    !core.has_view_of(record) && !core.frames.is_past(&record.header.stamp)
}
