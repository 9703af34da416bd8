//! What the configuration means for fusion.

use flockeye_config::{Filter, Mode, Pipeline};
use flockeye_geometry::filter::{MotionModel, TrackPolicy};
use flockeye_geometry::search::SearchMode;

use crate::swarm::FilterChoice;

/// Without tracks nothing says where to look, so everything is looked at.
pub fn search_mode(pipeline: &Pipeline) -> SearchMode {
    match (pipeline.search.mode, pipeline.fusion.filter) {
        (Mode::Greedy, _) => SearchMode::Greedy,
        (Mode::Optimized, _) => SearchMode::Optimized,
        (Mode::Exhaustive, _) | (Mode::Gaze, Filter::None) => SearchMode::Exhaustive,
        (Mode::Gaze, Filter::ConstantVelocity) => SearchMode::Gaze,
    }
}

/// The same for a plan's header.
pub fn mode_code(mode: Mode) -> flockeye_contract::SearchMode {
    match mode {
        Mode::Greedy => flockeye_contract::SearchMode::Greedy,
        Mode::Optimized => flockeye_contract::SearchMode::Optimized,
        Mode::Exhaustive => flockeye_contract::SearchMode::Exhaustive,
        Mode::Gaze => flockeye_contract::SearchMode::Gaze,
    }
}

/// How poses are carried from frame to frame.
pub fn filter_choice(pipeline: &Pipeline) -> FilterChoice {
    let fusion = &pipeline.fusion;
    let usual = MotionModel::default();
    match fusion.filter {
        Filter::None => FilterChoice::None,
        Filter::ConstantVelocity => FilterChoice::Tracks(TrackPolicy {
            motion: MotionModel {
                acceleration: fusion.acceleration,
                angular_acceleration: fusion.angular_acceleration,
                // Who coasts is predicted.
                longest_step_s: usual.longest_step_s.max(fusion.coast_s),
                ..usual
            },
            confirm_hits: fusion.confirm_hits,
            confirm_window: fusion.confirm_window,
            coast_s: fusion.coast_s,
            history_s: fusion.history_s,
            gate_probability: fusion.gate_probability,
            restart_after_gated: fusion.restart_after_gated,
        }),
    }
}
