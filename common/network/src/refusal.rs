//! Reasons for refusing messages, and their counters.

use flockeye_contract::wire::{MAX_TARGETS, WireError};
use flockeye_identity::Untrusted;

/// Maximum observers of a listener.
pub(crate) const MAX_OBSERVERS: usize = 64;

/// Numbers of refused messages in an observer's name, by reason.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Refused {
    /// Messages that are not reports, reports in another's name, and targets beyond the maximum.
    pub malformed: u64,
    /// Reports that were delayed for too long.
    pub stale: u64,
    /// Reports with a future time.
    pub future: u64,
    /// Reports that were sent no later than one that was accepted before.
    pub replayed: u64,
    /// Reports that are not signed by the member of this name, or by one that does not answer.
    pub untrusted: u64,
}

impl Refused {
    /// The sum of all counters.
    pub fn total(&self) -> u64 {
        self.malformed + self.stale + self.future + self.replayed + self.untrusted
    }

    pub(crate) fn count(&mut self, refusal: &Refusal) {
        let counter = match refusal {
            Refusal::Stale { .. } => &mut self.stale,
            Refusal::Future { .. } => &mut self.future,
            Refusal::Replayed { .. } => &mut self.replayed,
            Refusal::Untrusted(_) | Refusal::NotAnswered => &mut self.untrusted,
            // The observer is queried, and its reports are accepted after its answer.
            Refusal::NotYetAnswered | Refusal::Overtaken => return,
            _ => &mut self.malformed,
        };
        *counter += 1;
    }
}

/// The reason why a message was refused.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Refusal {
    #[error("no key of a report: names are letters, digits, '-', '_' or '.'")]
    Key,
    /// Not a report.
    #[error(transparent)]
    Wire(#[from] WireError),
    #[error("the report is of '{found}', its key is not")]
    Observer { found: String },
    #[error("{late_ms} ms late: it was held on its way")]
    Stale { late_ms: i64 },
    #[error("sent {early_ms} ms after now by its own clock")]
    Future { early_ms: i64 },
    #[error("it was overtaken by an answer")]
    Overtaken,
    #[error("sent {older_ms} ms before one that is here already, or said twice")]
    Replayed { older_ms: i64 },
    /// The observer in the key has not signed it.
    #[error(transparent)]
    Untrusted(#[from] Untrusted),
    #[error("its observer is asked whether it is there")]
    NotYetAnswered,
    #[error("its observer does not answer: somebody plays what it said before")]
    NotAnswered,
    #[error("already {MAX_OBSERVERS} observers, which is the most")]
    TooManyObservers,
    #[error("already {MAX_TARGETS} targets of this observer, which is the most")]
    TooManyTargets,
}

impl Refusal {
    /// Whether this refusal is normal at start-up and need not be reported.
    pub(crate) fn is_usual(&self) -> bool {
        matches!(self, Self::NotYetAnswered | Self::Overtaken)
    }

    /// The name of the reason, by which warnings are throttled.
    pub(crate) fn reason(&self) -> &'static str {
        match self {
            Self::Key => "key",
            Self::Wire(_) | Self::Observer { .. } => "malformed",
            Self::Stale { .. } => "stale",
            Self::Future { .. } => "future",
            Self::Replayed { .. } => "replayed",
            Self::Overtaken => "overtaken",
            Self::Untrusted(Untrusted::NotSigned) => "not signed",
            Self::Untrusted(Untrusted::NotKnown) => "not known",
            Self::Untrusted(Untrusted::Certificate(_)) => "certificate",
            Self::Untrusted(Untrusted::Revoked(_)) => "revoked",
            Self::Untrusted(Untrusted::NotAMember(_)) => "not a member",
            Self::Untrusted(Untrusted::Another(_)) => "another",
            Self::Untrusted(Untrusted::Signature) => "signature",
            Self::NotYetAnswered | Self::NotAnswered => "not answered",
            Self::TooManyObservers | Self::TooManyTargets => "too many",
        }
    }
}
