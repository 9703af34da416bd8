//! Makes trace events from the times in messages.
//!
//! The format is Chrome's "Trace Event Format": processes have threads, threads have slices, and
//! arrows lead from slice to slice. Each stage is a process.
//!
//! | stage | slices |
//! | --- | --- |
//! | the source | each frame, from exposure to publication |
//! | rectification | each frame, and in it each view that is cut |
//! | detection | each view that is searched |
//! | fusion | each neighbour's pose |

use std::collections::{BTreeMap, BTreeSet};

use flockeye_contract::{
    DetectionHeader, FrameEnd, FrameStamp, Health, StageName, Track, TrackHeader,
};
use serde_json::{Value, json};

use crate::control::worker_label;

/// A frame is exposed before the previous one is published, so their slices overlap. Overlapping
/// slices need rows of their own.
const SOURCE_ROWS: u64 = 16;

#[derive(Debug)]
pub(crate) struct Tracer {
    source: &'static str,
    events: Vec<Value>,
    frames: BTreeSet<(u32, u32, u64)>,
    /// Whether exposure times are of this machine's clock.
    is_live: bool,
    /// Names of the processes, by their numbers in the trace.
    processes: BTreeMap<u32, String>,
    /// End of rectification's previous view, for each frame.
    cutting_since_ns: BTreeMap<(u32, u32, u64), i64>,
}

impl Tracer {
    /// Starts without events. `source` is the stage that frames come from. If `is_live`, a frame's
    /// slice starts at its exposure.
    pub(crate) fn new(source: &'static str, is_live: bool) -> Self {
        Self {
            source,
            is_live,
            events: Vec::new(),
            frames: BTreeSet::new(),
            processes: BTreeMap::new(),
            cutting_since_ns: BTreeMap::new(),
        }
    }

    pub(crate) fn frames(&self) -> usize {
        self.frames.len()
    }

    /// Takes a health report of a stage.
    pub(crate) fn health(&mut self, health: &Health) {
        let stage = health.stage.to_string();
        let pid = self.process(&stage, health.replica);
        self.processes
            .insert(pid, format!("{} ({})", worker_label(&stage, health.replica), health.pid));
        self.events.push(json!({
            "name": "queued", "ph": "C", "ts": micros(health.sent_ns), "pid": pid,
            "args": {"queued": health.queued},
        }));
    }

    /// Takes a detection record.
    pub(crate) fn detection(&mut self, header: &DetectionHeader) {
        self.frame(&header.stamp);
        let order = header.stamp.order();
        let view = format!("view {}", header.view_index);
        let args = json!({
            "frame": header.stamp.sequence, "view": header.view_index, "attempt": header.attempt,
            "hits": header.hits, "waited_ms": (header.received_ns - header.issued_ns) as f64 * 1e-6,
        });
        // Views of a frame are cut one after another, and searched in about that order. So this cut
        // began when the previous one ended.
        let since_ns = self.cutting_since_ns.get(&order).copied().unwrap_or(header.taken_ns);
        if header.issued_ns > since_ns {
            self.slice("rectification", 0, 0, &view, since_ns..header.issued_ns, args.clone());
            self.cutting_since_ns.insert(order, header.issued_ns);
        }
        let search = header.received_ns..header.sent_ns;
        self.slice("detection", header.worker, 0, &view, search, args);
        let id = format!("{order:?}/{}", header.view_index);
        self.arrow("s", &id, "rectification", 0, header.issued_ns - 1);
        self.arrow("f", &id, "detection", header.worker, header.received_ns);
    }

    /// Takes a frame's end in rectification.
    pub(crate) fn end(&mut self, end: &FrameEnd) {
        self.frame(&end.stamp);
        self.cutting_since_ns.remove(&end.stamp.order());
        let name = format!("frame {}", end.stamp.sequence);
        let args = json!({"views": end.views_issued, "abandoned": end.views_abandoned});
        self.slice("rectification", 0, 0, &name, end.taken_ns..end.ended_ns, args);
    }

