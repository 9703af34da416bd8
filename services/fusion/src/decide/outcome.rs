//! What becomes of a measured pose: publication, a correction of the track, or nothing.

use crate::measurement::Measurement;

/// What a pass led to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Outcome {
    /// The pass gave no pose.
    Nothing,
    /// The pass gave no pose yet: the background pass was asked for.
    InBackground,
    /// A pose that is not precise. It waits for the frame's end, in case that something better is found.
    Imprecise(Measurement),
    /// A measurement, which was published.
    Published(Measurement),
    /// A pose that is not precise: it corrected the track.
    Corrected(Measurement),
    /// A pose that is not where the track can be.
    OutsideGate(Measurement),
    /// A pose of a frame that is too long ago for the track, or whose numbers are unusable.
    Refused(Measurement),
    /// A pose that came when its frame had ended: it corrected the track, or began one.
    Late(Measurement),
    /// The answer came when another pass had measured the target.
    Cancelled,
}

impl Outcome {
    /// What became of a measurement of an open frame. `is_measured` is what the filter made of it: whether it counts as
    /// the frame's measurement; `None` where the filter refused it.
    pub fn of(measurement: Measurement, is_measured: Option<bool>) -> Self {
        match is_measured {
            None if !measurement.is_precise => Self::OutsideGate(measurement),
            None => Self::Refused(measurement),
            Some(true) => Self::Published(measurement),
            Some(false) if measurement.is_precise => Self::OutsideGate(measurement),
            Some(false) => Self::Corrected(measurement),
        }
    }

    /// What becomes of a pass over an open frame that gave no precise pose.
    pub fn unpublished(imprecise: Option<Measurement>, is_in_background: bool) -> Self {
        match imprecise {
            _ if is_in_background => Self::InBackground,
            Some(imprecise) => Self::Imprecise(imprecise),
            None => Self::Nothing,
        }
    }

    /// The pose that it is about.
    pub fn measurement(&self) -> Option<&Measurement> {
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

/// Whether a measurement may go into its target's track. An imprecise one must lie where the track expects it.
pub fn may_enter_track(measurement: &Measurement, is_inside_gate: impl FnOnce() -> bool) -> bool {
    measurement.is_precise || is_inside_gate()
}

/// The answer of a background pass, beside its frame and its target's track.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AnswerCase {
    /// Whether the frame has ended meanwhile.
    pub is_late: bool,
    /// Whether the pose was found without the prior of a track.
    pub is_independent: bool,
    /// Whether the target has a track now.
    pub is_tracked: bool,
    /// Whether the frame is so recent that the filter can go back to it.
    pub is_within_history: bool,
}

impl AnswerCase {
    /// Whether the answer may begin a track. A pose that was found by the prior of a track that is lost since then means
    /// nothing.
    pub fn may_begin_track(&self) -> bool {
        self.is_independent && !self.is_tracked && self.is_within_history
    }

    /// Whether a measurement waits for the end of its frame, in case that something better is found.
    pub fn waits(&self, measurement: &Measurement) -> bool {
        !self.is_late && !measurement.is_precise
    }

    /// Whether a measurement goes to the filter. When its frame has ended, it must agree with the track or begin one.
    pub fn is_accepted(&self, is_inside_gate: impl FnOnce() -> bool) -> bool {
        !self.is_late || self.may_begin_track() || is_inside_gate()
    }

    /// What became of a measurement that went to the filter, which took it or not. When its frame has ended, nothing of
    /// it is published.
    pub fn outcome(&self, of_open_frame: Outcome, is_taken: bool) -> Outcome {
        match of_open_frame.measurement() {
            Some(measurement) if self.is_late && is_taken => Outcome::Late(*measurement),
            _ => of_open_frame,
        }
    }
}
