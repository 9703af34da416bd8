//! What the stages and the neighbours are doing: gathered from health, tracks and truth, shown as a
//! table, as a line, and as a summary at the end.

mod report;

use std::collections::{BTreeMap, VecDeque};
use std::fmt::Write;

use flockeye_contract::{
    BodyTruth, FrameStamp, Health, StageName, StageState, Track, TrackState, TruthHeader,
};
use nalgebra::Vector3;

use crate::evaluation::statistics::quantile;
use crate::sweep::SweepReport;
pub use report::{LatencyReport, NeighbourReport, Report, StageReport};

/// A stage that says nothing for this long is not well, nanoseconds.
const SILENCE_NS: i64 = 2_000_000_000;

/// Frames whose truth is kept until their tracks come.
const TRUTH_FRAMES: usize = 256;

/// Everything that is shown.
#[derive(Default)]
pub struct Dashboard {
    stages: BTreeMap<(String, u32), StageView>,
    neighbours: BTreeMap<String, Neighbour>,
    truths: VecDeque<(FrameStamp, Vec<BodyTruth>)>,
    frames_ended: u64,
    frames_skipped: u64,
    last_frame: Option<FrameStamp>,
    has_truth: bool,
    sphere: Option<SweepReport>,
}

struct StageView {
    last: Health,
    taken_per_s: f64,
    published_per_s: f64,
    processor_share: f64,
    latency_median_ns: i64,
    latency_p99_ns: i64,
}

#[derive(Default)]
struct Neighbour {
    last: Option<(Track, i64)>,
    /// The frame that `last` is of.
    stamp: Option<FrameStamp>,
    error_m: Option<f64>,
    measured: u64,
    coasted: u64,
    eligible: u64,
    eligible_measured: u64,
    /// Frames it was measured in that have not ended: only ended ones are counted as localisable.
    open: Vec<FrameStamp>,
    errors_mm: Samples,
    latencies_ms: Samples,
}

/// The newest values of something, so that a long flight does not fill the memory.
#[derive(Default)]
struct Samples(VecDeque<f64>);

/// An hour of frames.
const MAX_SAMPLES: usize = 108_000;

impl Samples {
    fn add(&mut self, value: f64) {
        if self.0.len() == MAX_SAMPLES {
            self.0.pop_front();
        }
        self.0.push_back(value);
    }

    fn quantiles<const N: usize>(&self, shares: [f64; N]) -> Option<[f64; N]> {
        let mut sorted: Vec<_> = self.0.iter().copied().collect();
        sorted.sort_by(f64::total_cmp);
        let found: Vec<f64> = shares.iter().filter_map(|&share| quantile(&sorted, share)).collect();
        found.try_into().ok()
    }
}

impl Dashboard {
    /// A stage has reported.
    pub fn health(&mut self, health: &Health) {
        let key = (health.stage.to_string(), health.replica);
        let view = self.stages.entry(key).or_insert_with(|| StageView {
            last: *health,
            taken_per_s: 0.0,
            published_per_s: 0.0,
            processor_share: 0.0,
            latency_median_ns: -1,
            latency_p99_ns: -1,
        });
        let seconds = (health.sent_ns - view.last.sent_ns) as f64 * 1e-9;
        if health.pid == view.last.pid && seconds > 0.1 {
            // Averaged over some reports, so that the numbers can be read.
            let rate = |now: u64, before: u64| now.saturating_sub(before) as f64 / seconds;
            let blend = |old: f64, new: f64| old + 0.3 * (new - old);
            view.taken_per_s = blend(view.taken_per_s, rate(health.taken, view.last.taken));
            view.published_per_s =
                blend(view.published_per_s, rate(health.published, view.last.published));
            let share = rate(health.processor_ns, view.last.processor_ns) * 1e-9;
            view.processor_share = blend(view.processor_share, share);
        }
        if health.latency_median_ns >= 0 {
            view.latency_median_ns = health.latency_median_ns;
            view.latency_p99_ns = health.latency_p99_ns;
        }
        view.last = *health;
    }

    /// The state that a stage reported last, if it ever did.
    pub fn state_of(&self, stage: &str, replica: u32) -> Option<StageState> {
        let view = self.stages.get(&(stage.to_owned(), replica))?;
        StageState::try_from(view.last.state).ok()
    }

