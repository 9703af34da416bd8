//! The HTML page with tables and figures.

use flockeye_geometry::pose::{FALSE_POSITION_M, FALSE_ROTATION_RAD};
use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::flight_path::SCRIPT;
use crate::evaluation::consistency::{Consistency, Nees};
use crate::evaluation::error::Errors;
use crate::evaluation::{Bin, Evaluation};

const STYLE: &str = "
:root { --ground: #ffffff; --ink: #1f2328; --soft: #59636e; --grid: #d8dee4;
  --truth: #59636e; --pose: #0b62c4; --coast: #b35900; color-scheme: light dark }
@media (prefers-color-scheme: dark) {
  :root { --ground: #14181d; --ink: #e6edf3; --soft: #9aa5b1; --grid: #2f3740;
    --truth: #aab4bf; --pose: #58a6ff; --coast: #f0883e }
}
body { background: var(--ground); color: var(--ink); font: 15px/1.5 system-ui, sans-serif;
  max-width: 60rem; margin: 2rem auto; padding: 0 1rem }
h1, h2, h3 { line-height: 1.2; font-weight: 600 }
p, figcaption { color: var(--soft); max-width: 46rem }
figure { margin: 1.5rem 0 }
.wide { overflow-x: auto; width: max-content; max-width: calc(100vw - 2rem); position: relative;
  left: 50%; transform: translateX(-50%) }
table { border-collapse: collapse; font-size: 14px; font-variant-numeric: tabular-nums;
  white-space: nowrap }
th, td { padding: .2rem .5rem; text-align: right; border-bottom: 1px solid var(--grid) }
th:first-child, td:first-child { text-align: left; padding-left: 0 }
th[colspan] { text-align: center; border-bottom-color: var(--ground) }
th { font-weight: 600; color: var(--soft) }
svg { display: block; width: 100%; font: 12px system-ui, sans-serif; fill: var(--ink) }
.paths { display: grid; grid-template-columns: repeat(auto-fit, minmax(16rem, 1fr)); gap: .5rem }
.turns { cursor: grab; touch-action: none }
polyline { fill: none; stroke-linejoin: round }
polyline.grid { stroke: var(--grid); stroke-width: .8 }
polyline.axis { stroke: var(--soft); stroke-width: 1 }
polyline.truth { stroke: var(--truth); stroke-width: 1.4 }
polyline.pose { stroke: var(--pose); stroke-width: 1.4 }
circle.pose { fill: var(--pose) }
circle.coast { fill: var(--coast) }
";

/// The page: the compared files, the results, and each body's figures with captions.
pub(super) fn page(
    source: &str,
    evaluation: &Evaluation,
    figures: &[(&str, Vec<(String, String)>)],
) -> String {
    let title = "Poses against the truth";
    let has_measurements = evaluation.bins.iter().any(|bin| bin.measurement.is_some());
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (title) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                h1 { (title) }
                p { (source) }
                (summary(evaluation))
                h3 { "Published poses of measured frames" }
                (bins(evaluation, |bin| bin.published.as_ref()))
                @if has_measurements {
                    h3 { "The frames' own measurements" }
                    (bins(evaluation, |bin| bin.measurement.as_ref()))
                }
                (consistency(evaluation))
                (false_poses(evaluation))
                @for (name, drawings) in figures {
                    h2 { (name) }
                    @for (drawing, caption) in drawings {
                        figure { (PreEscaped(drawing)) figcaption { (caption) } }
                    }
                }
                script { (PreEscaped(SCRIPT)) }
            }
        }
    };
    page.into_string()
}

fn summary(evaluation: &Evaluation) -> Markup {
    html! {
        p {
            (evaluation.measured) " poses were measured, " (evaluation.sources.decoded)
            " by decoded markers and " (evaluation.sources.aligned) " by alignment; "
            (evaluation.coasted.count) " were only predicted."
            @if let Some(errors) = &evaluation.coasted.errors {
                @let spread = &errors.position_mm;
                " The predicted ones are off by " (fixed(spread.median, 1)) " mm in the median, "
                (fixed(spread.p95, 1)) " mm at 95 %, " (fixed(spread.worst, 1)) " mm at worst."
            }
            @if let Some(latency) = &evaluation.latency {
                " The latency is " (fixed(latency.median_ms, 1)) " ms in the median, "
                (fixed(latency.p95_ms, 1)) " ms at 95 %, " (fixed(latency.p99_ms, 1)) " ms at 99 %."
            }
            " Bodies are eligible if they are localisable with two or more markers wholly visible."
        }
    }
}

