//! How many drones one router and one machine carry: `peer-load [SECONDS] [OBSERVERS[@HZ]...]` prints a table. With a
//! rate the router passes reports of each observer on to each other one at most so often.
//!
//! Each observer is a session that reports one neighbour 30 times a second, and hears all others. All of them are in
//! this process, as clients of a router in another one, so both ends and the router share this machine's processors.

use std::collections::BTreeMap;
use std::process::{Child, Command};
use std::time::{Duration, Instant};

use anyhow::Context;
use flockeye_contract::wire::{
    FRAME_SCHEMA, FrameReport, Measurement, Predicted, TargetReport, frame_key,
};
use flockeye_contract::{MeasuredBy, TrackState};
use flockeye_geometry::statistics::{median, quantile};
use flockeye_network::{
    Listener, Network, NetworkMode, NetworkParameters, ReportStream, Reporter, monotonic_now_ns,
    utc_from_monotonic,
};
use flockeye_require::loopback::{free_port, tcp};

/// From report to report.
const PERIOD: Duration = Duration::from_nanos(33_333_333);
/// Observers, and at most how often each hears each other one.
const LOADS: [&str; 9] = ["2", "4", "8", "16", "24", "32", "48", "64", "32@10"];
/// Its name.
const SWARM: &str = "load";
/// Reports before these are not counted: links and tokens are under way.
const WARM_UP: Duration = Duration::from_secs(3);
/// Reports that may wait to be counted.
const WAITING: usize = 65_536;
/// Clock ticks in a second, of /proc.
const TICKS: f64 = 100.0;

/// One observer.
struct Observer {
    name: String,
    reporter: Reporter,
    stream: ReportStream,
    _listener: Listener,
}

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let seconds = arguments.next().map_or(Ok(10), |text| text.parse())?;
    let mut loads: Vec<String> = arguments.collect();
    if loads.is_empty() {
        loads = LOADS.map(str::to_owned).to_vec();
    }
    let bytes = |targets| Ok::<_, anyhow::Error>(report("drone-0", 1, targets).to_json()?.len());
    println!("a report of one neighbour has {} bytes, one of two {}", bytes(1)?, bytes(2)?);
    println!("observers  heard/s   of all  ms median     95 %     99 %  processors, peers  router");
    for load in loads {
        measure(&load, Duration::from_secs(seconds))?;
    }
    Ok(())
}

fn measure(load: &str, time: Duration) -> anyhow::Result<()> {
    let (count, rate_hz) =
        load.split_once('@').map_or((load, None), |(count, hz)| (count, Some(hz)));
    let count = count.parse()?;
    let endpoint = tcp(free_port());
    let keys = (0..count).map(|number| frame_key(SWARM, &name(number)));
    let downsampling =
        rate_hz.into_iter().flat_map(|hz| std::iter::once(hz.to_owned()).chain(keys.clone()));
    let program = std::env::current_exe()?.with_file_name("zenoh-router");
    let mut router =
        Command::new(program).arg(&endpoint).args(downsampling).spawn().context("the router")?;
    let outcome = measure_through(&mut router, &endpoint, load, count, time);
    router.kill()?;
    router.wait()?;
    outcome
}

