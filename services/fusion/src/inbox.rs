//! The ports that fusion reads, and in which order it reads them.

use std::collections::VecDeque;

use flockeye_config::{Flow, Pipeline};
use flockeye_contract::{
    DetectionHeader, Detections, FrameEnd, FrameEnds, FrameOrder, Rotations, StageName, Views,
};
use flockeye_runtime::ports::{Message, PortError, Ports, Sender, Subscriber};

use crate::core::{Core, Event};
use crate::journal::Journaled;
use crate::pictures::Pixels;
use crate::record::Record;

impl Pixels for Message<Views> {
    fn pixels(&self) -> &[u8] {
        self.items()
    }
}

/// The ports that fusion reads.
pub struct Inbox {
    /// One lane for each detection worker.
    views: Vec<Subscriber<Views>>,
    detections: Subscriber<Detections>,
    frame_ends: Subscriber<FrameEnds>,
    rotations: Subscriber<Rotations>,
    flow: Flow,
    /// Records of a lossless run that came before their views.
    early: Vec<(Record, Sender)>,
    turns: AwaitedTurns,
}

/// Ends of frames of a lossless run, which wait until it is known how the camera has turned.
struct AwaitedTurns {
    /// Whether the ends of frames wait at all: in a lossless run with egomotion.
    waits: bool,
    /// Whether egomotion was waited for in vain, and nothing has come from it since.
    is_away: bool,
    patience_ns: i64,
    /// The newest frame whose rotation has come.
    newest: Option<FrameOrder>,
    ends: VecDeque<AwaitingEnd>,
}

/// The end of a frame, when it came, nanoseconds, and its sender.
#[derive(Debug, Clone, Copy)]
struct AwaitingEnd {
    end: FrameEnd,
    since_ns: i64,
    sender: Sender,
}

impl Inbox {
    /// Opens the ports.
    ///
    /// # Errors
    /// A port that cannot be opened.
    pub fn open(ports: &mut Ports, pipeline: &Pipeline) -> Result<Self, PortError> {
        Ok(Self {
            views: ports.subscribers_of_all_lanes()?,
            detections: ports.subscriber()?,
            frame_ends: ports.subscriber()?,
            rotations: ports.subscriber()?,
            flow: pipeline.flow(),
            early: Vec::new(),
            turns: AwaitedTurns {
                waits: pipeline.flow() == Flow::Lossless && pipeline.runs(StageName::Egomotion),
                is_away: false,
                // A frame itself is given up later.
                patience_ns: pipeline.frame_deadline().as_nanos() as i64 / 2,
                newest: None,
                ends: VecDeque::new(),
            },
        })
    }

    /// Lets rectification know that it has to wait for this stage where a lane is full. False while
    /// rectification is not there.
    ///
    /// # Errors
    /// A port that fails.
    pub fn connect(&self) -> Result<bool, PortError> {
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
    pub fn receive(
        &mut self,
        core: &mut Journaled<Message<Views>>,
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
            self.turns.note(message.header.stamp.order());
            core.on(Event::Rotation(message.header), now_ns);
        }
        while let Some(message) = self.frame_ends.receive()? {
            let (end, sender) = (message.header, message.sender());
            self.turns.ends.push_back(AwaitingEnd { end, since_ns: now_ns, sender });
        }
        while let Some(AwaitingEnd { end, sender, .. }) = self.turns.take(now_ns) {
            if let Some(refusal) = core.on(Event::FrameEnd(end), now_ns) {
                self.frame_ends.refuse(sender, &refusal);
            }
        }
        Ok(())
    }

    /// When a frame will have waited long enough for its rotation, nanoseconds.
    pub fn next_deadline_ns(&self) -> Option<i64> {
        self.turns.next_deadline_ns()
    }

    fn take_all_views(
        &mut self,
        core: &mut Journaled<Message<Views>>,
        now_ns: i64,
    ) -> Result<(), PortError> {
        if self.flow == Flow::Lossless {
            return Ok(());
        }
        (0..self.views.len())
            .try_for_each(|lane| self.take_views(core, lane, now_ns, |core| core.is_full()))
    }

    /// Takes the view of a record, which passed before it in its worker's lane.
    fn take_view_of(
        &mut self,
        core: &mut Journaled<Message<Views>>,
        record: &Record,
        now_ns: i64,
    ) -> Result<(), PortError> {
        let DetectionHeader { worker, .. } = record.header;
        let lane = worker as usize;
        if lane >= self.views.len() {
            return Ok(());
        }
        self.take_views(core, lane, now_ns, |core| core.has_view_of(record))
    }

    /// Takes the views that have come in a lane, until `is_enough`.
    fn take_views(
        &mut self,
        core: &mut Journaled<Message<Views>>,
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
}

impl AwaitedTurns {
    /// The rotation of a frame has come.
    fn note(&mut self, order: FrameOrder) {
        self.is_away = false;
        self.newest = self.newest.max(Some(order));
    }

    /// The next end of a frame that need not wait any more. Who once waited in vain waits no more
    /// until a rotation comes.
    fn take(&mut self, now_ns: i64) -> Option<AwaitingEnd> {
        let AwaitingEnd { end, since_ns, .. } = *self.ends.front()?;
        let is_known = self.newest >= Some(end.stamp.order());
        if self.waits && !self.is_away && !is_known {
            if now_ns - since_ns < self.patience_ns {
                return None;
            }
            self.is_away = true;
            let frame = end.stamp.sequence;
            tracing::warn!(frame, "no rotation of the camera has come: egomotion is away");
        }
        self.ends.pop_front()
    }

    fn next_deadline_ns(&self) -> Option<i64> {
        self.ends.front().map(|awaiting| awaiting.since_ns + self.patience_ns)
    }
}

/// Whether a record's view is still on its way here: rectification had handed it to the worker
/// before, while it waited for room in this stage's lane.
fn is_early(core: &Core<Message<Views>>, record: &Record) -> bool {
    !core.has_view_of(record) && !core.has_ended(&record.header.stamp)
}
