//! A simulated swarm: a pipeline for each drone, linked as drones are.

use std::process::Command;
use std::time::{Duration, Instant};

use flockeye_runtime::instance::Instance;
use flockeye_tests::{Flight, WATCHDOG, flockeye, run, succeeds, unique};
use rustix::process::Signal;

/// Four drones on a ring, so far from each other that each sees the two beside it alone.
const RING: [&str; 10] = [
    "swarm",
    "sim",
    "--drones",
    "4",
    "--rate",
    "5",
    "--size",
    "640x320",
    "--set",
    "simulator.distance_m=[0.62, 0.66]",
];

/// The instances of a swarm's pipelines.
fn instances(swarm: &str, drones: u32) -> Vec<Instance> {
    (0..drones).map(|drone| Instance::named(&format!("{swarm}-{drone}"))).collect()
}

#[test]
fn drones_know_those_beside_them_mutually_and_the_others_through_them() {
    let swarm = unique("swm");
    let output = succeeds(&[&RING[..], &["--instance", &swarm, "--for", "10s", "--json"]].concat());
    let line = output.lines().find(|line| line.starts_with('{')).expect("a report");
    let report: serde_json::Value = serde_json::from_str(line).expect("it is JSON");
    let number =
        |path: &str| report.pointer(path).and_then(|value| value.as_f64()).unwrap_or(f64::NAN);
    // Half of what there is on an idle machine: each of four has two others mutually ten times a
    // second.
    assert!(number("/ways/mutual/poses") > 200.0, "{report}");
    assert!(number("/ways/chained/poses") > 50.0, "{report}");
    for way in ["mutual", "chained"] {
        assert!(number(&format!("/ways/{way}/position_mm/0")) < 15.0, "{report}");
        assert!(number(&format!("/ways/{way}/share_within_95")) > 0.9, "{report}");
    }
    let rotation = |who: &str| number(&format!("/mutual/{who}/rotation_deg/0"));
    assert!(rotation("mutual") < rotation("alone"), "two see more than one: {report}");
    // All run on one clock, and do not know it.
    assert!(number("/clocks/error_ms/0") < 5.0, "{report}");
    assert!(number("/clocks/deviations/0") < 1.0, "{report}");
    for instance in instances(&swarm, 4) {
        assert!(instance.shared_memory().is_empty(), "{} is left", instance.name());
        assert!(!instance.folder().exists(), "{} is left", instance.folder().display());
    }
}

#[test]
fn a_swarm_ends_with_its_command_however_that_ends() {
    let swarm = unique("swk");
    let mut command = Command::new(flockeye());
    command.args(RING).args(["--instance", &swarm]);
    let mut flight = Flight::launch(&format!("{swarm}-0"), command);
    let all = instances(&swarm, 4);
    let start = Instant::now();
    while !all.iter().all(Instance::is_running) {
        assert!(start.elapsed() < WATCHDOG && !flight.has_ended(), "{}", flight.output());
        std::thread::sleep(Duration::from_millis(50));
    }
    flight.signal(Signal::KILL);
    flight.wait();
    let start = Instant::now();
    while all.iter().any(Instance::is_running) {
        assert!(start.elapsed() < WATCHDOG, "pipelines outlive the command");
        std::thread::sleep(Duration::from_millis(50));
    }
    for instance in all {
        // The next `flockeye up` of that name, or `flockeye clean`, does the same.
        drop(instance.take().expect("its name is free"));
        assert!(instance.shared_memory().is_empty(), "{} is left", instance.name());
    }
}

#[test]
fn a_pipeline_that_cannot_fly_ends_the_swarm_with_its_own_words() {
    let swarm = unique("swe");
    let near = "simulator.distance_m=[0.21, 0.22]";
    let (is_good, output) = run(&[&RING[..], &["--instance", &swarm, "--set", near]].concat());
    assert!(!is_good, "{output}");
    assert!(
        output.contains(&format!("the pipeline {swarm}-")) && output.contains("ended"),
        "{output}"
    );
    assert!(output.contains("distance_m"), "{output}");
    for instance in instances(&swarm, 4) {
        assert!(!instance.folder().exists(), "{} is left", instance.folder().display());
    }
}
