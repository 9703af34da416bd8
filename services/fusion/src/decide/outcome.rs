//! Outcome of a measured pose: publication, a correction of the track, or nothing.

use crate::measurement::PoseMeasurement;
use crate::target::TargetEstimate;

/// Outcome of a pass.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Outcome {
    /// The pass found no pose.
    Nothing,
    /// The pass found no pose yet: the background pass was requested.
    InBackground,
    /// A pose that is not precise, or one of two that are possible. It waits for the frame's end, in
    /// case a better one is found.
    Imprecise(PoseMeasurement),
    /// A measurement, which was published.
    Published(PoseMeasurement),
    /// A pose that is not precise: it corrected the track.
    Corrected(PoseMeasurement),
    /// One of two poses that are possible, by the frame or by the track.
    Ambiguous(PoseMeasurement),
    /// A pose that contradicts the track.
    OutsideGate(PoseMeasurement),
    /// A pose of a frame too long ago for the track, or with unusable numbers.
    Refused(PoseMeasurement),
    /// A pose that arrived after the end of its frame: it corrected the track, or began one.
    Late(PoseMeasurement),
    /// The answer arrived after another pass had measured the target.
    Cancelled,
}

impl Outcome {
    /// Outcome of a measurement in an open frame, with the target's estimate after it; `None` if the
    /// filter refused it.
    pub(crate) fn of(measurement: PoseMeasurement, estimate: Option<&TargetEstimate>) -> Self {
        let is_ambiguous = measurement.rival.is_some()
            || estimate.is_some_and(|estimate| estimate.rival.is_some());
        match estimate {
            Some(estimate) if estimate.measured.is_some() => Self::Published(measurement),
            _ if is_ambiguous => Self::Ambiguous(measurement),
            None if measurement.is_precise => Self::Refused(measurement),
            Some(_) if !measurement.is_precise => Self::Corrected(measurement),
            _ => Self::OutsideGate(measurement),
        }
    }

    /// Outcome of a pass over an open frame without a precise pose.
    pub(crate) fn unpublished(imprecise: Option<PoseMeasurement>, is_in_background: bool) -> Self {
        match imprecise {
            _ if is_in_background => Self::InBackground,
            Some(imprecise) => Self::Imprecise(imprecise),
            None => Self::Nothing,
        }
    }

    /// The pose of the outcome.
    pub fn measurement(&self) -> Option<&PoseMeasurement> {
        match self {
            Self::Nothing | Self::InBackground | Self::Cancelled => None,
            Self::Imprecise(measurement)
            | Self::Published(measurement)
            | Self::Corrected(measurement)
            | Self::Ambiguous(measurement)
            | Self::OutsideGate(measurement)
            | Self::Refused(measurement)
            | Self::Late(measurement) => Some(measurement),
        }
    }
}

/// Whether a measurement may update its target's track. An imprecise one must fit the track's
/// prediction.
pub(crate) fn may_enter_track(
    measurement: &PoseMeasurement,
    is_inside_gate: impl FnOnce() -> bool,
) -> bool {
    measurement.is_precise || is_inside_gate()
}
