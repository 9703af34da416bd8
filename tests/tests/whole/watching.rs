//! `flockeye top` and `flockeye trace` beside a running pipeline.

use std::collections::BTreeSet;

use flockeye_tests::{Flight, SMALL_FLIGHT, Scratch, WATCHDOG, run};
use serde_json::Value;

#[test]
fn a_running_pipeline_is_watched_and_traced() {
    let mut flight = Flight::start("watched", &[], SMALL_FLIGHT);
    flight.wait_for("alpha confirmed");
    let name = flight.instance.name().to_owned();

    let (is_well, said) = run(&["top", "--instance", &name, "--once", "--json"]);
    assert!(is_well, "{said}");
    let report: Value = serde_json::from_str(said.trim()).expect("one JSON object");
    let stages = report["stages"].as_array().expect("a list");
    let names: BTreeSet<&str> = stages.iter().filter_map(|stage| stage["stage"].as_str()).collect();
    assert_eq!(names, BTreeSet::from(["detection", "fusion", "rectification", "simulator"]));
    for stage in stages {
        assert_eq!(stage["state"], "ready", "{stage}");
        for key in ["published_per_s", "processor_share", "resident_mb"] {
            assert!(stage[key].as_f64().expect("a number") > 0.0, "{key} of {stage}");
        }
        assert!(stage["queued"].is_u64() && stage["dropped"].is_u64(), "{stage}");
        assert!(stage["latency_p99_ms"].as_f64() >= stage["latency_median_ms"].as_f64());
    }
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

    flight.signal(rustix::process::Signal::INT);
    assert!(flight.wait().success(), "{}", flight.output());
    flight.assert_nothing_left();
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