    /// Takes the tracks of a frame.
    pub(crate) fn tracks(&mut self, header: &TrackHeader, tracks: &[Track]) {
        let stamp = &header.stamp;
        self.frame(stamp);
        for track in tracks {
            let latency = &track.latency;
            // In a lossless run the total latency counts from the frame's publication.
            let from_ns = if self.is_live { stamp.exposure_ns } else { stamp.published_ns };
            let out_ns = from_ns + latency.total_ns;
            if latency.fusion_ns < 0 || latency.total_ns < 0 {
                continue;
            }
            let name = track.name.to_string();
            let args = json!({
                "frame": stamp.sequence, "latency_ms": latency.total_ns as f64 * 1e-6,
                "markers": track.markers,
            });
            let span = out_ns - latency.fusion_ns..out_ns;
            self.slice("fusion", 0, track.target, &name, span, args);
        }
    }

    pub(crate) fn finish(mut self) -> Value {
        let named: Vec<Value> = self
            .processes
            .iter()
            .flat_map(|(pid, name)| {
                [
                    json!({"name": "process_name", "ph": "M", "pid": pid, "args": {"name": name}}),
                    json!({
                        "name": "process_sort_index", "ph": "M", "pid": pid,
                        "args": {"sort_index": pid},
                    }),
                ]
            })
            .collect();
        self.events.extend(named);
        json!({"traceEvents": self.events, "displayTimeUnit": "ms"})
    }

    /// Adds the slice of a frame's source, once.
    fn frame(&mut self, stamp: &FrameStamp) {
        if !self.frames.insert(stamp.order()) {
            return;
        }
        let name = format!("frame {}", stamp.sequence);
        let row = (stamp.sequence % SOURCE_ROWS) as u32;
        let exposure_ns = stamp.exposure_ns.min(stamp.published_ns);
        let since_ns = if self.is_live { exposure_ns } else { stamp.published_ns };
        let args = json!({"epoch": stamp.epoch});
        self.slice(self.source, 0, row, &name, since_ns..stamp.published_ns, args);
    }

    fn slice(
        &mut self,
        stage: &str,
        replica: u32,
        row: u32,
        name: &str,
        span_ns: std::ops::Range<i64>,
        args: Value,
    ) {
        let pid = self.process(stage, replica);
        self.events.push(json!({
            "name": name, "cat": stage, "ph": "X", "pid": pid, "tid": row,
            "ts": micros(span_ns.start), "dur": micros((span_ns.end - span_ns.start).max(1)),
            "args": args,
        }));
    }

    fn arrow(&mut self, phase: &str, id: &str, stage: &str, replica: u32, at_ns: i64) {
        let pid = self.process(stage, replica);
        self.events.push(json!({
            "name": "view", "cat": "way", "ph": phase, "id": id, "bp": "e", "pid": pid, "tid": 0,
            "ts": micros(at_ns),
        }));
    }

    /// The number of a process, in the order of the dataflow.
    fn process(&mut self, stage: &str, replica: u32) -> u32 {
        // Only one of the sources runs; both have the first number.
        let mut others = StageName::ALL.into_iter().filter(|other| !other.is_source());
        let rank = match StageName::from_name(stage) {
            Some(name) if name.is_source() => 1,
            // A foreign stage comes last.
            Some(name) => {
                others.position(|other| other == name).map_or(0, |place| place as u32) + 2
            }
            None => others.count() as u32 + 1,
        };
        let pid = 1000 * rank + replica;
        self.processes.entry(pid).or_insert_with(|| worker_label(stage, replica));
        pid
    }
}

