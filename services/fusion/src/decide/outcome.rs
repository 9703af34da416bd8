//! Outcome of a measured pose: publication, a correction of the track, or nothing.

use crate::measurement::PoseMeasurement;

/// Outcome of a pass.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Outcome {
    /// The pass found no pose.
    Nothing,
    /// The pass found no pose yet: the background pass was requested.
    InBackground,
    /// A pose that is not precise. It waits for the frame's end, in case a better one is found.
    Imprecise(PoseMeasurement),
    /// A measurement, which was published.
    Published(PoseMeasurement),
    /// A pose that is not precise: it corrected the track.
    Corrected(PoseMeasurement),
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
    /// Outcome of a measurement in an open frame. `is_measured` is the result of the filter:
    /// whether it counts as the frame's measurement; `None` if the filter refused it.
    pub(crate) fn of(measurement: PoseMeasurement, is_measured: Option<bool>) -> Self {
        match is_measured {
            None if !measurement.is_precise => Self::OutsideGate(measurement),
            None => Self::Refused(measurement),
            Some(true) => Self::Published(measurement),
            Some(false) if measurement.is_precise => Self::OutsideGate(measurement),
            Some(false) => Self::Corrected(measurement),
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