/// The columns of [`bins`]: heading and titles of each group.
const GROUPS: [(&str, &[&str]); 7] = [
    ("", &["distance, m", "eligible", "measured", "share"]),
    ("position, mm", &["mean", "median", "95 %", "worst"]),
    ("along, mm", &["median", "bias"]),
    ("across, mm", &["median"]),
    ("distance, mm", &["mean", "bias"]),
    ("bearing, °", &["median", "95 %"]),
    ("rotation, °", &["median", "95 %", "worst"]),
];

fn bins<'a>(evaluation: &'a Evaluation, errors: impl Fn(&'a Bin) -> Option<&'a Errors>) -> Markup {
    html! {
        div.wide {
            table {
                tr { @for (name, titles) in GROUPS { th colspan=(titles.len()) { (name) } } }
                tr { @for title in GROUPS.iter().flat_map(|(_, titles)| *titles) { th { (title) } } }
                @for bin in evaluation.bins.iter().filter(|bin| bin.eligible > 0) {
                    tr {
                        td { (bin.range()) }
                        td { (bin.eligible) }
                        td { (bin.measured) }
                        td { @if let Some(share) = bin.share() { (fixed(100.0 * share, 1)) " %" } }
                        @for cell in errors(bin).into_iter().flat_map(cells) { td { (cell) } }
                    }
                }
            }
        }
    }
}

/// The error cells of a row of [`bins`], beginning with the position.
fn cells(errors: &Errors) -> [String; 14] {
    [
        fixed(errors.position_mm.mean, 1),
        fixed(errors.position_mm.median, 1),
        fixed(errors.position_mm.p95, 1),
        fixed(errors.position_mm.worst, 1),
        fixed(errors.along_mm.median, 1),
        format!("{:+.1}", errors.along_bias_mm),
        fixed(errors.across_mm.median, 1),
        fixed(errors.distance_mm.mean, 1),
        format!("{:+.1}", errors.distance_bias_mm),
        fixed(errors.bearing_deg.median, 3),
        fixed(errors.bearing_deg.p95, 3),
        fixed(errors.rotation_deg.median, 2),
        fixed(errors.rotation_deg.p95, 2),
        fixed(errors.rotation_deg.worst, 2),
    ]
}

fn consistency(evaluation: &Evaluation) -> Markup {
    let nees = &evaluation.nees;
    let rows: Vec<(&str, &Consistency)> = [
        ("measurements", &nees.measurements),
        ("tracks", &nees.tracks),
        ("predicted only", &nees.coasted),
    ]
    .into_iter()
    .filter_map(|(what, consistency)| Some((what, consistency.as_ref()?)))
    .collect();
    html! {
        @if !rows.is_empty() {
            h3 { "Errors against their covariances" }
            p {
                "The mean of the normalised estimation errors squared (NEES) of 3 degrees of freedom \
                 should be 3. Errors of consecutive frames are correlated. The bounds hold with 95 % \
                 for the number of independent samples that these are worth."
            }
            div.wide {
                table {
                    tr {
                        @for title in ["of", "mean", "bounds", "median", "samples", "worth", ""] {
                            th { (title) }
                        }
                    }
                    @for (what, Consistency { position, rotation }) in rows {
                        (consistency_row(what, "position", position))
                        (consistency_row(what, "rotation", rotation))
                    }
                }
            }
        }
    }
}

fn consistency_row(what: &str, part: &str, nees: &Nees) -> Markup {
    html! {
        tr {
            td { (what) ", " (part) }
            td { (fixed(nees.mean, 2)) }
            td { (fixed(nees.low, 2)) " to " (fixed(nees.high, 2)) }
            td { (fixed(nees.median, 2)) }
            td { (nees.samples) }
            td { (fixed(nees.effective_samples, 0)) }
            td { (nees.verdict.text()) }
        }
    }
}

fn false_poses(evaluation: &Evaluation) -> Markup {
    html! {
        h3 { "False poses: " (evaluation.false_poses) }
        p {
            "Measurements that are wrong by more than " (fixed(FALSE_POSITION_M * 100.0, 0)) " cm or "
            (fixed(FALSE_ROTATION_RAD.to_degrees(), 0)) "°, or of a body that is not there."
        }
        ul {
            @for at in &evaluation.false_at {
                li {
                    "frame " (at.frame) ": " (at.target)
                    @if let (Some(position_m), Some(rotation_deg)) = (at.position_m, at.rotation_deg) {
                        " is off by " (fixed(position_m, 3)) " m and " (fixed(rotation_deg, 1)) "°"
                    } @else {
                        " is not there"
                    }
                }
            }
        }
    }
}

/// A number with `decimals` decimals.
fn fixed(number: f64, decimals: usize) -> String {
    format!("{number:.decimals$}")
}
