//! The answer, as data: what `--json` prints. Angles are degrees, lengths metres, poses those of
//! the target drone in the observer's frame. What is not known is null.

use flockeye_contract::{MeasuredBy, StopReason, TrackState, ViewKind};
use serde::Serialize;

/// Why a frame gave this pose of a target, or none.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FrameExplanation {
    pub recording: String,
    pub target: String,
    pub frame: FrameFacts,
    /// The step that decided.
    pub step: DecisiveStep,
    /// The same in plain words.
    pub why: String,
    /// The track before the frame.
    pub before: BeforeFacts,
    /// The views of the frame, and those of its plan that were not cut.
    pub views: Vec<ViewFacts>,
    /// In how many frames the place is searched next; null: not among those that were looked
    /// through.
    pub next_search_in: Option<u64>,
    /// What was found of the target.
    pub markers: Vec<MarkerFacts>,
    /// What fusion tried; empty where it could not be replayed.
    pub passes: Vec<PassFacts>,
    /// What was published.
    pub result: Option<ResultFacts>,
    /// What the source knows.
    pub truth: Option<TruthFacts>,
    /// Another body that is in front.
    pub hidden_by: Option<String>,
    /// How far the answer can be relied on.
    pub reliance: Reliance,
}

/// The step of the pipeline that decided.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum DecisiveStep {
    /// The target was measured.
    Measured,
    /// A pose was measured when the frame had ended: it only corrected the track.
    TooLate,
    /// A pose that is not precise corrected the track.
    Imprecise,
    /// A pose was found where the track cannot be.
    OutsideGate,
    /// The recording has no end of the frame.
    NotEnded,
    /// Nothing says where the target might be.
    NoPlaceKnown,
    /// No view of the frame shows the place.
    OutsideViews,
    /// The tile of the place had no turn in this frame.
    NotItsTurn,
    /// The region of interest was planned and not cut.
    Abandoned,
    /// The view of the place was cut and not answered.
    Unanswered,
    /// The view of the place could not be searched.
    SearchFailed,
    /// Nothing of the target was found in the views of the place.
    NothingFound,
    /// Squares were found that could not be decoded.
    NothingDecoded,
    /// Poses were found, and the picture says too little for all of them.
    BelowThreshold,
    /// A pose was likely, and so was another.
    Rivals,
    /// Markers were decoded, and their corners alone say too little.
    TooFewCorners,
    /// What was found led to no pose; why cannot be told from messages alone.
    Untold,
}

/// The frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FrameFacts {
    /// Its number.
    pub sequence: u64,
    pub epoch: u32,
    /// When it was exposed, seconds since the recording began.
    pub at_s: f64,
    /// The plan that it followed; 0: none.
    pub plan_id: Option<u64>,
    /// Views that were cut.
    pub views_issued: Option<u32>,
    /// Views of the plan that were not.
    pub views_abandoned: Option<u32>,
    /// Why no more were cut.
    pub stopped: Option<StopReason>,
}

/// The track before the frame.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct BeforeFacts {
    /// Its state; null: there was none.
    pub state: Option<TrackState>,
    /// Its number.
    pub track_id: Option<u32>,
    /// Where it was predicted for this frame.
    pub predicted: Option<PoseFacts>,
    /// How certain that is.
    pub deviations: Option<Deviations>,
    /// The last frame that measured the target, what by, and how long ago it was exposed, seconds.
    pub measured_in: Option<u64>,
    /// See `measured_in`.
    pub measured_by: Option<MeasuredBy>,
    /// See `measured_in`.
    pub measured_ago_s: Option<f64>,
}

/// A pose of the target drone in the observer's frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PoseFacts {
    /// Metres.
    pub position: [f64; 3],
    /// x y z w.
    pub orientation: [f64; 4],
    /// Its distance, metres.
    pub range_m: f64,
    /// To the left of the observer's nose.
    pub bearing_deg: f64,
    /// Above the observer's plane.
    pub elevation_deg: f64,
}

/// Standard deviations, all axes together.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Deviations {
    pub position_m: f64,
    /// Of the attitude.
    pub rotation_deg: f64,
}

/// A view of the frame or of its plan.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewFacts {
    /// Its place in the plan.
    pub view_index: u32,
    /// What kind.
    pub kind: Option<ViewKind>,
    /// The number of the tile.
    pub tile: Option<u32>,
    /// The name of the target whose region it is.
    pub region_of: Option<String>,
    /// Whether it shows the place where the target is predicted, or is by the truth; null: no such
    /// place is known.
    pub shows_place: Option<bool>,
    /// Whether it was cut.
    pub is_cut: bool,
    /// Whether it was answered by detection.
    pub is_answered: bool,
    /// Whether it was to be searched for markers.
    pub is_searched: bool,
    /// Whether the search failed.
    pub has_failed: bool,
    /// Decoded markers of the target.
    pub decoded: u32,
    /// Squares that are probably markers of the target.
    pub doubtful: u32,
}

