//! `flockeye top` and `flockeye trace` beside a running pipeline.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::{Duration, Instant};

use flockeye_config::Resolved;
use flockeye_contract::{Detections, Plans, Tracks};
use flockeye_require::loopback::free_port;
use flockeye_tables::sweep::Sweep;
use flockeye_tests::{
    Flight, SMALL_FLIGHT, Scratch, WATCHDOG, onlooker, run, small_flight, succeeds,
};
use rustix::process::{Signal, kill_process};
use serde_json::Value;

#[test]
fn a_running_pipeline_is_watched_and_traced() {
    let mut flight = Flight::with_poses("watched", &[], SMALL_FLIGHT);
    let name = flight.instance.name().to_owned();

    let said = succeeds(&["top", "--instance", &name, "--once", "--json"]);
    let report: Value = serde_json::from_str(said.trim()).expect("one JSON object");
    let stages = report["stages"].as_array().expect("a list");
    let names: BTreeSet<&str> = stages.iter().filter_map(|stage| stage["stage"].as_str()).collect();
    assert_eq!(
        names,
        BTreeSet::from(["detection", "egomotion", "fusion", "rectification", "simulator"])
    );
    for stage in stages {
        assert_eq!(stage["state"], "ready", "{stage}");
        for key in ["published_per_s", "processor_share", "resident_mb"] {
            assert!(stage[key].as_f64().expect("a number") > 0.0, "{key} of {stage}");
        }
        assert!(stage["queued"].is_u64() && stage["dropped"].is_u64(), "{stage}");
        assert!(stage["latency_p99_ms"].as_f64() >= stage["latency_median_ms"].as_f64());
    }
    let egomotion = stages.iter().find(|stage| stage["stage"] == "egomotion").expect("it runs");
    let turning = egomotion["detail"].as_str().expect("words");
    assert!(
        turning.starts_with("turning ") && turning.contains("degrees/s by picture"),
        "{turning}"
    );
    let sphere = &report["sphere"]["partitions"];
    assert!(sphere["views"].as_u64() >= Some(4) && sphere["worst_frames"].is_u64(), "{report}");
    let alpha = &report["neighbours"][0];
    assert_eq!(alpha["name"], "alpha");
    let age_ms = alpha["age_ms"].as_f64().expect("a number");
    assert!(age_ms > 0.0 && age_ms < WATCHDOG.as_secs_f64() * 1e3, "{age_ms}");

    let (is_well, said) = run(&["top", "--instance", &name, "--once"]);
    assert!(is_well && said.contains("rectification") && said.contains("alpha"), "{said}");

    let scratch = Scratch::new("watched");
    let out = scratch.path("trace.json");
    let out = out.to_str().expect("a plain path");
    let (is_well, said) = run(&["trace", "--instance", &name, "--out", out, "--for", "2s"]);
    assert!(is_well && said.contains("frames are in"), "{said}");
    let trace: Value =
        serde_json::from_slice(&std::fs::read(out).expect("it was written")).expect("JSON");
    let events = trace["traceEvents"].as_array().expect("a list");
    // Some frame's way leads through every stage.
    let of = |stage: &str, frame: fn(&Value) -> Option<u64>| -> BTreeSet<u64> {
        let slices = events.iter().filter(|event| event["ph"] == "X" && event["cat"] == stage);
        slices.filter_map(frame).collect()
    };
    let numbered = |event: &Value| event["name"].as_str()?.strip_prefix("frame ")?.parse().ok();
    let noted = |event: &Value| event["args"]["frame"].as_u64();
    let whole: BTreeSet<u64> = [
        of("simulator", numbered),
        of("rectification", numbered),
        of("detection", noted),
        of("fusion", noted),
    ]
    .into_iter()
    .reduce(|one, other| one.intersection(&other).copied().collect())
    .expect("four stages");
    assert!(!whole.is_empty(), "no frame went all the way: {} events", events.len());

    let nowhere = "/nowhere/at/all.json";
    let (is_well, said) = run(&["trace", "--instance", &name, "--out", nowhere]);
    assert!(!is_well && said.contains("cannot write /nowhere/at/all.json"), "{said}");

    flight.end_by(Signal::INT);
}

