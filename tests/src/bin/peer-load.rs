//! Measures how many drones a router and a machine can serve: `peer-load [SECONDS]
//! [OBSERVERS[@HZ]...]` prints a table. With a rate the router limits the reports of each observer
//! to each other one.
//!
//! Each observer is a process and a client of the router. It reports one neighbour 30 times a
//! second and receives the reports of all others. All observers and the router share this machine's
//! processors.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use flockeye_contract::wire::{
    FRAME_SCHEMA, FrameReport, Measurement, Predicted, TargetReport, frame_key,
};
use flockeye_contract::{MeasuredBy, TrackState};
use flockeye_geometry::statistics::{median, quantile};
use flockeye_network::{
    Network, NetworkMode, NetworkParameters, monotonic_now_ns, utc_from_monotonic,
};
use flockeye_require::loopback::{free_port, tcp};
use flockeye_require::python::Running;
use flockeye_tests::ticks_of;

/// Time between two reports.
const PERIOD: Duration = Duration::from_nanos(33_333_333);
/// Numbers of observers, with the rate limit between each two.
const LOADS: [&str; 9] = ["2", "4", "8", "16", "24", "32", "48", "64", "32@10"];
/// Name of the swarm.
const SWARM: &str = "load";
/// Reports in this first time are not counted: links and tokens are being set up.
const WARM_UP: Duration = Duration::from_secs(3);
/// Size of the queue of received reports.
const WAITING: usize = 65_536;
/// Clock ticks of /proc per second.
const TICKS: f64 = 100.0;
/// First argument of an observer's process.
const OBSERVER: &str = "observer";