/// A marker of the target, or a square that is probably one.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MarkerFacts {
    pub id: u32,
    pub view_index: u32,
    /// Whether it was decoded. A square that was not is only a place to start from.
    pub is_decoded: bool,
    /// Whether it was seen where the target is expected; null: no such place is known.
    pub is_at_place: Option<bool>,
    /// The distance of its corners from where the frame's pose has them, root mean square, pixels
    /// of the view.
    pub residual_px: Option<f64>,
    /// The pose that this is about.
    pub residual_of: Option<ResidualOf>,
}

/// The pose that residuals are about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum ResidualOf {
    /// The frame's measurement.
    Measurement,
    /// The likeliest hypothesis.
    Hypothesis,
    /// The track's prediction.
    Prediction,
}

/// A pass of fusion over the target, or why it did not run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PassFacts {
    /// Which.
    pub pass: &'static str,
    /// Why it did not run.
    pub not_run: Option<&'static str>,
    /// The view whose pixels it read.
    pub view_index: Option<u32>,
    /// Whether it had time for one start alone.
    pub is_late: bool,
    /// Whether rough starts and the search were left to the background pass.
    pub is_deferred: bool,
    /// Ids of decoded markers.
    pub decoded: Vec<u32>,
    /// Ids of doubtful squares.
    pub doubtful: Vec<u32>,
    /// Poses from corners.
    pub corner_poses: Vec<CornerFacts>,
    /// Poses that were compared with the picture.
    pub hypotheses: Vec<HypothesisFacts>,
    /// What it led to.
    pub outcome: Option<&'static str>,
}

/// A pose from corners.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CornerFacts {
    pub pose: PoseFacts,
    /// Its cost, in squared standard deviations.
    pub cost: f64,
    /// Ids of the markers that agree with it.
    pub agreeing: Vec<u32>,
    /// Ids of those that do not: mirrored, or not this body's.
    pub left_out: Vec<u32>,
    /// Whether corners and track prefer it.
    pub is_chosen: bool,
    /// Whether it would do as the measurement, or why not.
    pub verdict: String,
}

/// A pose that was compared with the picture.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct HypothesisFacts {
    /// Where it comes from.
    pub source: &'static str,
    /// The pose; null where nothing could be compared.
    pub pose: Option<PoseFacts>,
    /// How certain it is.
    pub deviations: Option<Deviations>,
    /// All log odds together.
    pub log_odds: Option<f64>,
    pub terms: Option<LogOddsTerms>,
    /// Mean correlation of the cells with the picture.
    pub correlation: Option<f64>,
    /// Facets that agree.
    pub agreeing_facets: Option<u32>,
    /// The share of the body that nothing is in front of.
    pub visible_share: Option<f64>,
    /// What was decided.
    pub verdict: &'static str,
    /// The same in plain words, with what was asked for.
    pub decided: String,
}

/// What the log odds of a hypothesis are the sum of.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LogOddsTerms {
    pub picture: f64,
    /// The part of the picture's that the facets beside the most informative one have.
    pub picture_of_other_facets: f64,
    /// The turn from the track's prediction; null without a confirmed track.
    pub turn: Option<f64>,
    /// The tilt of neighbours.
    pub tilt: f64,
    /// Whether markers were decoded where the pose has them, for which less is asked.
    pub is_marked: bool,
}

/// What was published.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ResultFacts {
    /// The state of the track.
    pub state: Option<TrackState>,
    /// What the frame measured it by.
    pub measured_by: Option<MeasuredBy>,
    /// The frame's measurement.
    pub measured: Option<PoseFacts>,
    /// How certain that is.
    pub measured_deviations: Option<Deviations>,
    /// The track's pose.
    pub pose: PoseFacts,
    /// How certain that is.
    pub deviations: Deviations,
    /// Markers that were decoded.
    pub markers: u32,
    /// Since when it was not measured, seconds.
    pub unseen_s: f64,
    /// What each stage took, milliseconds; null where it is not known.
    pub latency_ms: StageLatencies,
}

/// What each stage took, milliseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StageLatencies {
    /// Exposure to frame.
    pub capture: Option<f64>,
    /// Frame to view.
    pub rectification: Option<f64>,
    /// View to record.
    pub detection: Option<f64>,
    /// Record, or view, to track.
    pub fusion: Option<f64>,
    pub total: Option<f64>,
}

/// What the source knows.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TruthFacts {
    pub pose: PoseFacts,
    /// By how much the result is off: the measurement, or else the track.
    pub error: Option<Deviations>,
    /// Markers of which at least half is visible.
    pub markers_visible_50: u32,
    /// Markers of which at least nine tenths are.
    pub markers_visible_90: u32,
    /// Side of its best visible marker on the sphere image, pixels.
    pub best_side_px: f64,
}

/// How far an answer can be relied on.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Reliance {
    /// Whether fusion was replayed and said what was recorded, byte by byte.
    pub is_exact: bool,
    /// What the replayed fusion said that was not recorded.
    pub difference: Option<String>,
    /// What cannot be told, and why.
    pub untold: Vec<String>,
    /// What the recording lacks: topics, and how many messages.
    pub lost: Vec<(String, u64)>,
}
