//! Why messages are refused, and how many.

use flockeye_contract::wire::{MAX_TARGETS, WireError};
use flockeye_identity::Untrusted;

pub(crate) const MAX_OBSERVERS: usize = 64;

/// How many messages in an observer's name were refused, and why.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Refused {
    /// Messages that are no report, reports in another's name, and more targets than are kept.
    pub malformed: u64,
    /// Reports that were held up on the way for too long.
    pub stale: u64,
    /// Reports that claim a time to come.
    pub future: u64,
    /// Reports that were sent before.
    pub replayed: u64,
    /// Reports that are not signed by a member of this name, or by one that does not answer.
    pub untrusted: u64,
}

impl Refused {
    /// All of them.
    pub fn total(&self) -> u64 {
        self.malformed + self.stale + self.future + self.replayed + self.untrusted
    }

    pub(crate) fn count(&mut self, refusal: &Refusal) {
        let counter = match refusal {
            Refusal::Stale { .. } => &mut self.stale,
            Refusal::Future { .. } => &mut self.future,
            Refusal::Replayed { .. } => &mut self.replayed,
            Refusal::Untrusted(_) | Refusal::NotAnswered => &mut self.untrusted,
            // It is asked for an answer, and heard from then on.
            Refusal::NotYetAnswered | Refusal::Overtaken => return,
            _ => &mut self.malformed,
        };
        *counter += 1;
    }
}

/// Why a message was refused.
#[derive(Debug, thiserror::Error)]
pub enum Refusal {
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
    /// Not signed by the observer that the key names.
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

    /// A name of the reason, for the throttle of its warnings.
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