fn main() -> anyhow::Result<()> {
    let mut arguments: Vec<String> = std::env::args().skip(1).collect();
    if let [first, number, endpoint, seconds] = &arguments[..]
        && first == OBSERVER
    {
        return observe(number.parse()?, endpoint, Duration::from_secs(seconds.parse()?));
    }
    let seconds = if arguments.is_empty() { 10 } else { arguments.remove(0).parse()? };
    if arguments.is_empty() {
        arguments = LOADS.map(str::to_owned).to_vec();
    }
    let bytes = |targets| Ok::<_, anyhow::Error>(report("drone-0", 1, targets).to_json()?.len());
    println!("a report of one neighbour has {} bytes, one of two {}", bytes(1)?, bytes(2)?);
    println!("observers  heard/s   of all  ms median     95 %     99 %  processors, peers  router");
    for load in arguments {
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
    let router = Command::new(program).arg(&endpoint).args(downsampling).spawn();
    let router = Running(router.context("the router")?);
    let mut observers = (0..count)
        .map(|number| Process::start(number, &endpoint, time))
        .collect::<anyhow::Result<Vec<_>>>()?;
    // All observers are ready before the first one sends a report.
    observers.iter_mut().try_for_each(Process::wait_until_ready)?;
    let begin_ns = monotonic_now_ns() + 100_000_000;
    observers.iter_mut().try_for_each(|observer| observer.begin(begin_ns))?;
    let at = |after: Duration| {
        std::thread::sleep(after);
        ticks_of(router.0.id())
    };
    let before = at(WARM_UP)?;
    let router_ticks = at(time)? - before;
    let heard: Vec<Heard> =
        observers.iter_mut().map(Process::result).collect::<anyhow::Result<_>>()?;
    let mut took_ms: Vec<f64> =
        heard.iter().flat_map(|heard| heard.took_ms.iter().map(|ms| f64::from(*ms))).collect();
    took_ms.sort_by(f64::total_cmp);
    let wanted = heard.iter().map(|heard| heard.sent).sum::<u64>() * (count as u64 - 1);
    let processors = |ticks: f64| ticks / TICKS / time.as_secs_f64();
    println!(
        "{load:>9} {:>8.0} {:>6.1} % {:>10.2} {:>8.2} {:>8.2} {:>18.2} {:>7.2}",
        took_ms.len() as f64 / time.as_secs_f64(),
        100.0 * took_ms.len() as f64 / wanted as f64,
        median(&took_ms).unwrap_or(f64::NAN),
        quantile(&took_ms, 0.95).unwrap_or(f64::NAN),
        quantile(&took_ms, 0.99).unwrap_or(f64::NAN),
        processors(heard.iter().map(|heard| heard.ticks).sum()),
        processors(router_ticks),
    );
    Ok(())
}

/// The process of an observer.
struct Process {
    child: Running,
    output: BufReader<std::process::ChildStdout>,
}

/// The counts of an observer.
struct Heard {
    /// Number of sent reports.
    sent: u64,
    /// Processor time, clock ticks.
    ticks: f64,
    /// Latency of each received report, milliseconds.
    took_ms: Vec<f32>,
}

impl Process {
    fn start(number: usize, endpoint: &str, time: Duration) -> anyhow::Result<Self> {
        let mut child = Command::new(std::env::current_exe()?)
            .args([OBSERVER, &number.to_string(), endpoint, &time.as_secs().to_string()])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()?;
        let output = BufReader::new(child.stdout.take().context("it is piped")?);
        Ok(Self { child: Running(child), output })
    }

    fn wait_until_ready(&mut self) -> anyhow::Result<()> {
        let mut line = String::new();
        self.output.read_line(&mut line)?;
        if line.is_empty() {
            bail!("an observer has ended before it was ready");
        }
        Ok(())
    }

    fn begin(&mut self, at_ns: i64) -> anyhow::Result<()> {
        let mut input = self.child.0.stdin.take().context("it is piped")?;
        Ok(writeln!(input, "{at_ns}")?)
    }

    fn result(&mut self) -> anyhow::Result<Heard> {
        let mut line = String::new();
        self.output.read_line(&mut line)?;
        let (sent, ticks) = line.trim().split_once(' ').context("an observer has not counted")?;
        let mut bytes = Vec::new();
        self.output.read_to_end(&mut bytes)?;
        let took_ms = bytes.as_chunks().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        Ok(Heard { sent: sent.parse()?, ticks: ticks.parse()?, took_ms })
    }
}

/// Runs one observer: it prints that it is ready, waits for the start, and prints its counts.
fn observe(number: usize, endpoint: &str, time: Duration) -> anyhow::Result<()> {
    let name = name(number);
    let network = Network::open(&NetworkParameters {
        swarm: SWARM.into(),
        observer: name.clone(),
        mode: NetworkMode::Client,
        listen: Vec::new(),
        connect: vec![endpoint.to_owned()],
        ..NetworkParameters::default()
    })?;
    let reporter = network.reporter()?;
    let listener = network.listener()?;
    let stream = listener.stream(WAITING);
    let mut out = std::io::stdout().lock();
    while !network.is_open() {
        std::thread::sleep(Duration::from_millis(10));
    }
    writeln!(out, "ready")?;
    let mut line = String::new();
    std::io::stdin().read_line(&mut line)?;
    let wait_ns = line.trim().parse::<i64>().context("when to begin")? - monotonic_now_ns();
    std::thread::sleep(Duration::from_nanos(wait_ns.max(0) as u64));
    let begun = Instant::now();
    let (mut sent, mut took_ms, mut ticks) = (0_u64, Vec::new(), None);
    let mut frame = 0;
    while begun.elapsed() < WARM_UP + time {
        let is_counted = begun.elapsed() >= WARM_UP;
        if is_counted && ticks.is_none() {
            ticks = Some(ticks_of(std::process::id())?);
        }
        frame += 1;
        reporter.report(report(&name, frame, 1))?;
        sent += u64::from(is_counted);
        // Reports in transit at the end count as lost, a few percent.
        while let Some(left) = (PERIOD * frame as u32).checked_sub(begun.elapsed()) {
            let Some(heard) = stream.recv_timeout(left) else { break };
            if is_counted && heard.report.observer != name {
                let sent_ns = heard.report.stream_s * 1e9;
                took_ms.push((heard.arrived_monotonic_ns as f64 - sent_ns) as f32 * 1e-6);
            }
        }
    }
    let used = ticks_of(std::process::id())? - ticks.unwrap_or(0.0);
    writeln!(out, "{sent} {used}")?;
    took_ms.iter().try_for_each(|ms| out.write_all(&ms.to_le_bytes()))?;
    Ok(())
}

fn name(number: usize) -> String {
    format!("drone-{number}")
}

/// A report of typical size. Its stream time is the time of its creation.
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
        rival: None,
        degenerate: None,
    }
}
