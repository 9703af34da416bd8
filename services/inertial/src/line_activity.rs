//! Activity of the line to the autopilot. It has no port and no clock.

use crate::message::MessageKind;

/// Time without samples on an open line that is reported, nanoseconds: longer than an autopilot
/// needs to answer.
const SILENT_NS: i64 = 3_000_000_000;

/// Activity of the line.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) enum LineActivity {
    /// The line is closed.
    #[default]
    Lost,
    /// The line is open without samples since this time, CLOCK_MONOTONIC, nanoseconds.
    Silent { since_ns: i64, is_reported: bool },
    /// Samples arrive.
    Active,
}

/// Change to report.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum LineChange {
    /// Samples arrive in this message.
    Active(MessageKind),
    /// Samples have stopped.
    Stopped,
    /// No samples arrive on the open line.
    Silent,
}

impl LineActivity {
    /// The line was opened at `now_ns`.
    pub(crate) fn open(&mut self, now_ns: i64) {
        *self = Self::Silent { since_ns: now_ns, is_reported: false };
    }

    pub(crate) fn lose(&mut self) {
        *self = Self::Lost;
    }

    /// Updates the state at `now_ns` and returns a change to report. `newest` is the message of the
    /// newest samples; `None` if they are too old.
    pub(crate) fn check(&mut self, newest: Option<MessageKind>, now_ns: i64) -> Option<LineChange> {
        let change = match (*self, newest) {
            (Self::Silent { .. }, Some(kind)) => {
                *self = Self::Active;
                return Some(LineChange::Active(kind));
            }
            (Self::Active, None) => LineChange::Stopped,
            (Self::Silent { since_ns, is_reported: false }, None)
                if now_ns - since_ns > SILENT_NS =>
            {
                LineChange::Silent
            }
            _ => return None,
        };
        *self = Self::Silent { since_ns: now_ns, is_reported: true };
        Some(change)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn silence_is_reported_once_and_samples_when_they_begin() {
        let mut line = LineActivity::default();
        assert_eq!(line.check(None, 9 * SILENT_NS), None, "it is not there");
        line.open(0);
        assert_eq!(line.check(None, SILENT_NS), None);
        assert_eq!(line.check(None, SILENT_NS + 1), Some(LineChange::Silent));
        assert_eq!(line.check(None, 3 * SILENT_NS), None);
        let kind = MessageKind::HighresImu;
        assert_eq!(line.check(Some(kind), 3 * SILENT_NS), Some(LineChange::Active(kind)));
        assert_eq!(line.check(Some(kind), 4 * SILENT_NS), None);
        assert_eq!(line.check(None, 5 * SILENT_NS), Some(LineChange::Stopped));
        assert_eq!(line.check(None, 9 * SILENT_NS), None);
        line.lose();
        assert_eq!(line.check(None, 20 * SILENT_NS), None);
    }
}
