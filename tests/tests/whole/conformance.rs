//! Stages that are tested alone against the contract.

use std::net::UdpSocket;

use flockeye_tests::autopilot::SimulatedAutopilot;
use flockeye_tests::{Flight, SMALL_FLIGHT, flockeye, recordings, run, succeeds};
use serde_json::Value;

/// A small sphere, so that the test takes seconds.
const SMALL: &[&str] = &["--set", "camera.width=1024", "--set", "camera.height=512"];

fn test(kind: &str, set: &[&str], candidate: &[&str]) -> (bool, String) {
    let candidate = if candidate.is_empty() { vec![] } else { [&["--"], candidate].concat() };
    run(&[&["stage", "test", kind], SMALL, set, &candidate].concat())
}

fn assert_keeps_the_contract((succeeded, output): (bool, String), least_checks: usize) {
    assert!(succeeded, "{output}");
    let report: Value = serde_json::from_str(&output).expect("nothing but JSON");
    let checks = report["checks"].as_array().expect("a list");
    assert!(checks.len() >= least_checks, "{output}");
    assert!(checks.iter().all(|check| check["wrong"].is_null()), "{output}");
    assert!(!report["figures"].as_array().expect("a list").is_empty(), "{output}");
}

#[test]
fn our_own_stages_keep_the_contract() {
    for kind in ["egomotion", "rectification", "detection", "fusion", "gateway"] {
        assert_keeps_the_contract(test(kind, &["--json"], &[]), 14);
    }
    // Nothing that they hand on comes back to the test.
    for kind in ["autopilot", "ros2"] {
        assert_keeps_the_contract(test(kind, &["--json"], &[]), 7);
    }
}

#[test]
fn our_own_sources_keep_the_contract() {
    for profile in ["flight", "repeat"] {
        let at_most = "simulator.frames=1000000";
        assert_keeps_the_contract(
            test("simulator", &["--json", "--profile", profile, "--set", at_most], &[]),
            13,
        );
    }
    let camera = "videotestsrc is-live=true pattern=smpte ! video/x-raw,width=1024,height=512";
    assert_keeps_the_contract(test("capture", &["--json", "--source", camera], &[]), 13);
    let address = UdpSocket::bind("127.0.0.1:0").expect("a port").local_addr().expect("an address");
    let autopilot = SimulatedAutopilot::start(address.to_string());
    let source = format!("inertial.source=mavlink:udp:{address}");
    assert_keeps_the_contract(test("inertial", &["--json", "--set", &source], &[]), 9);
    drop(autopilot);
}

#[test]
fn a_candidate_is_compared_with_our_own_stage_on_a_recording() {
    let Some(data) = recordings() else { return };
    let file = |name: &str| data.join(name).to_string_lossy().into_owned();
    let (flight, bodies) = (file("flight1/flight1.mp4"), file("bodies.json"));
    let detector = flockeye().with_file_name("flockeye-detection");
    let detector = detector.to_str().expect("a plain path");
    let beside = ["--json", "--beside", &flight, "--bodies", &bodies];
    let arguments = [&["stage", "test", "detection"], &beside[..], &["--", detector]].concat();
    let output = succeeds(&arguments);
    let report: Value = serde_json::from_str(&output).expect("nothing but JSON");
    let figures = report["figures"].as_array().expect("a list");
    let value = |what: &str| {
        let found = figures.iter().find(|figure| figure["what"] == what);
        found.unwrap_or_else(|| panic!("no {what:?}: {output}"))["value"].as_f64()
    };
    assert!(value("beside Flockeye's own: frames compared") >= Some(10.0), "{output}");
    // The candidate is the same program on the same views.
    assert!(value("what it finds") > Some(50.0), "{output}");
    let (succeeded, output) = run(&["stage", "test", "gateway", "--beside", "sim"]);
    assert!(!succeeded && output.contains("cannot run beside another"), "{output}");
}