/// Trace times are microseconds, with fractions.
fn micros(ns: i64) -> f64 {
    ns as f64 * 1e-3
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stamp(sequence: u64) -> FrameStamp {
        let exposure_ns = 1_000_000_000 + sequence as i64 * 33_000_000;
        let published_ns = exposure_ns + 20_000_000;
        FrameStamp { sequence, exposure_ns, published_ns, ..FrameStamp::default() }
    }

    /// A frame of which two views were cut and searched, and a pose found.
    fn fly(tracer: &mut Tracer, sequence: u64) {
        let stamp = stamp(sequence);
        let taken_ns = stamp.published_ns + 100_000;
        for view_index in 0..2 {
            let issued_ns = taken_ns + 2_000_000 * i64::from(view_index + 1);
            tracer.detection(&DetectionHeader {
                stamp,
                taken_ns,
                issued_ns,
                received_ns: issued_ns + 50_000,
                sent_ns: issued_ns + 5_000_000,
                view_index,
                worker: view_index,
                ..DetectionHeader::default()
            });
        }
        let latency = flockeye_contract::StageLatency {
            capture_ns: 20_000_000,
            fusion_ns: 1_000_000,
            total_ns: 30_000_000,
            ..Default::default()
        };
        let track = Track { latency, name: "alpha".into(), ..bytemuck::Zeroable::zeroed() };
        tracer.tracks(&TrackHeader { stamp, generation: 0, is_last: 1 }, &[track]);
        let ended_ns = taken_ns + 4_100_000;
        tracer.end(&FrameEnd { stamp, taken_ns, ended_ns, views_issued: 2, ..FrameEnd::default() });
    }

    #[test]
    fn slices_of_a_row_lie_in_each_other_or_apart() {
        let mut tracer = Tracer::new("simulator", true);
        (0..5).for_each(|sequence| fly(&mut tracer, sequence));
        assert_eq!(tracer.frames(), 5);
        let trace = tracer.finish();
        let events = trace["traceEvents"].as_array().expect("a list");
        let mut rows: BTreeMap<(u64, u64), Vec<(f64, f64)>> = BTreeMap::new();
        for event in events.iter().filter(|event| event["ph"] == "X") {
            let number = |key: &str| event[key].as_u64().expect("a number");
            let time = |key: &str| event[key].as_f64().expect("a time");
            let row = rows.entry((number("pid"), number("tid"))).or_default();
            row.push((time("ts"), time("ts") + time("dur")));
        }
        assert_eq!(rows.keys().filter(|(pid, _)| *pid == 1000).count(), 5, "source rows");
        assert!(rows.contains_key(&(5001, 0)), "the second worker");
        for ((pid, row), slices) in rows {
            for (k, one) in slices.iter().enumerate() {
                for other in &slices[..k] {
                    let apart = one.1 <= other.0 + 1e-6 || other.1 <= one.0 + 1e-6;
                    let within = |a: &(f64, f64), b: &(f64, f64)| a.0 >= b.0 && a.1 <= b.1;
                    let nested = within(one, other) || within(other, one);
                    assert!(apart || nested, "{pid}/{row}: {one:?} and {other:?}");
                }
            }
        }
    }

    #[test]
    fn every_arrow_begins_and_ends_in_a_slice() {
        let mut tracer = Tracer::new("capture", true);
        fly(&mut tracer, 3);
        let trace = tracer.finish();
        let events = trace["traceEvents"].as_array().expect("a list");
        let arrows: Vec<&Value> = events.iter().filter(|event| event["cat"] == "way").collect();
        assert_eq!(arrows.len(), 4);
        for arrow in arrows {
            let at = arrow["ts"].as_f64().expect("a time");
            let holds = events.iter().any(|event| {
                let begin = event["ts"].as_f64().unwrap_or(f64::INFINITY);
                event["ph"] == "X"
                    && event["pid"] == arrow["pid"]
                    && begin <= at
                    && at <= begin + event["dur"].as_f64().unwrap_or(0.0)
            });
            assert!(holds, "{arrow}");
        }
        let ids: BTreeSet<&str> = events.iter().filter_map(|event| event["id"].as_str()).collect();
        assert_eq!(ids.len(), 2, "one for each view");
    }

    #[test]
    fn lossless_frames_are_published_not_exposed() {
        let mut tracer = Tracer::new("capture", false);
        fly(&mut tracer, 3);
        let trace = tracer.finish();
        let first = trace["traceEvents"][0].clone();
        assert_eq!(first["name"], "frame 3");
        assert_eq!(first["ts"].as_f64(), Some(micros(stamp(3).published_ns)));
    }
}
