//! The answer as text.

use std::fmt::Write as _;

use super::explanation::{
    BeforeFacts, Deviations, FrameExplanation, HypothesisFacts, MarkerFacts, PassFacts, PoseFacts,
    ResidualOf, ResultFacts, ViewFacts,
};
use super::judgement::name_of;

/// Largest number of listed views without the target; further views are only counted.
const MOST_OTHER_VIEWS: usize = 12;

/// The answer for people.
pub(super) fn of(explanation: &FrameExplanation) -> String {
    let mut out = String::new();
    // Writing to a string does not fail.
    let _ = write_all(&mut out, explanation);
    out
}

fn write_all(out: &mut String, explanation: &FrameExplanation) -> std::fmt::Result {
    let frame = &explanation.frame;
    writeln!(
        out,
        "{} in frame {} at {:.3} s: {}",
        explanation.target, frame.sequence, frame.at_s, explanation.why
    )?;
    let count =
        |count: Option<u32>| count.map_or_else(|| "?".to_owned(), |count| count.to_string());
    let stopped =
        frame.stopped.map_or_else(String::new, |reason| format!(", ended: {}", word(&reason)));
    writeln!(
        out,
        "\nFrame     plan {}, {} views cut, {} not{stopped}",
        frame.plan_id.map_or_else(|| "?".to_owned(), |plan| plan.to_string()),
        count(frame.views_issued),
        count(frame.views_abandoned),
    )?;
    before(out, &explanation.before)?;
    views(out, &explanation.views)?;
    markers(out, &explanation.markers)?;
    passes(out, &explanation.passes)?;
    if let Some(result) = &explanation.result {
        self::result(out, result)?;
    } else {
        writeln!(out, "\nResult    nothing was published of it")?;
    }
    if let Some(truth) = &explanation.truth {
        writeln!(out, "\nTruth     {}", place(&truth.pose))?;
        writeln!(
            out,
            "          {} markers visible, {} of them nearly whole; the best has {:.0} px",
            truth.markers_visible_50, truth.markers_visible_90, truth.best_side_px
        )?;
        if let Some(error) = &truth.error {
            writeln!(out, "          error: {}", sigmas(error))?;
        }
    }
    reliance(out, explanation)
}

fn reliance(out: &mut String, explanation: &FrameExplanation) -> std::fmt::Result {
    let reliance = &explanation.reliance;
    writeln!(out)?;
    if reliance.is_exact {
        writeln!(out, "Replayed  fusion gives again what was recorded, byte by byte")?;
    }
    if let Some(difference) = &reliance.difference {
        writeln!(
            out,
            "Replayed  fusion gives something else than was recorded, so this may not be what happened: {difference}"
        )?;
    }
    for untold in &reliance.untold {
        writeln!(out, "Untold    {untold}")?;
    }
    for (topic, messages) in &reliance.lost {
        writeln!(out, "Lost      the recording lacks up to {messages} messages of {topic}")?;
    }
    Ok(())
}

/// A code's name.
fn word(code: &impl serde::Serialize) -> String {
    let name = serde_json::to_value(code).ok();
    name.and_then(|name| name.as_str().map(|name| name.replace('_', " "))).unwrap_or_default()
}

fn place(pose: &PoseFacts) -> String {
    format!(
        "bearing {:+.1}, elevation {:+.1} degrees, {:.2} m away",
        pose.bearing_deg, pose.elevation_deg, pose.range_m
    )
}

fn sigmas(deviations: &Deviations) -> String {
    format!("{:.1} mm, {:.2} degrees", deviations.position_m * 1e3, deviations.rotation_deg)
}

fn before(out: &mut String, before: &BeforeFacts) -> std::fmt::Result {
    let state = before.state.map_or_else(|| "none".to_owned(), |state| word(&state));
    writeln!(out, "\nTrack     before this frame: {state}")?;
    if let Some(predicted) = &before.predicted {
        let doubt =
            before.deviations.map_or_else(String::new, |said| format!(", +- {}", sigmas(&said)));
        writeln!(out, "          predicted at {}{doubt}", place(predicted))?;
    }
    match (before.measured_in, before.measured_by, before.measured_ago_s) {
        (Some(frame), Some(by), Some(ago_s)) => writeln!(
            out,
            "          last measured in frame {frame}, {:.0} ms before, {}",
            ago_s * 1e3,
            word(&by)
        ),
        _ => writeln!(out, "          never measured before"),
    }
}

fn views(out: &mut String, views: &[ViewFacts]) -> std::fmt::Result {
    let is_of_interest = |view: &&ViewFacts| view.shows_place == Some(true) || view.decoded > 0;
    let (shown, others): (Vec<&ViewFacts>, Vec<&ViewFacts>) =
        views.iter().partition(is_of_interest);
    writeln!(out, "\nLooked at {} views that show its place or its markers", shown.len())?;
    for view in shown {
        let state = match (view.is_cut, view.is_answered, view.has_failed, view.is_searched) {
            (false, ..) => "planned, not cut".to_owned(),
            (_, false, ..) => "cut, not answered".to_owned(),
            (_, _, true, _) => "its search failed".to_owned(),
            (_, _, _, false) => "cut, and not searched for markers".to_owned(),
            _ => format!("searched: {} markers decoded", view.decoded),
        };
        writeln!(out, "          view {:<3} {}: {state}", view.view_index, name_of(view))?;
    }
    let cut: Vec<&ViewFacts> = others.into_iter().filter(|view| view.is_cut).collect();
    if !cut.is_empty() {
        let names: Vec<String> =
            cut.iter().take(MOST_OTHER_VIEWS).map(|view| name_of(view)).collect();
        let more = cut.len().saturating_sub(MOST_OTHER_VIEWS);
        let more = if more > 0 { format!(" and {more} more") } else { String::new() };
        writeln!(out, "          elsewhere: {}{more}", names.join(", "))?;
    }
    Ok(())
}

