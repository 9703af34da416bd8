//! Metrics of one moment.

use std::fmt;
use std::sync::{Arc, Mutex};

use flockeye_contract::{AMBIGUOUS, TrackState};
use flockeye_runtime::health_rates::HealthRates;
use flockeye_runtime::lock::lock;
use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::Unit;

use crate::dashboard::Dashboard;
use crate::dashboard::report::NeighbourReport;
use crate::doctor::Machine;
use crate::doctor::machine::{frequencies_hz, temperatures_c};

/// Label names and values that distinguish the values of a metric.
pub(super) type Labels = Vec<(&'static str, String)>;

/// The states that a track can be shown in.
const TRACK_STATES: [&str; 5] = [
    TrackState::Tentative.name(),
    TrackState::Confirmed.name(),
    TrackState::Coasting.name(),
    AMBIGUOUS,
    TrackState::Lost.name(),
];

/// A metric: counter, which only rises, or gauge, with its name, meaning and labelled values.
#[derive(Debug, Clone)]
pub(super) struct Metric {
    kind: MetricType,
    name: &'static str,
    help: &'static str,
    unit: Option<Unit>,
    values: Vec<(Labels, f64)>,
}

/// A metric of every process: kind, name, meaning, unit and value.
type OfStage = (MetricType, &'static str, &'static str, Option<Unit>, fn(&HealthRates) -> f64);

/// The metrics of a process.
fn of_stages() -> [OfStage; 8] {
    use MetricType::{Counter, Gauge};
    let unfinished = "Messages taken in or given out that are not finished";
    let bad = "Messages that were refused or could not be processed";
    [
        (Counter, "stage_taken", "Messages taken", None, |rates| rates.last.taken as f64),
        (Counter, "stage_published", "Messages given out", None, |rates| {
            rates.last.published as f64
        }),
        (Counter, "stage_dropped", "Messages that were replaced by newer ones", None, |rates| {
            rates.last.dropped as f64
        }),
        (Counter, "stage_failed", bad, None, |rates| rates.last.failed as f64),
        (Counter, "stage_restarts", "How often the process was replaced", None, |rates| {
            f64::from(rates.last.generation)
        }),
        (Counter, "stage_processor", "Processor time used", Some(Unit::Seconds), |rates| {
            rates.last.processor_ns as f64 * 1e-9
        }),
        (Gauge, "stage_queued", unfinished, None, |rates| rates.last.queued as f64),
        (
            Gauge,
            "stage_resident",
            "Resident memory, shared memory included",
            Some(Unit::Bytes),
            |rates| rates.last.resident_bytes as f64,
        ),
    ]
}

/// The values of a dashboard and of this machine now.
pub(super) fn metrics_of(dashboard: &Dashboard, now_ns: i64) -> Vec<Metric> {
    let mut metrics = Vec::from(of_frames(dashboard));
    add_stages(&mut metrics, dashboard, now_ns);
    add_tracks(&mut metrics, dashboard, now_ns);
    add_machine(&mut metrics);
    metrics
}

fn of_frames(dashboard: &Dashboard) -> [Metric; 2] {
    let skipped = "Frames that the source sent and that were not worked on";
    let frames = [
        ("frames", "Frames that have passed through all stages", dashboard.frames_ended),
        ("frames_skipped", skipped, dashboard.frames_skipped),
    ];
    frames.map(|(name, help, value)| Metric {
        kind: MetricType::Counter,
        name,
        help,
        unit: None,
        values: vec![(Vec::new(), value as f64)],
    })
}

fn gauge(
    name: &'static str,
    help: &'static str,
    unit: Option<Unit>,
    values: impl Iterator<Item = (Labels, f64)>,
) -> Metric {
    Metric { kind: MetricType::Gauge, name, help, unit, values: values.collect() }
}

fn add_stages(metrics: &mut Vec<Metric>, dashboard: &Dashboard, now_ns: i64) {
    let stages: Vec<(Labels, &HealthRates)> = dashboard
        .workers()
        .map(|(stage, worker, rates)| {
            (vec![("stage", stage.to_owned()), ("worker", worker.to_string())], rates)
        })
        .collect();
    for (kind, name, help, unit, value) in of_stages() {
        let values = stages.iter().map(|(labels, rates)| (labels.clone(), value(rates)));
        metrics.push(Metric { kind, name, help, unit, values: values.collect() });
    }
    let ready = stages.iter().map(|(labels, rates)| {
        (labels.clone(), f64::from(u8::from(rates.state(now_ns) == "ready")))
    });
    metrics.push(gauge(
        "stage_ready",
        "1 if the process is ready and reports, else 0",
        None,
        ready,
    ));
    let latencies = stages.iter().flat_map(|(labels, rates)| {
        let quantiles = rates.latency_ms.into_iter();
        let quantiles = quantiles.flat_map(|[median, p99]| [("0.5", median), ("0.99", p99)]);
        quantiles.map(|(quantile, ms)| {
            ([&labels[..], &[("quantile", quantile.to_owned())]].concat(), ms * 1e-3)
        })
    });
    metrics.push(gauge(
        "stage_latency",
        "Latency of a process's work in its last report: median and 99 % quantile",
        Some(Unit::Seconds),
        latencies,
    ));
}

fn add_tracks(metrics: &mut Vec<Metric>, dashboard: &Dashboard, now_ns: i64) {
    let report = dashboard.report(now_ns);
    let of = |name: &str| vec![("target", name.to_owned())];
    let states = report.neighbours.iter().flat_map(|neighbour| {
        TRACK_STATES.map(|state| {
            let is_it = f64::from(u8::from(neighbour.state == state));
            let state = vec![("state", state.to_owned())];
            ([of(&neighbour.name), state].concat(), is_it)
        })
    });
    metrics.push(gauge("track_state", "1 for the state of a neighbour's track", None, states));
    let metres = || Some(Unit::Other("meters".to_owned()));
    let distance_m = |neighbour: &NeighbourReport| {
        neighbour.position_m.iter().map(|x| x * x).sum::<f64>().sqrt()
    };
    let each = |value: fn(&NeighbourReport) -> f64| {
        report.neighbours.iter().map(move |n| (vec![("target", n.name.clone())], value(n)))
    };
    metrics.push(gauge("track_distance", "Distance of a neighbour", metres(), each(distance_m)));
    metrics.push(gauge(
        "track_deviation",
        "Standard deviation of a neighbour's position",
        metres(),
        each(|neighbour| neighbour.deviation_m),
    ));
    metrics.push(gauge(
        "track_age",
        "Age of the exposure that a neighbour was last measured in",
        Some(Unit::Seconds),
        each(|neighbour| neighbour.age_ms * 1e-3),
    ));
}

fn add_machine(metrics: &mut Vec<Metric>) {
    let machine = Machine::this();
    let celsius = Some(Unit::Celsius);
    let zones = temperatures_c(&machine).into_iter().map(|(zone, c)| (vec![("zone", zone)], c));
    metrics.push(gauge("temperature", "Temperature of a part of this machine", celsius, zones));
    let hertz = Some(Unit::Other("hertz".to_owned()));
    let clocks = frequencies_hz(&machine).into_iter().map(|(cpu, hz)| (vec![("cpu", cpu)], hz));
    metrics.push(gauge("processor_frequency", "Clock of a processor", hertz, clocks));
}

/// The latest metrics, for the registry.
#[derive(Debug, Clone, Default)]
pub(super) struct LatestMetrics(pub Arc<Mutex<Vec<Metric>>>);

impl Collector for LatestMetrics {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), fmt::Error> {
        for Metric { kind, name, help, unit, values } in &*lock(&self.0) {
            let mut metric = encoder.encode_descriptor(name, help, unit.as_ref(), *kind)?;
            for (labels, value) in values {
                let value_encoder = metric.encode_family(labels)?;
                match kind {
                    MetricType::Counter => ConstCounter::new(*value).encode(value_encoder)?,
                    _ => ConstGauge::new(*value).encode(value_encoder)?,
                }
            }
        }
        Ok(())
    }
}
