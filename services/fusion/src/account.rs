//! What was decided of one body in each frame, and why: plain data for whoever asks afterwards.
//!
//! A pass notes what it does where somebody has asked for an account of its target
//! ([`Tracker::keep_account`](crate::tracker::Tracker::keep_account)). Otherwise nothing is noted, and nothing is decided by
//! what is.

use flockeye_contract::FrameOrder;
use flockeye_geometry::pose::PoseSolution;
use flockeye_imaging::align::{AlignError, Alignment};
use nalgebra::Isometry3;

use crate::measurement::{MeasuredBy, Measurement};
use crate::policy::TimeBudget;
use crate::track_prior::TrackPrior;

/// What was decided of one target.
#[derive(Debug)]
pub struct Account {
    target: usize,
    decisions: Vec<(FrameOrder, Decision)>,
}

/// One thing that was decided, in the order in which it was.
#[derive(Debug, Clone, PartialEq)]
#[allow(clippy::large_enum_variant, reason = "a few for each frame that somebody asks about")]
pub enum Decision {
    /// A pass was due, and did not run.
    NotRun(Pass, NotRun),
    /// A pass ran.
    Ran(Trial),
    /// Decoded markers contradict the pose of the direct pass: its target waits for its markers for a while.
    Contradicted,
    /// The frame is complete, and what only corrects the track was taken in.
    TakenImprecise(Outcome),
}

/// A measurement pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pass {
    /// From the prediction alone.
    Direct,
    /// From markers and the prediction, when the region of interest was searched.
    Region,
    /// The same over all of the complete frame.
    Complete,
    /// From rough starts, and a search round the prediction.
    Background,
    /// In any attitude, at a place that looks like a body.
    Place,
}

/// Why a pass did not run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NotRun {
    /// The frame's pose has left already.
    Published,
    /// There is no track, or none that is confirmed and was measured in the last frame.
    NotMeasuredBefore,
    /// Markers contradicted a pose of the direct pass some frames ago.
    Suspended,
    /// No marker was decoded, and there is no prediction.
    NothingKnown,
    /// No marker was decoded, and no view of the target is held.
    NoView,
}

/// A pass over one target.
#[derive(Debug, Clone, PartialEq)]
pub struct Trial {
    /// Which.
    pub pass: Pass,
    /// The place in the plan of the view whose pixels it read.
    pub view_index: Option<u32>,
    /// How much time it had.
    pub budget: TimeBudget,
    /// Whether rough starts and the search were left to the background pass.
    pub is_deferred: bool,
    /// What the track predicted, `camera_from_markers`.
    pub predicted: Option<Isometry3<f64>>,
    /// Whether that track is confirmed.
    pub is_confirmed: bool,
    /// Ids of the markers that were decoded.
    pub decoded: Vec<u32>,
    /// Ids of squares that are probably markers.
    pub doubtful: Vec<u32>,
    /// Poses that the decoded corners give, the cheapest first.
    pub corner_poses: Vec<CornerPose>,
    /// Poses that were compared with the picture, in the order in which they were tried.
    pub hypotheses: Vec<Hypothesis>,
    /// What it led to.
    pub outcome: Outcome,
}

/// Whether a pose from corners would do as a measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CornerVerdict {
    /// It would.
    Enough,
    /// More markers would have to agree.
    TooFewMarkers {
        /// So many.
        wanted: usize,
    },
    /// Its standard deviations are too large, all axes together. It may only correct a track.
    TooUncertain {
        /// Metres.
        position_m: f64,
        /// Radians.
        rotation_rad: f64,
    },
}

/// A pose from decoded corners.
#[derive(Debug, Clone, PartialEq)]
pub struct CornerPose {
    /// The pose and what supports it.
    pub solution: PoseSolution,
    /// Whether it is the one that corners and track prefer.
    pub is_chosen: bool,
    /// Whether it would do as the frame's measurement, where the picture gives none.
    pub verdict: CornerVerdict,
}

/// What a pass led to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Outcome {
    /// No pose.
    Nothing,
    /// No pose yet: the background pass was asked for.
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

/// A pose that was compared with the picture.
#[derive(Debug, Clone, PartialEq)]
pub struct Hypothesis {
    /// Where it comes from.
    pub source: Source,
    /// What alignment found, or why it found nothing.
    pub found: Result<Alignment, AlignError>,
    /// What the turn from the track's prediction adds to the log odds; `None` without a confirmed track.
    pub turn_log: Option<f64>,
    /// What is known of how neighbours fly adds to the log odds, where hypotheses compete.
    pub tilt_log: f64,
    /// Whether markers were decoded where this pose has them.
    pub is_marked: bool,
    /// What was decided.
    pub verdict: Verdict,
}

/// Where a hypothesis comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Source {
    /// Corners of decoded markers.
    Corners,
    /// Corners of squares that are probably markers.
    DoubtfulSquares,
    /// The track's prediction.
    Prediction,
    /// The track's prediction, with a coarse fit before the fine one.
    RoughPrediction,
    /// The direct pass, which has tried the prediction before.
    DirectPass,
    /// The mirror pose of another hypothesis.
    Mirror,
    /// The search round the prediction.
    Search,
    /// The search in all attitudes at a place that looks like a body.
    Place,
}

