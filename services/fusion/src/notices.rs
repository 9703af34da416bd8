//! What an operator should know: counted each time, logged seldom.

use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;

use crate::refusal::Refusal;

/// Something that an operator should know.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Notice {
    /// A worker's rays are not those of its corners, so its markers were left out.
    RaysDisagree {
        /// Number of the worker.
        worker: u32,
        /// The first such marker.
        marker: u32,
    },
    /// A marker that no configured body carries.
    UnknownMarker {
        /// Its id.
        marker: u32,
    },
    /// A frame was not completed in time.
    Incomplete {
        /// Its sequence number.
        sequence: u64,
    },
    /// A record came too late.
    LateRecord,
    /// A message that cannot be true.
    Refused(Refusal),
}

/// Counts notices and logs them.
#[derive(Debug)]
pub struct Reporter {
    counters: SharedCounters,
    disagreements: Throttle,
    unknown_markers: Throttle,
    incomplete: Throttle,
    refusals: Throttle,
}

impl Reporter {
    /// Counts in `counters`.
    pub fn new(counters: SharedCounters) -> Self {
        Self {
            counters,
            disagreements: Throttle::default(),
            unknown_markers: Throttle::default(),
            incomplete: Throttle::default(),
            refusals: Throttle::default(),
        }
    }

    /// Counts a notice, and logs it if nothing of its kind was logged a moment ago.
    pub fn report(&mut self, notice: &Notice) {
        match *notice {
            Notice::RaysDisagree { worker, marker } => {
                self.counters.add_failed(1);
                if let Some(more) = self.disagreements.admit() {
                    tracing::warn!(
                        worker,
                        marker,
                        more_since = more,
                        "a worker's rays are not those of its corners in the view; its markers are left out. \
                         Cure: mend the detector; docs/CONTRACT.md has the conventions"
                    );
                }
            }
            Notice::UnknownMarker { marker } => {
                if let Some(more) = self.unknown_markers.admit() {
                    tracing::info!(
                        marker,
                        more_since = more,
                        "a marker was seen that no configured body carries; it is ignored"
                    );
                }
            }
            Notice::Incomplete { sequence } => {
                self.counters.add_failed(1);
                if let Some(more) = self.incomplete.admit() {
                    tracing::warn!(
                        frame = sequence,
                        more_since = more,
                        "a frame was not ended in time: rectification or detection does not answer"
                    );
                }
            }
            Notice::LateRecord => self.counters.add_dropped(1),
            Notice::Refused(refusal) => {
                self.counters.add_failed(1);
                if let Some(more) = self.refusals.admit() {
                    tracing::warn!(
                        more_since = more,
                        "a message is refused: {refusal}. Cure: mend the stage that sends it; \
                         docs/CONTRACT.md says what is to be copied"
                    );
                }
            }
        }
    }
}
