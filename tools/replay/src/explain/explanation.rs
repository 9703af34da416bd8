//! The answer as data, which `--json` prints. Angles are in degrees and lengths in metres. Poses
//! are those of the target drone in the observer's frame. Unknown values are null.

use flockeye_contract::{MeasuredBy, StopReason, TrackState, ViewKind};
use serde::Serialize;

/// The reason why a frame gave this pose of a target, or none.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct FrameExplanation {
    pub recording: String,
    pub target: String,
    pub frame: FrameFacts,
    /// The step that decided the result.
    pub step: DecisiveStep,
    /// The step as a sentence.
    pub why: String,
    /// The track before the frame.
    pub before: BeforeFacts,
    /// The views of the frame, and those of its plan that were not cut.
    pub views: Vec<ViewFacts>,
    /// Number of frames until the place is searched next; null: not in the frames that were read.
    pub next_search_in: Option<u64>,
    /// Markers of the target, and squares that may be markers.
    pub markers: Vec<MarkerFacts>,
    /// Passes of fusion; empty if fusion could not be replayed.
    pub passes: Vec<PassFacts>,
    /// The published result.
    pub result: Option<ResultFacts>,
    /// The truth from a simulated source.
    pub truth: Option<TruthFacts>,
    /// Name of another body in front of the target.
    pub hidden_by: Option<String>,
    /// Reliability of the answer.
    pub reliance: Reliance,
}

/// The step of the pipeline that decided the result.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum DecisiveStep {
    /// The target was measured.
    Measured,
    /// A pose was measured after the end of the frame, and only corrected the track.
    TooLate,
    /// An imprecise pose corrected the track.
    Imprecise,
    /// A pose was found outside of the track's gate.
    OutsideGate,
    /// The recording has no end of the frame.
    NotEnded,
    /// No expected place of the target is known.
    NoPlaceKnown,
    /// No view of the frame shows the place.
    OutsideViews,
    /// The tile of the place was not searched in this frame.
    NotItsTurn,
    /// The region of interest was planned and not cut.
    Abandoned,
    /// The view of the place was cut and not answered.
    Unanswered,
    /// The view of the place could not be searched.
    SearchFailed,
    /// Nothing of the target was found in the views of the place.
    NothingFound,
    /// Poses were found, but the picture supports none of them enough.
    BelowThreshold,
    /// Two different poses were likely.
    Rivals,
    /// Markers were decoded, but their corners alone do not determine a pose.
    TooFewCorners,
    /// The detections led to no pose. The messages alone do not show the reason.
    Untold,
}

/// Facts about the frame.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct FrameFacts {
    /// Sequence number.
    pub sequence: u64,
    pub epoch: u32,
    /// Exposure, seconds since the recording began.
    pub at_s: f64,
    /// The plan that the frame followed; 0: none.
    pub plan_id: Option<u64>,
    /// Views that were cut.
    pub views_issued: Option<u32>,
    /// Views of the plan that were not cut.
    pub views_abandoned: Option<u32>,
    /// The reason why no more views were cut.
    pub stopped: Option<StopReason>,
}

/// The track before the frame.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(super) struct BeforeFacts {
    /// State of the track; null: there was no track.
    pub state: Option<TrackState>,
    /// Number of the track.
    pub track_id: Option<u32>,
    /// Predicted pose for this frame.
    pub predicted: Option<PoseFacts>,
    /// Standard deviations of that pose.
    pub deviations: Option<Deviations>,
    /// The last frame that measured the target.
    pub measured_in: Option<u64>,
    /// Method of that measurement.
    pub measured_by: Option<MeasuredBy>,
    /// Time from the exposure of that frame to this one's, seconds.
    pub measured_ago_s: Option<f64>,
}

/// A pose of the target drone in the observer's frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct PoseFacts {
    /// Position, metres.
    pub position: [f64; 3],
    /// Orientation: quaternion x, y, z, w.
    pub orientation: [f64; 4],
    /// Distance, metres.
    pub range_m: f64,
    /// Azimuth from the observer's x axis, positive to the left.
    pub bearing_deg: f64,
    /// Elevation above the observer's x-y plane.
    pub elevation_deg: f64,
}

/// Standard deviations, all axes together.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct Deviations {
    pub position_m: f64,
    /// Standard deviation of the orientation.
    pub rotation_deg: f64,
}

/// A view of the frame or of its plan.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct ViewFacts {
    /// Index of the view in the plan.
    pub view_index: u32,
    /// Kind of the view.
    pub kind: Option<ViewKind>,
    /// The number of the tile.
    pub tile: Option<u32>,
    /// The name of the target whose region it is.
    pub region_of: Option<String>,
    /// Whether the view shows the predicted or true place of the target; null: no place is known.
    pub shows_place: Option<bool>,
    /// Whether the view was cut.
    pub is_cut: bool,
    /// Whether detection has answered the view.
    pub is_answered: bool,
    /// Whether the view was meant to be searched for markers.
    pub is_searched: bool,
    /// Whether the search failed.
    pub has_failed: bool,
    /// Decoded markers of the target.
    pub decoded: u32,
}