    /// How long a process has not reported, nanoseconds; `None` if it never did.
    pub fn silence_ns(&self, stage: &str, replica: u32, pid: u32, now_ns: i64) -> Option<i64> {
        let view = self.stages.get(&(stage.to_owned(), replica))?;
        (view.last.pid == pid).then(|| now_ns - view.last.sent_ns)
    }

    /// The truth of a frame.
    pub fn truth(&mut self, header: &TruthHeader, bodies: &[BodyTruth]) {
        self.has_truth = true;
        self.truths.push_back((header.stamp, bodies.to_vec()));
        if self.truths.len() > TRUTH_FRAMES {
            self.truths.pop_front();
        }
    }

    /// How often the sphere is searched.
    pub fn sphere(&mut self, sphere: Option<SweepReport>) {
        self.sphere = sphere;
    }

    /// Tracks that came with a frame.
    pub fn tracks(&mut self, stamp: &FrameStamp, tracks: &[Track], is_last: bool, now_ns: i64) {
        let truth = self.truths.iter().rev().find(|(of, _)| of.is_same_frame(stamp));
        for track in tracks {
            let name = track.name.to_string();
            let body =
                truth.and_then(|(_, bodies)| bodies.iter().find(|body| body.name == track.name));
            let neighbour = self.neighbours.entry(name).or_default();
            neighbour.error_m = body.map(|body| error_m(track, body));
            let is_measured = !matches!(
                TrackState::try_from(track.state),
                Ok(TrackState::Coasting | TrackState::Lost) | Err(_)
            );
            if is_measured {
                neighbour.measured += 1;
                neighbour.latencies_ms.add(track.latency.total_ns as f64 * 1e-6);
                if let Some(error) = neighbour.error_m {
                    neighbour.errors_mm.add(error * 1e3);
                }
                neighbour.open.push(*stamp);
            } else {
                neighbour.coasted += 1;
            }
            if neighbour.stamp.is_none_or(|last| !stamp.is_late_beside(&last)) {
                neighbour.stamp = Some(*stamp);
                neighbour.last = Some((*track, now_ns));
            }
        }
        if is_last {
            self.frames_ended += 1;
            if let Some(last) = self.last_frame.replace(*stamp)
                && (last.source_generation, last.epoch) == (stamp.source_generation, stamp.epoch)
            {
                self.frames_skipped += stamp.sequence.saturating_sub(last.sequence + 1);
            }
            for body in truth.map(|(_, bodies)| bodies.as_slice()).unwrap_or_default() {
                let neighbour = self.neighbours.entry(body.name.to_string()).or_default();
                if is_eligible(body) {
                    neighbour.eligible += 1;
                    let is_measured = neighbour.open.iter().any(|of| of.is_same_frame(stamp));
                    neighbour.eligible_measured += u64::from(is_measured);
                }
            }
            for neighbour in self.neighbours.values_mut() {
                // Frames end in order.
                neighbour.open.retain(|of| of.order() > stamp.order());
            }
        }
    }

    /// How many frames came to their end.
    pub fn frames_ended(&self) -> u64 {
        self.frames_ended
    }

