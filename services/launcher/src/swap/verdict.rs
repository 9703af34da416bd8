//! Next step of a swap.

use flockeye_contract::HandOver;

/// Next step of a swap.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum SwapVerdict {
    /// No step yet.
    Wait,
    TakeOver(HandOver, String),
    /// The new process failed after it took over: the old one counts again.
    TakeBack(HandOver, String),
    /// The new process stays.
    Done(String, serde_json::Value),
    /// The old process or its program stays.
    Refused(String),
}