fn markers(out: &mut String, all: &[MarkerFacts]) -> std::fmt::Result {
    let (markers, elsewhere): (Vec<&MarkerFacts>, Vec<&MarkerFacts>) =
        all.iter().partition(|marker| marker.is_at_place != Some(false));
    writeln!(out, "\nFound     {} markers of it", markers.len())?;
    if !elsewhere.is_empty() {
        writeln!(out, "          elsewhere {} markers with its ids", elsewhere.len())?;
    }
    for marker in markers {
        let residual = match (marker.residual_px, marker.residual_of) {
            (Some(px), Some(of)) => {
                let of = match of {
                    ResidualOf::Measurement => "the measurement",
                    ResidualOf::Hypothesis => "the likeliest pose",
                    ResidualOf::Prediction => "the prediction",
                };
                format!("corners {px:.2} px from {of}")
            }
            _ => "nothing to compare it with".to_owned(),
        };
        writeln!(
            out,
            "          marker {:<4} in view {:<3} {residual}",
            marker.id, marker.view_index
        )?;
    }
    Ok(())
}

fn passes(out: &mut String, passes: &[PassFacts]) -> std::fmt::Result {
    if !passes.is_empty() {
        writeln!(out, "\nPasses")?;
    }
    for pass in passes {
        if let Some(reason) = pass.not_run {
            writeln!(out, "  {}: did not run: {reason}", pass.pass)?;
            continue;
        }
        let view =
            pass.view_index.map_or_else(|| "no view".to_owned(), |view| format!("view {view}"));
        let late = if pass.is_late { ", time for one start" } else { "" };
        let deferred = if pass.is_deferred { ", rough starts left to the background" } else { "" };
        let outcome = pass.outcome.unwrap_or_default();
        writeln!(out, "  {} ({view}{late}{deferred}): {outcome}", pass.pass)?;
        for corner in &pass.corner_poses {
            let mark = if corner.is_chosen { "corners, preferred" } else { "corners" };
            let left_out = match corner.left_out.is_empty() {
                true => String::new(),
                false => format!(", left out: {:?}", corner.left_out),
            };
            writeln!(
                out,
                "    {mark}: {}, cost {:.1}, markers {:?}{left_out}: {}",
                place(&corner.pose),
                corner.cost,
                corner.agreeing,
                corner.verdict
            )?;
        }
        for hypothesis in &pass.hypotheses {
            self::hypothesis(out, hypothesis)?;
        }
    }
    Ok(())
}

fn hypothesis(out: &mut String, hypothesis: &HypothesisFacts) -> std::fmt::Result {
    write!(out, "    {}: ", hypothesis.source)?;
    if let (Some(pose), Some(deviations), Some(terms), Some(log_odds)) =
        (&hypothesis.pose, &hypothesis.deviations, &hypothesis.terms, hypothesis.log_odds)
    {
        let turn = terms.turn.map_or_else(String::new, |turn| format!(" {turn:+.1} turn"));
        let tilt =
            if terms.tilt == 0.0 { String::new() } else { format!(" {:+.1} tilt", terms.tilt) };
        let marked = if terms.is_marked { ", its markers lie there" } else { "" };
        write!(
            out,
            "{}, +- {}\n      log odds {log_odds:.1} = {:.1} picture{turn}{tilt}",
            place(pose),
            sigmas(deviations),
            terms.picture
        )?;
        if let (Some(correlation), Some(facets), Some(visible)) =
            (hypothesis.correlation, hypothesis.agreeing_facets, hypothesis.visible_share)
        {
            write!(
                out,
                " (correlation {correlation:.2}, {facets} facets agree, {:.0} % visible{marked})",
                visible * 100.0
            )?;
        }
        write!(out, "\n      ")?;
    }
    writeln!(out, "{}", hypothesis.decided)
}

fn result(out: &mut String, result: &ResultFacts) -> std::fmt::Result {
    let state = result.state.map_or_else(String::new, |state| word(&state));
    let by = result.measured_by.map_or_else(String::new, |by| word(&by));
    writeln!(
        out,
        "\nResult    {state}, measured by {by}, {} markers decoded by then",
        result.markers
    )?;
    if let (Some(pose), Some(deviations)) = (&result.measured, &result.measured_deviations) {
        writeln!(out, "          measured: {}, +- {}", place(pose), sigmas(deviations))?;
    }
    writeln!(
        out,
        "          track:    {}, +- {}",
        place(&result.pose),
        sigmas(&result.deviations)
    )?;
    if result.unseen_s > 0.0 {
        writeln!(out, "          not measured for {:.0} ms", result.unseen_s * 1e3)?;
    }
    let latency = &result.latency_ms;
    let stages = [
        ("capture", latency.capture),
        ("rectification", latency.rectification),
        ("detection", latency.detection),
        ("fusion", latency.fusion),
        ("in all", latency.total),
    ];
    let stages = stages.iter().filter_map(|(name, ms)| Some(format!("{name} {:.1}", (*ms)?)));
    writeln!(out, "          latency, ms: {}", stages.collect::<Vec<_>>().join(", "))
}
