//! The page round the figures.

use std::fmt::Write;

use super::flight::SCRIPT;
use crate::evaluation::consistency::{Consistency, Nees};
use crate::evaluation::error::Errors;
use crate::evaluation::{Bin, Evaluation, FALSE_DEG, FALSE_M};
use crate::svg::escaped;

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
.ways { display: grid; grid-template-columns: repeat(auto-fit, minmax(16rem, 1fr)); gap: .5rem }
.turns { cursor: grab; touch-action: none }
polyline { fill: none; stroke-linejoin: round }
polyline.grid { stroke: var(--grid); stroke-width: .8 }
polyline.axis { stroke: var(--soft); stroke-width: 1 }
polyline.truth { stroke: var(--truth); stroke-width: 1.4 }
polyline.pose { stroke: var(--pose); stroke-width: 1.4 }
circle.pose { fill: var(--pose) }
circle.coast { fill: var(--coast) }
";

/// The page: what was compared, what came out, and each body's figures with their captions.
pub(super) fn page(
    source: &str,
    evaluation: &Evaluation,
    figures: &[(&str, Vec<(String, String)>)],
) -> String {
    let mut body = format!("<h1>Poses against the truth</h1>\n<p>{}</p>\n", escaped(source));
    body += &summary(evaluation);
    body += &bins("Published poses of measured frames", evaluation, |bin| bin.published.as_ref());
    if evaluation.bins.iter().any(|bin| bin.measurement.is_some()) {
        body += &bins("The frames' own measurements", evaluation, |bin| bin.measurement.as_ref());
    }
    body += &consistency(evaluation);
    body += &false_poses(evaluation);
    for (name, drawings) in figures {
        body += &format!("<h2>{}</h2>\n", escaped(name));
        for (drawing, caption) in drawings {
            body += &format!("<figure>\n{drawing}<figcaption>{caption}</figcaption>\n</figure>\n");
        }
    }
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <title>Poses against the truth</title>\n<style>{STYLE}</style>\n</head>\n<body>\n{body}\
         <script>{SCRIPT}</script>\n</body>\n</html>\n"
    )
}

fn summary(evaluation: &Evaluation) -> String {
    let mut text = format!(
        "<p>{} poses were measured, {} by decoded markers and {} by alignment; {} were predicted only.",
        evaluation.measured,
        evaluation.sources.decoded,
        evaluation.sources.aligned,
        evaluation.coasted.count
    );
    // Writing to a String cannot fail.
    if let Some(errors) = &evaluation.coasted.errors {
        let spread = &errors.position_mm;
        let _ = write!(
            text,
            " These are off by {:.1} mm in the median, {:.1} mm at 95 %, {:.1} mm at worst.",
            spread.median, spread.p95, spread.worst
        );
    }
    if let Some(latency) = &evaluation.latency {
        let _ = write!(
            text,
            " Poses came {:.1} ms late in the median, {:.1} ms at 95 %, {:.1} ms at 99 %.",
            latency.median_ms, latency.p95_ms, latency.p99_ms
        );
    }
    text + " Eligible is who is localisable with two or more markers wholly visible.</p>\n"
}

fn bins(title: &str, evaluation: &Evaluation, errors: impl Fn(&Bin) -> Option<&Errors>) -> String {
    let mut text = format!(
        "<h3>{title}</h3>\n<div class=\"wide\"><table>\n<tr><th colspan=\"4\">\
         <th colspan=\"4\">position, mm<th colspan=\"2\">along, mm<th colspan=\"1\">across, mm\
         <th colspan=\"2\">distance, mm<th colspan=\"2\">bearing, °<th colspan=\"3\">rotation, °</tr>\n\
         <tr><th>distance, m<th>eligible<th>measured<th>share<th>mean<th>median<th>95 %<th>worst\
         <th>median<th>bias<th>median<th>mean<th>bias<th>median<th>95 %<th>median<th>95 %<th>worst</tr>\n"
    );
    for bin in evaluation.bins.iter().filter(|bin| bin.eligible > 0) {
        let share = bin.share().map_or(String::new(), |share| format!("{:.1} %", 100.0 * share));
        let _ = write!(
            text,
            "<tr><td>{}<td>{}<td>{}<td>{share}",
            bin.range(),
            bin.eligible,
            bin.measured
        );
        if let Some(e) = errors(bin) {
            let millimetres = [
                format!("{:.1}", e.position_mm.mean),
                format!("{:.1}", e.position_mm.median),
                format!("{:.1}", e.position_mm.p95),
                format!("{:.1}", e.position_mm.worst),
                format!("{:.1}", e.along_mm.median),
                format!("{:+.1}", e.along_bias_mm),
                format!("{:.1}", e.across_mm.median),
                format!("{:.1}", e.distance_mm.mean),
                format!("{:+.1}", e.distance_bias_mm),
            ];
            let degrees = [
                format!("{:.3}", e.bearing_deg.median),
                format!("{:.3}", e.bearing_deg.p95),
                format!("{:.2}", e.rotation_deg.median),
                format!("{:.2}", e.rotation_deg.p95),
                format!("{:.2}", e.rotation_deg.worst),
            ];
            for cell in millimetres.iter().chain(&degrees) {
                let _ = write!(text, "<td>{cell}");
            }
        }
        text += "</tr>\n";
    }
    text + "</table></div>\n"
}

fn consistency(evaluation: &Evaluation) -> String {
    let nees = &evaluation.nees;
    let rows = [
        ("measurements", &nees.measurements),
        ("tracks", &nees.tracks),
        ("predicted only", &nees.coasted),
    ];
    if rows.iter().all(|(_, consistency)| consistency.is_none()) {
        return String::new();
    }
    let mut text = "<h3>Errors against their covariances</h3>\n\
         <p>The mean of the normalised errors squared (NEES) of 3 degrees of freedom should be 3. Its \
         bounds hold with 95 % for so many independent samples as tell as much as these, whose \
         errors go together from frame to frame.</p>\n\
         <div class=\"wide\"><table>\n<tr><th>of<th>mean<th>bounds<th>median<th>samples<th>worth<th></tr>\n"
        .to_owned();
    for (what, consistency) in rows {
        if let Some(Consistency { position, rotation }) = consistency {
            for (part, nees) in [("position", position), ("rotation", rotation)] {
                text += &consistency_row(&format!("{what}, {part}"), nees);
            }
        }
    }
    text + "</table></div>\n"
}

fn consistency_row(what: &str, nees: &Nees) -> String {
    format!(
        "<tr><td>{what}<td>{:.2}<td>{:.2} to {:.2}<td>{:.2}<td>{}<td>{:.0}<td>{}</tr>\n",
        nees.mean,
        nees.low,
        nees.high,
        nees.median,
        nees.samples,
        nees.effective_samples,
        nees.verdict.text()
    )
}

fn false_poses(evaluation: &Evaluation) -> String {
    let mut text = format!(
        "<h3>False poses: {}</h3>\n<p>Measurements that are wrong by more than {:.0} cm or \
         {FALSE_DEG:.0}°, or of a body that is not there.</p>\n<ul>\n",
        evaluation.false_poses,
        FALSE_M * 100.0
    );
    for at in &evaluation.false_at {
        let target = escaped(&at.target);
        let _ = match (at.position_m, at.rotation_deg) {
            (Some(position_m), Some(rotation_deg)) => writeln!(
                text,
                "<li>frame {}: {target} is off by {position_m:.3} m and {rotation_deg:.1}°",
                at.frame
            ),
            _ => writeln!(text, "<li>frame {}: {target} is not there", at.frame),
        };
    }
    text + "</ul>\n"
}
