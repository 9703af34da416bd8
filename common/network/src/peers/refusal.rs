//! Why messages are refused, and how many.

use flockeye_contract::wire::{MAX_TARGETS, WireError};
use flockeye_identity::Untrusted;

use super::MAX_OBSERVERS;
use crate::freshness::NotOfNow;

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

    pub(super) fn count(&mut self, refusal: &Refusal) {
        let counter = match refusal {
            Refusal::NotOfNow(NotOfNow::Stale { .. }) => &mut self.stale,
            Refusal::NotOfNow(NotOfNow::Future { .. }) => &mut self.future,
            Refusal::NotOfNow(NotOfNow::Replayed { .. }) => &mut self.replayed,
            Refusal::Untrusted(_) | Refusal::NotAnswered => &mut self.untrusted,
            // It is asked for an answer, and heard from then on.
            Refusal::NotYetAnswered | Refusal::NotOfNow(NotOfNow::Overtaken) => return,
            _ => &mut self.malformed,
        };
        *counter += 1;
    }
}

/// Why a message was refused.
#[derive(Debug, thiserror::Error)]
pub enum Refusal {
    /// Not a key under which an observer reports.
    #[error("no key of a report: names are letters, digits, '-', '_' or '.'")]
    Key,
    /// Not a report.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// A report in another's name.
    #[error("the report is of '{found}', its key is not")]
    Observer {
        /// The observer in the report.
        found: String,
    },
    /// A report of another time than now.
    #[error(transparent)]
    NotOfNow(#[from] NotOfNow),
    /// Not signed by the observer that the key names.
    #[error(transparent)]
    Untrusted(#[from] Untrusted),
    /// The observer has not been asked, or has not answered yet.
    #[error("its observer is asked whether it is there")]
    NotYetAnswered,
    /// The observer does not answer.
    #[error("its observer does not answer: somebody plays what it said before")]
    NotAnswered,
    /// No room for another observer.
    #[error("already {MAX_OBSERVERS} observers, which is the most")]
    TooManyObservers,
    /// No room for another target of this observer.
    #[error("already {MAX_TARGETS} targets of this observer, which is the most")]
    TooManyTargets,
}

impl Refusal {
    /// Whether this refusal is normal at start-up and need not be reported.
    pub(crate) fn is_usual(&self) -> bool {
        matches!(self, Self::NotYetAnswered | Self::NotOfNow(NotOfNow::Overtaken))
    }

    /// A name of the reason, for the throttle of its warnings.
    pub(crate) fn reason(&self) -> &'static str {
        match self {
            Self::Key => "key",
            Self::Wire(_) | Self::Observer { .. } => "malformed",
            Self::NotOfNow(NotOfNow::Stale { .. }) => "stale",
            Self::NotOfNow(NotOfNow::Future { .. }) => "future",
            Self::NotOfNow(NotOfNow::Replayed { .. }) => "replayed",
            Self::NotOfNow(NotOfNow::Overtaken) => "overtaken",
            Self::Untrusted(Untrusted::NotSigned) => "not signed",
            Self::Untrusted(Untrusted::NotKnown) => "not known",
            Self::Untrusted(Untrusted::Certificate(_)) => "certificate",
            Self::Untrusted(Untrusted::Revoked { .. }) => "revoked",
            Self::Untrusted(Untrusted::NotAMember { .. }) => "not a member",
            Self::Untrusted(Untrusted::Another { .. }) => "another",
            Self::Untrusted(Untrusted::Signature) => "signature",
            Self::NotYetAnswered | Self::NotAnswered => "not answered",
            Self::TooManyObservers | Self::TooManyTargets => "too many",
        }
    }
}