/// What was decided of a hypothesis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Verdict {
    /// It is the body's pose.
    Accepted,
    /// It would do, and another one was more likely.
    LessLikely,
    /// The picture and all else say too little for it.
    BelowThreshold,
    /// It is likely, and its standard deviations are too large to start a track with.
    Imprecise,
    /// It is likely, and others are too likely beside it: it leads them by so much, in log odds.
    Rivals(f64),
    /// A rival of the one that was looked at.
    Rival,
    /// One facet alone tells it, and starts that the background pass will try may tell another.
    OneFacetAlone,
    /// It is not where the track can be.
    OutsideGate,
    /// Nothing could be compared.
    NotAligned,
    /// The search found nothing that is accepted.
    NothingFound,
}

/// Notes of what hypotheses led to. Where nobody asks it holds nothing.
#[derive(Debug, Default)]
pub struct Notes<'n>(Option<&'n mut Vec<Hypothesis>>);

impl<'n> Notes<'n> {
    /// Into this list.
    pub fn into_list(list: Option<&'n mut Vec<Hypothesis>>) -> Self {
        Self(list)
    }

    /// Nobody asks.
    pub fn none() -> Self {
        Self(None)
    }

    /// Notes a hypothesis, if somebody asks.
    pub fn note(&mut self, hypothesis: impl FnOnce() -> Hypothesis) {
        if let Some(list) = &mut self.0 {
            list.push(hypothesis());
        }
    }

    /// Decides on the last hypothesis.
    pub fn decide_last(&mut self, verdict: Verdict) {
        if let Some(last) = self.0.as_mut().and_then(|list| list.last_mut()) {
            last.verdict = verdict;
        }
    }

    /// Decides on the hypothesis that this is.
    fn decide(&mut self, found: &Alignment, verdict: Verdict) {
        let Some(list) = &mut self.0 else { return };
        let noted = list.iter_mut().rev().find(|noted| noted.found.as_ref() == Ok(found));
        noted.into_iter().for_each(|noted| noted.verdict = verdict);
    }

    /// This one is the body's pose.
    pub fn accept(&mut self, found: &Alignment) {
        self.decide(found, Verdict::Accepted);
    }

    /// One facet alone tells this one, which is not enough while other starts are left.
    pub fn is_one_facet_alone(&mut self, found: &Alignment) {
        self.decide(found, Verdict::OneFacetAlone);
    }

    /// This one is the body's pose if `is_chosen`; it leads its rivals by so much.
    pub fn choose(&mut self, best: &Alignment, rivals: &[&Alignment], is_chosen: bool, lead: f64) {
        if !is_chosen {
            rivals.iter().for_each(|rival| self.decide(rival, Verdict::Rival));
        }
        self.decide(best, if is_chosen { Verdict::Accepted } else { Verdict::Rivals(lead) });
    }
}

impl Hypothesis {
    /// Nothing is known of it yet but what alignment says.
    pub fn of(source: Source, found: Result<Alignment, AlignError>) -> Self {
        let verdict = match &found {
            Ok(_) => Verdict::BelowThreshold,
            Err(_) => Verdict::NotAligned,
        };
        Self { source, found, turn_log: None, tilt_log: 0.0, is_marked: false, verdict }
    }

    /// The log odds of the picture and of what else counted.
    pub fn log_odds(&self) -> Option<f64> {
        let found = self.found.as_ref().ok()?;
        Some(found.evidence.log_odds + self.turn_log.unwrap_or(0.0) + self.tilt_log)
    }
}

impl Trial {
    /// A pass that begins.
    pub fn of(pass: Pass, prior: &TrackPrior, budget: TimeBudget) -> Self {
        Self {
            pass,
            view_index: None,
            budget,
            is_deferred: false,
            predicted: prior.predicted().copied(),
            is_confirmed: prior.confirmed().is_some(),
            decoded: Vec::new(),
            doubtful: Vec::new(),
            corner_poses: Vec::new(),
            hypotheses: Vec::new(),
            outcome: Outcome::Nothing,
        }
    }
}

impl Outcome {
    /// What a measurement was by that was published.
    pub fn published_by(&self) -> Option<MeasuredBy> {
        match self {
            Self::Published(measurement) => Some(measurement.measured_by),
            _ => None,
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

impl Account {
    /// Of a target, from now on.
    pub fn of(target: usize) -> Self {
        Self { target, decisions: Vec::new() }
    }

    /// Whether it is about this target.
    pub fn is_of(&self, target: usize) -> bool {
        self.target == target
    }

    /// Notes what was decided in a frame.
    pub fn note(&mut self, order: FrameOrder, decision: Decision) {
        self.decisions.push((order, decision));
    }

    /// Says what the last pass that ran in a frame led to.
    pub fn set_outcome(&mut self, order: FrameOrder, outcome: Outcome) {
        let last = self.decisions.iter_mut().rev().find_map(|(of, decision)| match decision {
            Decision::Ran(trial) if *of == order => Some(trial),
            _ => None,
        });
        last.into_iter().for_each(|trial| trial.outcome = outcome);
    }

    /// What was decided since this was asked last.
    pub fn take(&mut self) -> Vec<(FrameOrder, Decision)> {
        std::mem::take(&mut self.decisions)
    }
}
