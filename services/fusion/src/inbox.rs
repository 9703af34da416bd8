//! The ports that fusion reads, and in which order it reads them.

use std::collections::VecDeque;

use flockeye_config::{Flow, Pipeline};
use flockeye_contract::{Detections, FrameEnd, FrameEnds, FrameOrder, Rotations, StageName, Views};
use flockeye_runtime::ports::{Message, PortError, Ports, Sender, Subscriber};

use crate::core::{Core, Event};
use crate::record::Record;

/// The ports that fusion reads.
pub(crate) struct Inbox {
    /// One lane for each detection worker.
    views: Vec<Subscriber<Views>>,
    detections: Subscriber<Detections>,
    frame_ends: Subscriber<FrameEnds>,
    rotations: Subscriber<Rotations>,
    flow: Flow,
    /// Records of a lossless run that came before their views.
    early: Vec<(Record, Sender)>,
    /// Ends of frames, with when each came, nanoseconds, and its sender.
    ends: VecDeque<(i64, FrameEnd, Sender)>,
    /// Whether the ends wait until it is known how the camera has turned: in a lossless run with
    /// egomotion.
    awaits_rotations: bool,
    /// Whether egomotion was waited for in vain, and nothing has come from it since.
    is_egomotion_away: bool,
    patience_ns: i64,
    /// The newest frame whose rotation has come.
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
            // A frame itself is given up later.
            patience_ns: pipeline.frame_deadline().as_nanos() as i64 / 2,
            newest_rotation: None,
        })
    }

    /// Lets rectification know that it has to wait for this stage where a lane is full. False while
    /// rectification is not there.
    ///
    /// # Errors
    /// A port that fails.
    pub(crate) fn connect(&self) -> Result<bool, PortError> {
        let lanes: Result<Vec<bool>, _> = self.views.iter().map(Subscriber::connect).collect();
        Ok(lanes?.iter().all(|is_published| *is_published))
    }

    /// Gives the core all that has come, at `now_ns`.
    ///
    /// In flight views are taken as they come, as many as the core can hold. In a lossless run
    /// nothing may depend on who is faster: there each view is taken when its record comes, and the
    /// others stay where they wait.
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

    /// When a frame will have waited long enough for its rotation, nanoseconds.
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

    /// Takes the view of a record, which passed before it in its worker's lane.
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

    /// Takes the views that have come in a lane, until `is_enough`.
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

    /// The next end of a frame that need not wait any more. After a wait in vain no end waits until
    /// a rotation comes.
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

/// Whether a record's view is still on its way here: rectification had handed it to the worker
/// before, while it waited for room in this stage's lane.
fn is_early(core: &Core<Message<Views>>, record: &Record) -> bool {
    !core.has_view_of(record) && !core.frames.is_past(&record.header.stamp)
}
