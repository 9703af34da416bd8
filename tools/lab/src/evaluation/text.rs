//! The results as text.

use std::fmt;

use flockeye_cli::text_table::TextTable;
use flockeye_geometry::pose::{FALSE_POSITION_M, FALSE_ROTATION_RAD};

use super::consistency::{Consistency, Nees, NeesVerdict};
use super::error::Errors;
use super::predictions::{PredictionErrors, Predictions};
use super::rotations::RotationEvaluation;
use super::statistics::Spread;
use super::{Bin, Evaluation};

/// Largest number of listed false poses.
const LISTED: usize = 10;

impl Bin {
    /// The range of distances as text.
    pub fn range(&self) -> String {
        self.to_m.map_or("all".to_owned(), |to_m| format!("{:.1} - {to_m:.1}", self.from_m))
    }
}

impl NeesVerdict {
    /// The verdict as text.
    pub fn text(self) -> &'static str {
        match self {
            Self::Consistent => "consistent",
            Self::Optimistic => "optimistic: errors are larger than their covariances say",
            Self::Pessimistic => "pessimistic: errors are smaller than their covariances say",
        }
    }
}

impl Nees {
    /// The statistics as text.
    pub fn text(&self) -> String {
        format!(
            "mean {:.2} (95 %: {:.2} to {:.2}), median {:.2}, {:.1} % inside 99 %, of {} samples worth {:.0} independent ones: {}",
            self.mean,
            self.low,
            self.high,
            self.median,
            100.0 * self.inside_99,
            self.samples,
            self.effective_samples,
            self.verdict.text()
        )
    }
}

impl Spread {
    /// Median, 95 %, 99 % and worst as text, with `digits` decimals.
    fn text(&self, unit: &str, digits: usize) -> String {
        format!(
            "median {:.digits$}{unit}, 95 % {:.digits$}, 99 % {:.digits$}, worst {:.digits$}",
            self.median, self.p95, self.p99, self.worst
        )
    }
}

impl fmt::Display for Predictions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "poses predicted for the time of sending")?;
        for (what, errors) in
            [("measured in their frame", &self.measured), ("predicted only", &self.coasted)]
        {
            if let Some(errors) = errors {
                write!(f, "\n {what}: {errors}")?;
            }
        }
        Ok(())
    }
}

impl fmt::Display for PredictionErrors {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} compared", self.compared)?;
        if self.without_truth > 0 {
            write!(f, ", {} more have no truth around their time", self.without_truth)?;
        }
        if let Some(ahead_ms) = &self.ahead_ms {
            write!(f, "; ahead of the exposure by {}", ahead_ms.text(" ms", 1))?;
        }
        for (what, predicted, held, unit, digits) in [
            ("position", &self.position_mm, &self.held_position_mm, " mm", 1),
            ("rotation", &self.rotation_deg, &self.held_rotation_deg, "°", 2),
        ] {
            if let (Some(predicted), Some(held)) = (predicted, held) {
                write!(
                    f,
                    "\n  {what} error {}; of the exposure's own pose {}",
                    predicted.text(unit, digits),
                    held.text(unit, digits)
                )?;
            }
        }
        if let Some(Consistency { position, rotation }) = &self.nees {
            write!(f, "\n  NEES, position: {}", position.text())?;
            write!(f, "\n  NEES, rotation: {}", rotation.text())?;
        }
        Ok(())
    }
}

impl fmt::Display for RotationEvaluation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "the camera's rotation: known in {} frames, not known in {}; {} compared",
            self.known, self.not_known, self.compared
        )?;
        if let Some(bias) = self.gyroscope_bias_deg_s {
            write!(f, " with a gyroscope, whose bias of {bias:.2} degrees/s is taken out")?;
        }
        for (what, error, stated, nees, unit, digits) in [
            ("error to each frame", &self.error_deg, self.stated_deg, &self.nees, "°", 3),
            (
                "error of the rate",
                &self.rate_error_deg_s,
                self.rate_stated_deg_s,
                &self.rate_nees,
                " degrees/s",
                2,
            ),
        ] {
            if let (Some(error), Some(stated)) = (error, stated) {
                write!(f, "\n  {what} {}; stated {stated:.digits$}", error.text(unit, digits))?;
            }
            if let Some(nees) = nees {
                write!(f, "\n  its NEES: {}", nees.text())?;
            }
        }
        Ok(())
    }
}