    /// The live table.
    pub fn table(&self, now_ns: i64) -> String {
        let mut text = format!(
            "{:<16} {:<10} {:>7} {:>7} {:>8} {:>8} {:>6} {:>7} {:>7} {:>6} {:>7}  {}\n",
            "stage",
            "state",
            "in/s",
            "out/s",
            "ms",
            "99% ms",
            "queued",
            "dropped",
            "failed",
            "cpu %",
            "MB",
            "with"
        );
        for ((stage, replica), view) in &self.stages {
            let label = if *replica == 0 { stage.clone() } else { format!("{stage}.{replica}") };
            let state = report::state_name(view.last.state, now_ns - view.last.sent_ns);
            let ms =
                |ns: i64| if ns < 0 { "-".to_owned() } else { format!("{:.1}", ns as f64 * 1e-6) };
            text += &format!(
                "{label:<16} {state:<10} {:>7.1} {:>7.1} {:>8} {:>8} {:>6} {:>7} {:>7} {:>6.0} {:>7.0}  {}\n",
                view.taken_per_s,
                view.published_per_s,
                ms(view.latency_median_ns),
                ms(view.latency_p99_ns),
                view.last.queued,
                view.last.dropped,
                view.last.failed,
                view.processor_share * 100.0,
                view.last.resident_bytes as f64 / 1e6,
                view.last.detail,
            );
        }
        text += &format!(
            "{:<16} {:<10} {:>24} {:>8} {:>8} {:>7} {:>8} {:>9}\n",
            "neighbour",
            "state",
            "position m (x y z)",
            "dist m",
            "dev mm",
            "age ms",
            "markers",
            "error mm"
        );
        for (name, neighbour) in &self.neighbours {
            let Some((track, arrived_ns)) = &neighbour.last else { continue };
            let [x, y, z] = track.observer_from_target.position;
            let age_ms = report::age_ms(track, *arrived_ns, now_ns);
            text += &format!(
                "{name:<16} {:<10} {:>24} {:>8.2} {:>8.1} {age_ms:>7.0} {:>8} {:>9}\n",
                state_name(track.state),
                format!("{x:.3} {y:.3} {z:.3}"),
                Vector3::new(x, y, z).norm(),
                deviation_m(track) * 1e3,
                track.markers,
                neighbour.error_m.map_or("-".to_owned(), |error| format!("{:.1}", error * 1e3)),
            );
        }
        if let Some(sphere) = &self.sphere {
            text += &format!("sphere: {sphere}\n");
        }
        text
    }

    /// The same in a line.
    pub fn line(&self, now_ns: i64) -> String {
        let silent: Vec<_> = self
            .stages
            .iter()
            .filter(|(_, view)| now_ns - view.last.sent_ns > SILENCE_NS)
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
                state_name(track.state),
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

    /// What it all came to.
    pub fn summary(&self) -> String {
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
                "\n{name}: measured in {} frames, predicted in {}",
                neighbour.measured, neighbour.coasted
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
            if let Some([median, p95, worst]) = neighbour.errors_mm.quantiles([0.5, 0.95, 1.0]) {
                let _ = write!(
                    text,
                    "; error median {median:.1} mm, 95 % {p95:.1} mm, worst {worst:.1} mm"
                );
            }
            if let Some([median, p99]) = neighbour.latencies_ms.quantiles([0.5, 0.99]) {
                let _ = write!(text, "; latency median {median:.1} ms, 99 % {p99:.1} ms");
            }
        }
        text
    }
}

fn is_eligible(body: &BodyTruth) -> bool {
    body.localisable == 1 && body.markers_visible_90 >= 2
}

fn error_m(track: &Track, body: &BodyTruth) -> f64 {
    let difference = Vector3::from(track.observer_from_target.position)
        - Vector3::from(body.observer_from_target.position);
    difference.norm()
}

/// Root of the position covariance's trace.
fn deviation_m(track: &Track) -> f64 {
    (track.covariance[0] + track.covariance[7] + track.covariance[14]).max(0.0).sqrt()
}

fn state_name(code: u32) -> String {
    TrackState::try_from(code)
        .map_or("unknown".to_owned(), |state| format!("{state:?}").to_lowercase())
}

#[cfg(test)]
mod tests {
    use super::*;
    use flockeye_contract::Pose;

    #[test]
    fn what_is_measured_in_a_frame_that_has_not_ended_is_not_counted() {
        let mut dashboard = Dashboard::default();
        let body = BodyTruth {
            name: "alpha".into(),
            observer_from_target: Pose::default(),
            localisable: 1,
            markers_visible_90: 2,
            ..BodyTruth::default()
        };
        let track = Track {
            name: "alpha".into(),
            state: TrackState::Confirmed.code(),
            ..bytemuck::Zeroable::zeroed()
        };
        for sequence in 0..3 {
            let stamp = FrameStamp { sequence, ..FrameStamp::default() };
            dashboard.truth(&TruthHeader { stamp, ..TruthHeader::default() }, &[body]);
            // Said twice, as where a better word follows; the last frame does not end.
            dashboard.tracks(&stamp, &[track], false, 0);
            dashboard.tracks(&stamp, &[track], sequence < 2, 0);
        }
        let alpha = &dashboard.neighbours["alpha"];
        assert_eq!((alpha.eligible, alpha.eligible_measured), (2, 2));
        assert_eq!(alpha.open.len(), 2, "of the frame that is open");
    }
}
