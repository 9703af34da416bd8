//! The dashboard as text: a live table, a line, and a summary at the end.

use std::collections::VecDeque;
use std::fmt::Write;

use flockeye_cli::text_table::TextTable;
use flockeye_contract::{Health, StageName};
use flockeye_geometry::statistics::{median, quantile};
use nalgebra::Vector3;

use super::{Dashboard, age_ms, deviation_m};
use crate::control::worker_label;

impl Dashboard {
    pub(crate) fn table(&self, now_ns: i64) -> String {
        let titles = [
            "stage", "state", "in/s", "out/s", "ms", "99% ms", "queued", "dropped", "failed",
            "cpu %", "MB", "with",
        ];
        let mut stages = TextTable::new(2, &titles)
            .with_words_in(11)
            .at_least(&[16, 10, 7, 7, 8, 8, 6, 7, 7, 6, 7, 4]);
        for ((stage, replica), view) in &self.stages {
            let latency = view.latency_ms.map(|ms| ms.map(|ms| format!("{ms:.1}")));
            let [median, p99] = latency.unwrap_or_else(|| ["-", "-"].map(str::to_owned));
            stages.row([
                worker_label(stage, *replica),
                view.state(now_ns).to_owned(),
                format!("{:.1}", view.taken_per_s),
                format!("{:.1}", view.published_per_s),
                median,
                p99,
                view.last.queued.to_string(),
                view.last.dropped.to_string(),
                view.last.failed.to_string(),
                format!("{:.0}", view.processor_share * 100.0),
                format!("{:.0}", view.last.resident_bytes as f64 / 1e6),
                view.last.detail.to_string(),
            ]);
        }
        let titles = [
            "neighbour",
            "state",
            "position m (x y z)",
            "dist m",
            "sigma mm",
            "age ms",
            "markers",
            "error mm",
        ];
        let mut neighbours = TextTable::new(2, &titles).at_least(&[16, 10, 24, 8, 8, 7, 8, 9]);
        for (name, neighbour) in &self.neighbours {
            let Some((track, arrived_ns)) = &neighbour.last else { continue };
            let [x, y, z] = track.observer_from_target.position;
            neighbours.row([
                name.clone(),
                track.state_name().to_owned(),
                format!("{x:.3} {y:.3} {z:.3}"),
                format!("{:.2}", Vector3::new(x, y, z).norm()),
                format!("{:.1}", deviation_m(track) * 1e3),
                format!("{:.0}", age_ms(track, *arrived_ns, now_ns)),
                track.markers.to_string(),
                neighbour.error_m.map_or("-".to_owned(), |error| format!("{:.1}", error * 1e3)),
            ]);
        }
        let mut text = format!("{}\n{}\n", stages.text(), neighbours.text());
        if let Some(sphere) = &self.sphere {
            text += &format!("sphere: {sphere}\n");
        }
        text
    }

    /// The newest state in one line.
    pub(crate) fn line(&self, now_ns: i64) -> String {
        let silent: Vec<_> = self
            .stages
            .iter()
            .filter(|(_, view)| view.is_silent(now_ns))
            .map(|((stage, _), _)| stage.as_str())
            .collect();
        let source = self
            .stages
            .iter()
            .find(|((stage, _), _)| StageName::from_name(stage).is_some_and(StageName::is_source));
        let rate = source.map_or(0.0, |(_, view)| view.published_per_s);
        let mut text = format!("{} frames, {rate:.1}/s", self.frames_ended);
        for (name, neighbour) in &self.neighbours {
            let Some((track, _)) = &neighbour.last else { continue };
            let [x, y, z] = track.observer_from_target.position;
            // Writing to a String cannot fail.
            let _ = write!(
                text,
                " | {name} {} {:.3} {:.3} {:.3} m, {} markers, {:.1} ms",
                track.state_name(),
                x,
                y,
                z,
                track.markers,
                track.latency.total_ns as f64 * 1e-6
            );
            if let Some(error) = neighbour.error_m {
                let _ = write!(text, ", error {:.1} mm", error * 1e3);
            }
        }
        if !silent.is_empty() {
            let _ = write!(text, " | silent: {}", silent.join(", "));
        }
        text
    }

    pub(crate) fn summary(&self) -> String {
        let count = |name: &str, of: fn(&Health) -> u64| -> u64 {
            self.stages
                .iter()
                .filter(|((stage, _), _)| stage == name)
                .map(|(_, view)| of(&view.last))
                .sum()
        };
        let mut text = format!(
            "{} frames searched, {} skipped; {} views searched for markers",
            self.frames_ended,
            self.frames_skipped,
            count(StageName::Detection.name(), |health| health.published),
        );
        for (name, neighbour) in &self.neighbours {
            let _ = write!(
                text,
                "\n{name}: measured in {} frames, not in {}",
                neighbour.measured, neighbour.unmeasured
            );
            if self.has_truth && neighbour.eligible > 0 {
                let _ = write!(
                    text,
                    "; {} of {} localisable ({:.1} %)",
                    neighbour.eligible_measured,
                    neighbour.eligible,
                    100.0 * neighbour.eligible_measured as f64 / neighbour.eligible as f64
                );
            }
            let errors_mm = rising(&neighbour.errors_mm);
            if let (Some(median), Some(p95), Some(worst)) =
                (median(&errors_mm), quantile(&errors_mm, 0.95), errors_mm.last())
            {
                let _ = write!(
                    text,
                    "; error median {median:.1} mm, 95 % {p95:.1} mm, worst {worst:.1} mm"
                );
            }
            let latencies_ms = rising(&neighbour.latencies_ms);
            if let (Some(median), Some(p99)) =
                (median(&latencies_ms), quantile(&latencies_ms, 0.99))
            {
                let _ = write!(text, "; latency median {median:.1} ms, 99 % {p99:.1} ms");
            }
        }
        text
    }
}

/// Values in ascending order.
fn rising(samples: &VecDeque<f64>) -> Vec<f64> {
    let mut rising: Vec<_> = samples.iter().copied().collect();
    rising.sort_by(f64::total_cmp);
    rising
}