/// Titles of the columns of [`columns`].
const TITLES: [&str; 11] = [
    "mean mm",
    "median",
    "95 %",
    "worst",
    "along",
    "bias",
    "across",
    "distance",
    "bearing °",
    "rotation °",
    "95 %",
];

/// Columns of errors. Position: mean, median, 95 %, worst; along the line of sight: median, signed
/// mean; across: median; distance: mean; bearing: median; rotation: median, 95 %.
fn columns(errors: &Errors) -> [String; 11] {
    let mm = |x: f64| format!("{x:.1}");
    let deg = |x: f64| format!("{x:.2}");
    [
        mm(errors.position_mm.mean),
        mm(errors.position_mm.median),
        mm(errors.position_mm.p95),
        mm(errors.position_mm.worst),
        mm(errors.along_mm.median),
        format!("{:+.1}", errors.along_bias_mm),
        mm(errors.across_mm.median),
        mm(errors.distance_mm.mean),
        format!("{:.3}", errors.bearing_deg.median),
        deg(errors.rotation_deg.median),
        deg(errors.rotation_deg.p95),
    ]
}

impl fmt::Display for Evaluation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let titles = [&["distance m", "eligible", "measured", "share"], &TITLES[..]].concat();
        let mut published = TextTable::new(1, &titles);
        for bin in self.bins.iter().filter(|bin| bin.eligible > 0) {
            let share =
                bin.share().map_or(String::new(), |share| format!("{:.1} %", 100.0 * share));
            let counts = [bin.range(), bin.eligible.to_string(), bin.measured.to_string(), share];
            published.row(counts.into_iter().chain(bin.published.iter().flat_map(columns)));
        }
        writeln!(f, "published poses of measured frames\n{}", published.text())?;
        if self.bins.iter().any(|bin| bin.measurement.is_some()) {
            let titles = [&["distance m", "measured"], &TITLES[..]].concat();
            let mut measurements = TextTable::new(1, &titles);
            for bin in &self.bins {
                if let Some(errors) = &bin.measurement {
                    let counts = [bin.range(), errors.count.to_string()];
                    measurements.row(counts.into_iter().chain(columns(errors)));
                }
            }
            writeln!(f, "the frames' own measurements\n{}", measurements.text())?;
        }
        write!(
            f,
            "{} poses measured, {} by decoded markers, {} by alignment; {} predicted only",
            self.measured, self.sources.decoded, self.sources.aligned, self.coasted.count
        )?;
        if let Some(errors) = &self.coasted.errors {
            write!(
                f,
                " (position error median {:.1} mm, 95 % {:.1} mm, worst {:.1} mm)",
                errors.position_mm.median, errors.position_mm.p95, errors.position_mm.worst
            )?;
        }
        if let Some(latency) = &self.latency {
            write!(
                f,
                "\nlatency median {:.1} ms, 95 % {:.1} ms, 99 % {:.1} ms",
                latency.median_ms, latency.p95_ms, latency.p99_ms
            )?;
        }
        for (what, consistency) in [
            ("measurements", &self.nees.measurements),
            ("tracks", &self.nees.tracks),
            ("predicted only", &self.nees.coasted),
        ] {
            if let Some(Consistency { position, rotation }) = consistency {
                write!(f, "\nNEES of {what}, position: {}", position.text())?;
                write!(f, "\nNEES of {what}, rotation: {}", rotation.text())?;
            }
        }
        if let Some(predictions) = &self.predictions {
            write!(f, "\n{predictions}")?;
        }
        write!(
            f,
            "\n{} false (wrong by more than {:.0} cm or {:.0}°, or of a body that is not there)",
            self.false_poses,
            FALSE_POSITION_M * 100.0,
            FALSE_ROTATION_RAD.to_degrees()
        )?;
        for at in self.false_at.iter().take(LISTED) {
            match (at.position_m, at.rotation_deg) {
                (Some(position_m), Some(rotation_deg)) => write!(
                    f,
                    "\n  frame {}: {} is off by {position_m:.3} m and {rotation_deg:.1}°",
                    at.frame, at.target
                )?,
                _ => write!(f, "\n  frame {}: {} is not there", at.frame, at.target)?,
            }
        }
        match self.false_at.len().saturating_sub(LISTED) {
            0 => Ok(()),
            more => write!(f, "\n  and {more} more"),
        }
    }
}
