//! What becomes of a measured pose: publication, a correction of the track, or nothing.

use crate::measurement::PoseMeasurement;

/// What a pass led to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Outcome {
    /// The pass gave no pose.
    Nothing,
    /// The pass gave no pose yet: the background pass was asked for.
    InBackground,
    /// A pose that is not precise. It waits for the frame's end, in case that something better is
    /// found.
    Imprecise(PoseMeasurement),
    /// A measurement, which was published.
    Published(PoseMeasurement),
    /// A pose that is not precise: it corrected the track.
    Corrected(PoseMeasurement),
    /// A pose that is not where the track can be.
    OutsideGate(PoseMeasurement),
    /// A pose of a frame that is too long ago for the track, or whose numbers are unusable.
    Refused(PoseMeasurement),
    /// A pose that came when its frame had ended: it corrected the track, or began one.
    Late(PoseMeasurement),
    /// The answer came when another pass had measured the target.
    Cancelled,
}

impl Outcome {
    /// What became of a measurement of an open frame. `is_measured` is what the filter made of it:
    /// whether it counts as the frame's measurement; `None` where the filter refused it.
    pub(crate) fn of(measurement: PoseMeasurement, is_measured: Option<bool>) -> Self {
        match is_measured {
            None if !measurement.is_precise => Self::OutsideGate(measurement),
            None => Self::Refused(measurement),
            Some(true) => Self::Published(measurement),
            Some(false) if measurement.is_precise => Self::OutsideGate(measurement),
            Some(false) => Self::Corrected(measurement),
        }
    }

    /// What becomes of a pass over an open frame that gave no precise pose.
    pub(crate) fn unpublished(imprecise: Option<PoseMeasurement>, is_in_background: bool) -> Self {
        match imprecise {
            _ if is_in_background => Self::InBackground,
            Some(imprecise) => Self::Imprecise(imprecise),
            None => Self::Nothing,
        }
    }

    /// The pose that it is about.
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

/// Whether a measurement may go into its target's track. An imprecise one must lie where the track
/// expects it.
pub(crate) fn may_enter_track(
    measurement: &PoseMeasurement,
    is_inside_gate: impl FnOnce() -> bool,
) -> bool {
    measurement.is_precise || is_inside_gate()
}
