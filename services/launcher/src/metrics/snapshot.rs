//! What there was at one moment, as metrics.

use std::fmt;
use std::sync::{Arc, Mutex};

use flockeye_contract::TrackState;
use flockeye_runtime::lock::lock;
use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric, MetricEncoder};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::Unit;

use super::Labels;
use crate::dashboard::Dashboard;

/// The states that a track can be shown in.
const TRACK_STATES: [TrackState; 4] =
    [TrackState::Tentative, TrackState::Confirmed, TrackState::Coasting, TrackState::Lost];

/// A value with its labels.
type Value<T> = (Labels, T);

/// A counter of each process: its name, what it counts, and its values.
#[derive(Debug, Clone)]
struct Counter {
    name: &'static str,
    help: &'static str,
    unit: Option<Unit>,
    values: Vec<Value<f64>>,
}

/// A gauge, as [`Counter`].
#[derive(Debug, Clone)]
struct Gauge {
    name: &'static str,
    help: &'static str,
    unit: Option<Unit>,
    values: Vec<Value<f64>>,
}

/// What there was at one moment.
#[derive(Debug, Clone, Default)]
pub struct Snapshot {
    frames: u64,
    counters: Vec<Counter>,
    gauges: Vec<Gauge>,
}

impl Snapshot {
    /// What a dashboard and this machine say now.
    pub fn of(dashboard: &Dashboard, now_ns: i64) -> Self {
        let mut snapshot = Self { frames: dashboard.frames_ended(), ..Self::default() };
        snapshot.add_frames(dashboard);
        snapshot.add_stages(dashboard, now_ns);
        snapshot.add_tracks(dashboard, now_ns);
        snapshot.add_machine();
        snapshot
    }

    fn counter(&mut self, name: &'static str, help: &'static str, values: Vec<Value<f64>>) {
        self.counters.push(Counter { name, help, unit: None, values });
    }

    fn gauge(
        &mut self,
        name: &'static str,
        help: &'static str,
        unit: Option<Unit>,
        values: Vec<Value<f64>>,
    ) {
        self.gauges.push(Gauge { name, help, unit, values });
    }

    fn add_frames(&mut self, dashboard: &Dashboard) {
        let alone = |value: u64| vec![(Vec::new(), value as f64)];
        self.counter("frames", "Frames that have passed through all stages", alone(self.frames));
        self.counter(
            "frames_skipped",
            "Frames that the source sent and that were not worked on",
            alone(dashboard.frames_skipped()),
        );
    }

    fn add_stages(&mut self, dashboard: &Dashboard, now_ns: i64) {
        let stages: Vec<_> = dashboard
            .workers()
            .map(|(stage, worker, rates)| {
                let labels = vec![("stage", stage.to_owned()), ("worker", worker.to_string())];
                (labels, rates.clone())
            })
            .collect();
        let each = |value: &dyn Fn(&flockeye_runtime::health_rates::HealthRates) -> f64| {
            stages.iter().map(|(labels, rates)| (labels.clone(), value(rates))).collect::<Vec<_>>()
        };
        self.counter(
            "stage_taken",
            "Messages that a process took",
            each(&|rates| rates.last.taken as f64),
        );
        self.counter(
            "stage_published",
            "Messages that a process gave out",
            each(&|rates| rates.last.published as f64),
        );
        self.counter(
            "stage_dropped",
            "Messages that were replaced by newer ones",
            each(&|rates| rates.last.dropped as f64),
        );
        self.counter(
            "stage_failed",
            "Messages that were refused or could not be processed",
            each(&|rates| rates.last.failed as f64),
        );
        self.counter(
            "stage_restarts",
            "How often a worker's process was replaced",
            each(&|rates| f64::from(rates.last.generation)),
        );
        self.counters.push(Counter {
            name: "stage_processor",
            help: "Processor time that a process used",
            unit: Some(Unit::Seconds),
            values: each(&|rates| rates.last.processor_ns as f64 * 1e-9),
        });
        self.gauge(
            "stage_queued",
            "Messages taken in or given out that are not finished",
            None,
            each(&|rates| rates.last.queued as f64),
        );
        self.gauge(
            "stage_resident",
            "Resident memory, shared memory included",
            Some(Unit::Bytes),
            each(&|rates| rates.last.resident_bytes as f64),
        );
        self.gauge(
            "stage_ready",
            "1 if the process is ready and reports, else 0",
            None,
            each(&|rates| f64::from(u8::from(rates.state(now_ns) == "ready"))),
        );
        let latencies = stages.iter().flat_map(|(labels, rates)| {
            let quantiles = rates
                .latency_ms
                .into_iter()
                .flat_map(|[median, p99]| [("0.5", median), ("0.99", p99)]);
            quantiles.map(|(quantile, ms)| {
                let labels = [&labels[..], &[("quantile", quantile.to_owned())]].concat();
                (labels, ms * 1e-3)
            })
        });
        let latencies = latencies.collect();
        self.gauge(
            "stage_latency",
            "Latency of a process's work in its last report: median and 99 % quantile",
            Some(Unit::Seconds),
            latencies,
        );
    }