#[test]
fn stages_of_each_kind_that_misbehave_are_told_how() {
    let program = flockeye().with_file_name("misbehaving-stage");
    let program = program.to_str().expect("a plain path");
    for (kind, misdeed, wanted) in [
        ("egomotion", "mute", "FAILS  one rotation for each frame: frame 1 got none in 3 s"),
        ("egomotion", "lie", "FAILS  rotations are right: later_from_earlier of frame 2 is "),
        ("egomotion", "lie", "FAILS  the covariance is honest: squared errors are inf times"),
        ("rectification", "mute", "FAILS  one frame_end for each frame: frame "),
        ("rectification", "boast", "FAILS  views_issued counts the views: views_issued is 3, and "),
        ("fusion", "mute", "FAILS  a first plan opens the flow: no plan came"),
        ("fusion", "unplanned", "FAILS  a plan follows each frame: no plan came whose after is "),
        ("simulator", "mute", "FAILS  frames come: none came in 2 s"),
        ("simulator", "backwards", "FAILS  frames are in order: sequence 9999"),
        ("simulator", "backwards", "FAILS  times are of CLOCK_MONOTONIC: published_ns is 9999"),
        ("inertial", "mute", "FAILS  samples come: 0 came"),
        ("inertial", "repeat", "FAILS  each sample comes once, in the order of time: at_ns "),
        ("gateway", "mute", "FAILS  says that it is alive: no liveliness token of "),
    ] {
        let start = ["--set", "supervision.start_s=2"];
        let (succeeded, output) = test(kind, &start, &[program, kind, misdeed]);
        assert!(!succeeded && output.contains(wanted), "{wanted:?} is missing in:\n{output}");
        assert!(output.contains("(docs/CONTRACT.md, \""), "{output}");
    }
}

#[test]
fn stages_that_misbehave_leave_the_others_of_a_pipeline_alone() {
    let program = flockeye().with_file_name("misbehaving-stage");
    for (kind, misdeed, flies) in [
        ("egomotion", "mute", "alpha confirmed"),
        ("egomotion", "lie", "alpha "),
        ("gateway", "mute", "alpha confirmed"),
        ("rectification", "boast", "frames"),
        ("fusion", "unplanned", "frames"),
    ] {
        let command = format!("stages.{kind}.command=[{}, {kind}, {misdeed}]", program.display());
        let more = [command.as_str(), "gateway.enabled=true", "gateway.listen=[tcp/127.0.0.1:0]"];
        let set = [SMALL_FLIGHT, &more].concat();
        let mut flight = Flight::start(&format!("bad-{kind}"), &["--for", "4s"], &set);
        let succeeded = flight.wait().success();
        let output = flight.output();
        assert!(succeeded && output.contains(flies), "{kind} {misdeed}:\n{output}");
        for other in ["simulator", "detection", "rectification", "fusion", "egomotion", "gateway"] {
            let is_blamed =
                output.lines().any(|line| line.starts_with(other) || line.contains("panicked"));
            assert!(!is_blamed || other == kind, "{kind} {misdeed} harms {other}:\n{output}");
        }
        flight.assert_nothing_left();
    }
}

#[test]
fn stages_that_misbehave_are_told_how_and_where_it_is_written() {
    let silent = flockeye().with_file_name("silent-detector");
    let silent = silent.to_str().expect("a plain path");
    for (candidate, wanted) in [
        (vec![silent], "FAILS  markers are found: none of "),
        (vec![silent, "mute"], "FAILS  one record for each view: view_index 1 got none in 1 s"),
        (vec![silent, "hang"], "FAILS  health comes every 250 ms: none came for "),
        (vec![silent, "late"], "it has not sent health with state ready in 2 s"),
        (vec![silent, "lie"], "FAILS  records pass the contract's check: 3 hits"),
        (vec!["false"], "it ended with status 1 before it was ready"),
    ] {
        let (succeeded, output) =
            test("detection", &["--set", "supervision.start_s=2"], &candidate);
        assert!(!succeeded && output.contains(wanted), "{wanted:?} is missing in:\n{output}");
        assert!(output.contains("(docs/CONTRACT.md, \""), "{output}");
    }
    // A detector is no rectification.
    let (succeeded, output) = test("rectification", &["--set", "supervision.start_s=2"], &[silent]);
    let wanted =
        "FAILS  health says who it is: stage is \"detection\", and must be \"rectification\"";
    assert!(!succeeded && output.contains(wanted), "{output}");
    let (succeeded, output) = test("gateways", &[], &[]);
    assert!(!succeeded && output.contains("there is no stage 'gateways'. Stages: "), "{output}");
}
