//! The configurations of `deploy/configurations`: each is in order, and those that need no camera
//! are flown.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::Instant;

use flockeye_config::Pipeline;
use flockeye_require::loopback::free_port;
use flockeye_tests::{Flight, SMALL_FLIGHT, WATCHDOG, recordings, run};
use rustix::process::Signal;
use serde_json::Value;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/configurations")
}

/// A configuration by its name.
fn configuration(name: &str) -> String {
    folder().join(name).to_str().expect("a plain path").to_owned()
}

#[test]
fn every_configuration_is_in_order() {
    let entries = std::fs::read_dir(folder()).expect("they are there").flatten();
    let names = entries.map(|entry| entry.file_name().to_string_lossy().into_owned());
    let mut checked = 0;
    for name in names.filter(|name| name.ends_with(".yaml")) {
        let (is_in_order, said) = run(&["check", &configuration(&name)]);
        assert!(is_in_order && said.contains("everything is in order"), "{name}: {said}");
        let is_images = name.starts_with("simulated") || name == "dual-fisheye.yaml";
        let coding = if is_images { "images" } else { "video" };
        assert!(said.contains(&format!("pictures coded as {coding}")), "{name}: {said}");
        checked += 1;
    }
    assert!(checked >= 8, "{checked}");
}

#[test]
fn two_simulated_drones_hear_each_other() {
    // Other ports than those of the files, because another pipeline may have these.
    let [one, two] = [free_port(), free_port()];
    let start = |name: &str| {
        let file = configuration(&format!("simulated-drone-{name}.yaml"));
        let written = Pipeline::load(Path::new(&file), &[]).expect("it is in order").gateway;
        let elsewhere = |key: &str, endpoints: &[String]| {
            let [one, two] = [one, two].map(|port| port.to_string());
            let endpoints = endpoints.join(", ").replace("7447", &one).replace("7448", &two);
            format!("gateway.{key}=[{endpoints}]")
        };
        let listen = elsewhere("listen", &written.listen);
        let connect = elsewhere("connect", &written.connect);
        let small: Vec<_> =
            SMALL_FLIGHT.iter().copied().filter(|set| !set.starts_with("gateway")).collect();
        let set = [&[&*listen, &*connect][..], &small].concat();
        Flight::start(&format!("pair-{name}"), &[&file], &set)
    };
    let flights = ["one", "two"].map(start);
    let started = Instant::now();
    loop {
        let endpoint = format!("tcp/127.0.0.1:{one}");
        let swarm = "observer.swarm=pair";
        let (_, said) =
            run(&["peers", "--set", swarm, "--connect", &endpoint, "--for", "2s", "--json"]);
        // Each sees a body of the other's name, so only who reports counts.
        let lines = said.lines().filter_map(|line| serde_json::from_str::<Value>(line).ok());
        let reports = lines.map(|line| line["report"].clone());
        let confirmed: BTreeSet<String> = reports
            .filter(|report| report["state"] == "confirmed")
            .filter_map(|report| Some(report["observer"].as_str()?.to_owned()))
            .collect();
        if confirmed == BTreeSet::from(["one".to_owned(), "two".to_owned()]) {
            break;
        }
        let outputs = || flights.each_ref().map(Flight::output).join("\n");
        assert!(started.elapsed() < WATCHDOG, "{}\nonlookers heard {said}", outputs());
    }
    for mut flight in flights {
        flight.end_by(Signal::TERM);
    }
}

#[test]
fn a_recorded_flight_is_worked_on_frame_by_frame() {
    let Some(data) = recordings() else { return };
    let source = data.join("flight4/flight4.mp4");
    let source = source.to_str().expect("a plain path");
    let arguments = [&*configuration("recorded-flight.yaml"), "--source", source, "--frames", "8"];
    let mut flight = Flight::start("recorded", &arguments, &[]);
    assert!(flight.wait().success(), "{}", flight.output());
    assert!(flight.output().contains("8 frames searched, 0 skipped"), "{}", flight.output());
    flight.assert_nothing_left();
}