#[test]
fn check_measures_how_soon_an_untracked_target_is_found() {
    let set = SMALL_FLIGHT.iter().flat_map(|set| ["--set", *set]);
    let arguments: Vec<&str> = ["check", "--measure", "3s"].into_iter().chain(set).collect();
    let said = succeeds(&arguments);
    let measured = said.lines().last().expect("a line");
    for part in ["measured ", "neighbours tracked", "each partition every ", " at most)"] {
        assert!(measured.contains(part), "no {part:?} in:\n{said}");
    }
    let (is_well, said) = run(&["check", "--measure", "0s"]);
    assert!(!is_well && said.contains("no two frames were searched. Cure:"), "{said}");
}

/// Fusion is replaced and knows nobody: its neighbour is untracked and must be found as soon as the
/// sphere is searched once, however slow the machine is. Nothing hides markers in this flight: each
/// frame alone shows enough of it.
#[test]
fn an_untracked_target_is_found_before_the_sphere_is_searched_twice() {
    let set = small_flight(&["simulator.airframes=false"]);
    let mut flight = Flight::with_poses("untracked", &[], &set);
    let pipeline = flight.instance.pipeline().expect("it was written");
    let resolved = Resolved::of(pipeline).expect("the launcher resolved it too");
    let mut sweep = Sweep::of(&resolved).expect("it runs").expect("the mode roi sweeps");
    let mut ports = onlooker::join(&mut flight);
    let mut plans = onlooker::subscribe::<Plans>(&mut flight, &mut ports);
    let mut records = onlooker::subscribe::<Detections>(&mut flight, &mut ports);
    let mut tracks = onlooker::subscribe::<Tracks>(&mut flight, &mut ports);
    let fusion = flight.stages("flockeye-fusion");
    assert_eq!(fusion.len(), 1, "{fusion:?}");
    kill_process(fusion[0], Signal::KILL).expect("it runs");
    let start = Instant::now();
    // The successor receives nothing about frames that were searched while fusion was away. It
    // looks for untracked targets from the first frame that follows a plan of its own.
    let (mut asked, mut first, mut found) = (0, None, None);
    let mut look = || {
        assert!(start.elapsed() < WATCHDOG, "nobody is found:\n{}", flight.output());
        while let Some(plan) = plans.receive()? {
            if plan.header.generation > 0 {
                asked = plan.header.plan_id;
                sweep.plan(asked, plan.items());
            }
        }
        while let Some(record) = records.receive()? {
            if (1..=asked).contains(&record.header.plan_id) {
                first.get_or_insert(record.header.stamp.sequence);
                sweep.searched(&record.header);
            }
        }
        while let Some(message) = tracks.receive()?.filter(|_| found.is_none()) {
            let is_seen = message.header.generation > 0 && !message.items().is_empty();
            found = is_seen.then_some(message.header.stamp.sequence);
        }
        // Frames searched meanwhile have gaps too. The longest is known at the end of a sweep.
        let is_swept = sweep.report().is_some_and(|report| report.partitions.mean_frames.is_some());
        anyhow::Ok((!is_swept || found.is_none()).then_some(Duration::from_millis(5)))
    };
    ports.attend(&mut look).expect("messages can be waited for");
    let waited = found.zip(first).map(|(found, first)| found.saturating_sub(first));
    let waited = waited.expect("both are there");
    let report = sweep.report().expect("views were searched");
    assert!(waited <= report.partitions.worst_frames, "found after {waited} frames; {report}");
    drop((plans, records, tracks, ports));
    flight.end_by(Signal::INT);
}

