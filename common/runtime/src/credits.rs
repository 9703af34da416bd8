//! Flow control: when a source may send its next frame.
//!
//! In the flow `latest` it may always send. In the flow `lossless` it waits for a plan: fusion
//! publishes one to open the flow, and one after each frame. So no frame overtakes another, and no
//! result depends on time. One exception: a stage that dies may lose a frame, whose plan never
//! comes. After a timeout the source stops waiting for it.

use flockeye_contract::{FrameStamp, Plans};

use crate::clock;
use crate::ports::{PortError, Ports, Subscriber};
use flockeye_config::{Flow, Pipeline};

/// Time after which a waiting source checks again, nanoseconds.
const RETRY_NS: i64 = 100_000_000;

/// Flow control of a source.
pub struct Credits {
    /// Plans are the credits; `None` in the flow `latest`.
    plans: Option<Subscriber<Plans>>,
    state: State,
    patience_ns: i64,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum State {
    /// Nothing may be sent before the flow is opened.
    Closed,
    /// A frame may be sent.
    Open,
    /// A frame is under way.
    Awaited { frame: FrameStamp, since_ns: i64 },
}

impl Credits {
    /// The credits of a pipeline's source.
    ///
    /// # Errors
    /// The plans cannot be subscribed to.
    pub fn open(pipeline: &Pipeline, ports: &mut Ports) -> Result<Self, PortError> {
        let (plans, state) = match pipeline.flow() {
            Flow::Latest => (None, State::Open),
            Flow::Lossless => (Some(ports.subscriber()?), State::Closed),
        };
        let patience_ns = pipeline.answer_deadline().as_nanos() as i64;
        Ok(Self { plans, state, patience_ns })
    }

    /// Whether the next frame may be sent now.
    ///
    /// # Errors
    /// The plans cannot be received.
    pub fn may_send(&mut self) -> Result<bool, PortError> {
        let Some(plans) = &mut self.plans else { return Ok(true) };
        while let Some(plan) = plans.receive()? {
            let opens = plan.header.has_after == 0;
            let answers = matches!(self.state, State::Awaited { frame, .. } if plan.header.after.is_same_frame(&frame));
            if opens || answers {
                self.state = State::Open;
            }
        }
        if let State::Awaited { frame, since_ns } = self.state
            && clock::monotonic_ns() - since_ns > self.patience_ns
        {
            tracing::warn!(frame = frame.sequence, "no plan came back for a frame; it is given up");
            self.state = State::Open;
        }
        Ok(self.state == State::Open)
    }

    /// Time of the next check by a waiting source, CLOCK_MONOTONIC, nanoseconds.
    pub fn retry_ns() -> i64 {
        clock::monotonic_ns() + RETRY_NS
    }

    /// Notes that a frame was sent.
    pub fn note_sent(&mut self, frame: FrameStamp) {
        if self.plans.is_some() {
            self.state = State::Awaited { frame, since_ns: clock::monotonic_ns() };
        }
    }
}