    fn add_tracks(&mut self, dashboard: &Dashboard, now_ns: i64) {
        let report = dashboard.report(now_ns);
        let of = |name: &str| vec![("target", name.to_owned())];
        let states = report.neighbours.iter().flat_map(|neighbour| {
            TRACK_STATES.map(|state| {
                let state = format!("{state:?}").to_lowercase();
                let is_it = f64::from(u8::from(neighbour.state == state));
                ([of(&neighbour.name), vec![("state", state)]].concat(), is_it)
            })
        });
        let states = states.collect();
        self.gauge("track_state", "1 for the state that a neighbour's track is in", None, states);
        let each = |value: fn(&crate::dashboard::report::NeighbourReport) -> f64| {
            report.neighbours.iter().map(|n| (of(&n.name), value(n))).collect::<Vec<_>>()
        };
        let deviation = each(|neighbour| neighbour.deviation_m);
        let unit = || Some(Unit::Other("meters".to_owned()));
        self.gauge(
            "track_deviation",
            "Standard deviation of a neighbour's position",
            unit(),
            deviation,
        );
        let distance =
            each(|neighbour| neighbour.position_m.iter().map(|x| x * x).sum::<f64>().sqrt());
        self.gauge("track_distance", "Distance of a neighbour", unit(), distance);
        let age = each(|neighbour| neighbour.age_ms * 1e-3);
        self.gauge(
            "track_age",
            "Age of the exposure that a neighbour was last measured in",
            Some(Unit::Seconds),
            age,
        );
    }

    fn add_machine(&mut self) {
        let machine = crate::doctor::Machine::this();
        let temperatures = crate::doctor::machine::temperatures_c(&machine);
        let values = temperatures.into_iter().map(|(zone, c)| (vec![("zone", zone)], c)).collect();
        self.gauge(
            "temperature",
            "Temperature of a part of this machine",
            Some(Unit::Celsius),
            values,
        );
        let frequencies = crate::doctor::machine::frequencies_hz(&machine);
        let values = frequencies.into_iter().map(|(cpu, hz)| (vec![("cpu", cpu)], hz)).collect();
        let unit = Some(Unit::Other("hertz".to_owned()));
        self.gauge("processor_frequency", "Clock of a processor", unit, values);
    }
}

/// The latest snapshot, for the registry.
#[derive(Debug, Clone, Default)]
pub struct Latest(Arc<Mutex<Snapshot>>);

impl Latest {
    /// Takes the next one. True: frames have ended since the one before.
    pub fn replace(&self, snapshot: Snapshot) -> bool {
        let mut latest = lock(&self.0);
        let has_gone_on = snapshot.frames > latest.frames;
        *latest = snapshot;
        has_gone_on
    }
}

impl Collector for Latest {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> Result<(), fmt::Error> {
        let snapshot = lock(&self.0);
        for Counter { name, help, unit, values } in &snapshot.counters {
            let metric =
                encoder.encode_descriptor(name, help, unit.as_ref(), MetricType::Counter)?;
            encode_all(metric, values, |value, encoder| ConstCounter::new(value).encode(encoder))?;
        }
        for Gauge { name, help, unit, values } in &snapshot.gauges {
            let metric = encoder.encode_descriptor(name, help, unit.as_ref(), MetricType::Gauge)?;
            encode_all(metric, values, |value, encoder| ConstGauge::new(value).encode(encoder))?;
        }
        Ok(())
    }
}

fn encode_all(
    mut metric: MetricEncoder<'_>,
    values: &[Value<f64>],
    encode: impl Fn(f64, MetricEncoder<'_>) -> Result<(), fmt::Error>,
) -> Result<(), fmt::Error> {
    values.iter().try_for_each(|(labels, value)| encode(*value, metric.encode_family(labels)?))
}