/// A decoded marker of the target.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct MarkerFacts {
    pub id: u32,
    pub view_index: u32,
    /// Whether the marker is near the expected place of the target; null: no place is known.
    pub is_at_place: Option<bool>,
    /// Residual of the corners relative to a pose, root mean square, pixels of the view.
    pub residual_px: Option<f64>,
    /// The pose of the residual.
    pub residual_of: Option<ResidualOf>,
}

/// The pose to which residuals are relative.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum ResidualOf {
    /// The frame's measurement.
    Measurement,
    /// The likeliest hypothesis.
    Hypothesis,
    /// The track's prediction.
    Prediction,
}

/// A pass of fusion over the target, or why it did not run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct PassFacts {
    /// Name of the pass.
    pub pass: &'static str,
    /// The reason why the pass did not run.
    pub not_run: Option<&'static str>,
    /// The view whose pixels the pass used.
    pub view_index: Option<u32>,
    /// Whether the pass had time for only one starting pose.
    pub is_late: bool,
    /// Whether rough starts were left to the background pass.
    pub is_deferred: bool,
    /// Ids of decoded markers.
    pub decoded: Vec<u32>,
    /// Poses from corners.
    pub corner_poses: Vec<CornerFacts>,
    /// Poses that were compared with the picture.
    pub hypotheses: Vec<HypothesisFacts>,
    /// Result of the pass.
    pub outcome: Option<&'static str>,
}

/// A pose from corners.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct CornerFacts {
    pub pose: PoseFacts,
    /// Cost of the pose, in squared standard deviations.
    pub cost: f64,
    /// Ids of the markers that fit the pose.
    pub agreeing: Vec<u32>,
    /// Ids of the markers that do not fit: mirrored, or of another body.
    pub left_out: Vec<u32>,
    /// Whether the pose is the best one for corners and track.
    pub is_chosen: bool,
    /// Whether the pose is accepted as the measurement, or the reason why not.
    pub verdict: String,
}

/// A pose that was compared with the picture.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct HypothesisFacts {
    /// Source of the hypothesis.
    pub source: &'static str,
    /// The pose; null if it could not be compared with the picture.
    pub pose: Option<PoseFacts>,
    /// Standard deviations of the pose.
    pub deviations: Option<Deviations>,
    /// Sum of all log odds.
    pub log_odds: Option<f64>,
    pub terms: Option<LogOddsTerms>,
    /// Mean correlation of the cells with the picture.
    pub correlation: Option<f64>,
    /// Number of facets that fit the picture.
    pub agreeing_facets: Option<u32>,
    /// Share of the body that is not hidden.
    pub visible_share: Option<f64>,
    /// The decision.
    pub verdict: &'static str,
    /// The decision as a sentence, with the limits.
    pub decided: String,
}

/// The terms of a hypothesis' log odds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct LogOddsTerms {
    pub picture: f64,
    /// Part of the picture's log odds from all facets except the most informative one.
    pub picture_of_other_facets: f64,
    /// Term of the rotation from the track's prediction; null without a confirmed track.
    pub turn: Option<f64>,
    /// Term of the neighbour's tilt.
    pub tilt: f64,
    /// Whether decoded markers fit the pose, which lowers the limits.
    pub is_marked: bool,
}

/// The published result.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct ResultFacts {
    /// The state of the track.
    pub state: Option<TrackState>,
    /// Method of the frame's measurement.
    pub measured_by: Option<MeasuredBy>,
    /// The frame's measurement.
    pub measured: Option<PoseFacts>,
    /// Standard deviations of that pose.
    pub measured_deviations: Option<Deviations>,
    /// The track's pose.
    pub pose: PoseFacts,
    /// Standard deviations of that pose.
    pub deviations: Deviations,
    /// Markers that were decoded.
    pub markers: u32,
    /// Time since the last measurement, seconds.
    pub unseen_s: f64,
    /// Latency of each stage, milliseconds; null if unknown.
    pub latency_ms: StageLatencies,
}

/// Latency of each stage, milliseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct StageLatencies {
    /// From exposure to frame.
    pub capture: Option<f64>,
    /// From frame to view.
    pub rectification: Option<f64>,
    /// From view to detection record.
    pub detection: Option<f64>,
    /// From detection record or view to track.
    pub fusion: Option<f64>,
    pub total: Option<f64>,
}

/// The truth from a simulated source.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct TruthFacts {
    pub pose: PoseFacts,
    /// Error of the measurement, or else of the track.
    pub error: Option<Deviations>,
    /// Number of markers that are at least 50 % visible.
    pub markers_visible_50: u32,
    /// Number of markers that are at least 90 % visible.
    pub markers_visible_90: u32,
    /// Side of the best visible marker on the sphere image, pixels.
    pub best_side_px: f64,
}

/// Reliability of an answer.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub(super) struct Reliance {
    /// Whether replayed fusion gave the recorded messages, byte by byte.
    pub is_exact: bool,
    /// First difference between replayed and recorded messages.
    pub difference: Option<String>,
    /// Unknown facts, with reasons.
    pub untold: Vec<String>,
    /// Topics with missing messages, and their number.
    pub lost: Vec<(String, u64)>,
}