fn measure_through(
    router: &mut Child,
    endpoint: &str,
    load: &str,
    count: usize,
    time: Duration,
) -> anyhow::Result<()> {
    let observers: Vec<Observer> =
        (0..count).map(|number| observer(number, endpoint)).collect::<anyhow::Result<_>>()?;
    let begun = Instant::now();
    let (mut sent, mut took_ms) = (0_u64, Vec::new());
    let mut ticks = BTreeMap::new();
    let pids = [std::process::id(), router.id()];
    let mut frame = 0;
    while begun.elapsed() < WARM_UP + time {
        let is_counted = begun.elapsed() >= WARM_UP;
        if is_counted && ticks.is_empty() {
            ticks =
                pids.iter().map(|&pid| Ok((pid, ticks_of(pid)?))).collect::<anyhow::Result<_>>()?;
            observers.iter().for_each(|observer| while observer.stream.try_recv().is_some() {});
        }
        frame += 1;
        for observer in &observers {
            observer.reporter.report_frame(report(&observer.name, frame, 1))?;
            sent += u64::from(is_counted);
        }
        // What is still under way at the end counts as lost: a few in each hundred.
        while begun.elapsed() < PERIOD * frame as u32 {
            for observer in &observers {
                while let Some(heard) = observer.stream.try_recv() {
                    if is_counted && heard.report.observer != observer.name {
                        let sent_ns = heard.report.stream_s * 1e9;
                        took_ms.push((heard.arrived_monotonic_ns as f64 - sent_ns) * 1e-6);
                    }
                }
            }
            std::thread::sleep(Duration::from_millis(1));
        }
    }
    let used = pids.map(|pid| {
        let before = ticks.get(&pid).copied().unwrap_or(0.0);
        ticks_of(pid).map(|now| (now - before) / TICKS / time.as_secs_f64())
    });
    let [peers, router] = used;
    let wanted = sent * (count as u64 - 1);
    took_ms.sort_by(f64::total_cmp);
    println!(
        "{load:>9} {:>8.0} {:>6.1} % {:>10.2} {:>8.2} {:>8.2} {:>18.2} {:>7.2}",
        took_ms.len() as f64 / time.as_secs_f64(),
        100.0 * took_ms.len() as f64 / wanted as f64,
        median(&took_ms).unwrap_or(f64::NAN),
        quantile(&took_ms, 0.95).unwrap_or(f64::NAN),
        quantile(&took_ms, 0.99).unwrap_or(f64::NAN),
        peers?,
        router?,
    );
    Ok(())
}

fn name(number: usize) -> String {
    format!("drone-{number}")
}

fn observer(number: usize, endpoint: &str) -> anyhow::Result<Observer> {
    let name = name(number);
    let network = Network::open(&NetworkParameters {
        swarm: SWARM.into(),
        observer: name.clone(),
        mode: NetworkMode::Client,
        listen: Vec::new(),
        connect: vec![endpoint.to_owned()],
        ..NetworkParameters::default()
    })?;
    let listener = network.listener()?;
    let stream = listener.stream(WAITING);
    Ok(Observer { name, reporter: network.reporter()?, stream, _listener: listener })
}

/// A report of a usual size. Its stream's time is when it was made.
fn report(observer: &str, frame: u64, targets: usize) -> FrameReport {
    let now_ns = monotonic_now_ns();
    FrameReport {
        schema: FRAME_SCHEMA.into(),
        observer: observer.into(),
        frame,
        epoch: 0,
        stamp_utc_ns: utc_from_monotonic(now_ns).0,
        clock_synchronised: false,
        stream_s: now_ns as f64 * 1e-9,
        latency_ms: 0.0,
        odometry: None,
        clocks: BTreeMap::new(),
        targets: (0..targets).map(target).collect(),
    }
}

fn target(number: usize) -> TargetReport {
    let mut covariance = [0.0; 21];
    [0, 6, 11, 15, 18, 20].iter().for_each(|&k| covariance[k] = 1.234e-6);
    let (position, orientation) = ([1.234_567, -0.987_654, 0.123_456], [0.0, 0.0, 0.6, 0.8]);
    TargetReport {
        name: name(number),
        state: TrackState::Confirmed,
        measured_by: MeasuredBy::Aligned,
        markers: 3,
        unseen_s: 0.0,
        position,
        orientation,
        covariance,
        linear_velocity: [0.123, 0.456, 0.789],
        angular_velocity: [0.012, 0.034, 0.056],
        measured: Some(Measurement { position, orientation, covariance }),
        predicted: Some(Predicted {
            after_s: 0.023_456,
            position,
            orientation,
            deviations: [0.001_23, 0.001_23, 0.001_23, 0.0123, 0.0123, 0.0123],
        }),
        degenerate: None,
    }
}

/// Processor time that a process has used.
fn ticks_of(pid: u32) -> anyhow::Result<f64> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat"))?;
    // After the name, which may hold blanks: user and system time are the 12th and 13th.
    let fields = stat.rsplit_once(')').context("no such line")?.1;
    let ticks = fields.split_whitespace().skip(11).take(2).map(str::parse::<f64>);
    Ok(ticks.sum::<Result<f64, _>>()?)
}