#[test]
fn what_does_not_run_cannot_be_watched() {
    let (is_well, said) = run(&["top", "--instance", "nobody-here", "--once"]);
    assert!(!is_well && said.contains("no pipeline 'nobody-here' runs here"), "{said}");
    let scratch = Scratch::new("nobody");
    let out = scratch.path("trace.json");
    let asked =
        ["trace", "--instance", "nobody-here", "--out", out.to_str().expect("a plain path")];
    let (is_well, said) = run(&asked);
    assert!(!is_well && said.contains("no pipeline 'nobody-here' runs here"), "{said}");
    assert!(!out.exists(), "nothing is left of what could not be recorded");
}

/// The whole answer of a pipeline to a request.
fn asked(port: u16, path: &str) -> String {
    use std::io::{Read, Write};
    let mut stream = std::net::TcpStream::connect(("127.0.0.1", port)).expect("it listens");
    stream.set_read_timeout(Some(Duration::from_secs(10))).expect("it can be set");
    let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n");
    stream.write_all(request.as_bytes()).expect("it can be asked");
    let mut answer = String::new();
    stream.read_to_string(&mut answer).expect("it answers");
    answer
}

#[test]
fn prometheus_gets_every_metric_that_the_dashboard_shows() {
    let port = free_port();
    let listen = format!("metrics.listen=127.0.0.1:{port}");
    let mut flight = Flight::with_poses("metrics", &[], &[SMALL_FLIGHT, &[&*listen]].concat());
    let start = Instant::now();
    while !asked(port, "/ready").starts_with("HTTP/1.1 200") {
        assert!(start.elapsed() < WATCHDOG, "{}", flight.output());
        std::thread::sleep(Duration::from_millis(100));
    }
    assert!(asked(port, "/live").starts_with("HTTP/1.1 200"));
    let metrics = asked(port, "/metrics");
    assert!(metrics.ends_with("# EOF\n"), "{metrics}");

    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/grafana-dashboard.json");
    let dashboard = std::fs::read_to_string(file).expect("it is there");
    let dashboard: Value = serde_json::from_str(&dashboard).expect("JSON");
    let expressions = dashboard["panels"].as_array().expect("panels").iter().flat_map(|panel| {
        let targets = panel["targets"].as_array().expect("targets").iter();
        targets.map(|target| target["expr"].as_str().expect("an expression").to_owned())
    });
    let is_name = |c: char| c.is_ascii_alphanumeric() || c == '_';
    let names: BTreeSet<String> = expressions
        .flat_map(|expression| {
            let words: Vec<_> = expression.split(|c| !is_name(c)).map(str::to_owned).collect();
            words.into_iter().filter(|word| word.starts_with("flockeye_"))
        })
        .collect();
    assert!(names.len() > 15, "{names:?}");
    // A machine without sensors shows neither.
    let of_machine = ["flockeye_temperature_celsius", "flockeye_processor_frequency_hertz"];
    for name in names {
        let is_there = metrics.lines().any(|line| line.starts_with(&format!("{name}{{")));
        let is_declared = metrics.contains(&format!("# TYPE {name} gauge"));
        let may_be_absent = of_machine.contains(&&*name);
        assert!(is_there || (may_be_absent && is_declared), "{name} is not in\n{metrics}");
    }

    // A pipeline that is held up is not ready.
    let instance = flight.instance.name().to_owned();
    succeeds(&["stop", "simulator", "--instance", &instance]);
    while !asked(port, "/ready").starts_with("HTTP/1.1 503") {
        assert!(start.elapsed() < WATCHDOG, "{}", flight.output());
        std::thread::sleep(Duration::from_millis(100));
    }
    flight.end_by(Signal::TERM);
}

#[test]
fn a_port_that_is_taken_is_named() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let address = taken.local_addr().expect("it has an address");
    let listen = format!("metrics.listen={address}");
    let mut flight = Flight::start("taken", &[], &[SMALL_FLIGHT, &[&*listen]].concat());
    assert!(!flight.wait().success());
    assert!(flight.output().contains(&format!("metrics.listen {address}")), "{}", flight.output());
    flight.assert_nothing_left();
}
