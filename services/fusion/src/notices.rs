//! Notices to the operator: counted each time, logged seldom.

use std::collections::HashMap;
use std::mem::{Discriminant, discriminant};

use flockeye_runtime::health::SharedCounters;
use flockeye_runtime::logs::Throttle;

use crate::response::Surprise;

/// Notice to the operator.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Notice {
    /// A worker's rays do not match its corners, so its markers were left out.
    RaysDisagree {
        worker: u32,
        /// The first such marker.
        marker: u32,
    },
    /// A marker that no configured body carries.
    UnknownMarker { marker: u32 },
    /// One marker of a body was seen at two places.
    SeenTwice { body: String, marker: u32, apart_deg: u32 },
    /// A frame was not completed in time.
    Incomplete { sequence: u64 },
    /// A record came too late.
    LateRecord,
    /// The bodies' print shows another response of the camera than the one in use.
    Response(Surprise),
    /// An impossible message, with the reason.
    Refused(String),
}

/// Limits on the log rate of each kind of notice.
pub(crate) type Throttles = HashMap<Discriminant<Notice>, Throttle>;

impl Notice {
    /// Counts the notice, and logs it if nothing of its kind was logged a moment ago.
    pub(crate) fn report(&self, counters: &SharedCounters, throttles: &mut Throttles) {
        let throttle = throttles.entry(discriminant(self)).or_default();
        match self {
            Self::RaysDisagree { worker, marker } => {
                counters.add_failed(1);
                if let Some(more) = throttle.admit() {
                    tracing::warn!(
                        worker,
                        marker,
                        more_since = more,
                        "a worker's rays are not those of its corners in the view; its markers are left out. \
                         Cure: mend the detector; docs/CONTRACT.md has the conventions"
                    );
                }
            }
            Self::UnknownMarker { marker } => {
                if let Some(more) = throttle.admit() {
                    tracing::info!(
                        marker,
                        more_since = more,
                        "a marker was seen that no configured body carries; it is ignored"
                    );
                }
            }
            Self::SeenTwice { body, marker, apart_deg } => {
                if let Some(more) = throttle.admit() {
                    tracing::warn!(
                        body,
                        marker,
                        apart_deg,
                        more_since = more,
                        "one marker is seen at two places: two drones carry its ids, a picture shows it, \
                         or a square was misread. The track stays with one of them. Cure, if it is \
                         repeated: give each drone ids of its own"
                    );
                }
            }
            Self::Incomplete { sequence } => {
                counters.add_failed(1);
                if let Some(more) = throttle.admit() {
                    tracing::warn!(
                        frame = sequence,
                        more_since = more,
                        "a frame was not ended in time: rectification or detection does not answer"
                    );
                }
            }
            Self::Response(Surprise { seen: (gamma, deviation), used, taken: Some(taken) }) => {
                // It changes once or twice in a flight.
                tracing::info!(
                    "the bodies' print shows a camera with a gamma of {gamma:.2} +- {deviation:.2}, not {used:.1} \
                     (1 is linear, 2.2 is sRGB). {taken:.1} is used from now on. Cure, to have it from the \
                     first frame: state camera.response"
                );
            }
            Self::Response(Surprise { seen: (gamma, deviation), used, taken: None }) => {
                if let Some(more) = throttle.admit() {
                    tracing::warn!(
                        more_since = more,
                        "the bodies' print shows a camera with a gamma of {gamma:.2} +- {deviation:.2} (1 is \
                         linear, 2.2 is sRGB), but the configuration states {used:.1}: edges of markers seem \
                         shifted. Cure: correct camera.response, or leave it out"
                    );
                }
            }
            Self::LateRecord => counters.add_dropped(1),
            Self::Refused(refusal) => {
                counters.add_failed(1);
                if let Some(more) = throttle.admit() {
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
