//! Stages in Python: the examples, with the package of `clients/python`.

use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use flockeye_contract::{Detections, FrameEnds, MeasuredBy, Topic, Tracks, Truths};
use flockeye_tests::onlooker::{Tape, join, subscribe};
use flockeye_tests::{
    Flight, SMALL_FLIGHT, WATCHDOG, flockeye, run, small_flight, succeeds, unique,
};
use nalgebra::Vector3;
use rustix::process::Signal;

/// Python with the package and what the examples need: `make python` makes it.
pub(crate) fn python() -> Option<PathBuf> {
    let target = flockeye().ancestors().nth(2)?.to_owned();
    let python = target.join("python/bin/python");
    if python.exists() {
        return Some(python);
    }
    flockeye_require::absent(flockeye_require::PYTHON, "target/python, which `make python` makes");
    None
}

pub(crate) fn example(name: &str) -> String {
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples");
    examples.join(name).to_string_lossy().into_owned()
}

fn fly(name: &str) -> Flight {
    Flight::with_poses(name, &[], SMALL_FLIGHT)
}

/// Swaps a stage for an example, and fails unless it takes over.
fn swap_in(flight: &Flight, worker: &str, python: &Path, file: &str) {
    let python = python.to_string_lossy();
    let name = flight.instance.name();
    let (succeeded, output) = run(&[
        "swap",
        worker,
        "--instance",
        name,
        "--within",
        "60s",
        "--accept-worse",
        "--",
        &python,
        &example(file),
    ]);
    assert!(succeeded && output.contains("is swapped after"), "{output}\n{}", flight.output());
}

/// Waits for a message that is as wanted.
fn wait_for<T: Topic + 'static>(
    flight: &mut Flight,
    what: &str,
    mut is_wanted: impl FnMut(&T::Header, &[T::Item]) -> bool,
) {
    let mut ports = join(flight);
    let mut messages = subscribe::<T>(flight, &mut ports);
    let start = Instant::now();
    loop {
        while let Some(message) = messages.receive().expect("it can be read") {
            if is_wanted(&message.header, message.items()) {
                return;
            }
        }
        assert!(start.elapsed() < WATCHDOG, "{what} never came:\n{}", flight.output());
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn end(mut flight: Flight) {
    succeeds(&["stop", "--instance", flight.instance.name()]);
    assert!(flight.wait().success(), "{}", flight.output());
    assert!(!flight.output().contains("Traceback"), "{}", flight.output());
    flight.assert_nothing_left();
}

#[test]
fn a_detector_is_swapped_in_and_finds_markers() {
    let Some(python) = python() else { return };
    let mut flight = fly("py-detector");
    swap_in(&flight, "detection", &python, "detector.py");
    wait_for::<Detections>(&mut flight, "a hit of the new detector", |header, markers| {
        header.generation > 0 && header.hits > 0 && !markers.is_empty()
    });
    wait_for::<Tracks>(&mut flight, "a pose", |_, tracks| {
        tracks.iter().any(|track| track.measured_by != MeasuredBy::Nothing.code())
    });
    end(flight);
}

#[test]
fn a_rectification_is_swapped_in_and_its_views_show_neighbours() {
    let Some(python) = python() else { return };
    let mut flight = fly("py-rectifier");
    swap_in(&flight, "rectification", &python, "rectifier.py");
    let mut ended = 0;
    wait_for::<FrameEnds>(&mut flight, "frames that it ends", |header, _| {
        ended += u32::from(header.generation > 0 && header.views_issued > 0);
        ended > 20
    });
    wait_for::<Detections>(&mut flight, "a hit in its views", |header, _| {
        header.view_generation > 0 && header.hits > 0
    });
    end(flight);
}

#[test]
fn a_fusion_that_only_reports_bearings_is_swapped_in() {
    let Some(python) = python() else { return };
    let mut flight = fly("py-bearings");
    let mut truths = std::collections::BTreeMap::new();
    swap_in(&flight, "fusion", &python, "bearings.py");
    let mut ports = join(&mut flight);
    let mut truth = subscribe::<Truths>(&mut flight, &mut ports);
    wait_for::<Tracks>(&mut flight, "a bearing of the new fusion", |header, tracks| {
        while let Some(message) = truth.receive().expect("it can be read") {
            truths.insert(message.header.stamp.order(), message.items().to_vec());
        }
        let Some(known) = truths.get(&header.stamp.order()).filter(|_| header.generation > 0)
        else {
            return false;
        };
        tracks.iter().any(|track| {
            let body = known.iter().find(|body| body.target == track.target).expect("it flies");
            let [found, really] = [track.observer_from_target, body.observer_from_target]
                .map(|pose| Vector3::from(pose.position));
            // Markers sit around the body's middle, which is half a metre off.
            assert!(found.angle(&really) < 0.15, "{found:?} against {really:?}");
            true
        })
    });
    drop((truth, ports));
    end(flight);
}

#[test]
fn a_lossless_flight_with_a_detector_in_python_ends_every_frame_once() {
    let Some(python) = python() else { return };
    let command = format!(
        "stages.detection.command=[\"{}\", \"{}\"]",
        python.display(),
        example("detector.py")
    );
    let set = small_flight(&["simulator.frames=20", &command]);
    let tape = Tape::record("py-lossless", &["--profile", "repeat"], &set);
    tape.assert_every_frame_ended_once(20);
    let measured = |tracks: &[flockeye_contract::Track]| {
        tracks.iter().any(|track| track.measured_by != MeasuredBy::Nothing.code())
    };
    assert!(tape.tracks.iter().any(|(_, tracks)| measured(tracks)), "{}", tape.output);
}

#[test]
fn the_examples_keep_the_contract() {
    let Some(python) = python() else { return };
    let python = python.to_string_lossy();
    for (kind, file) in
        [("detection", "detector.py"), ("rectification", "rectifier.py"), ("fusion", "bearings.py")]
    {
        succeeds(&[
            "stage",
            "test",
            kind,
            "--set",
            "camera.width=1024",
            "--set",
            "camera.height=512",
            "--",
            &python,
            &example(file),
        ]);
    }
}

#[test]
fn the_types_in_python_are_laid_out_as_those_in_rust() {
    let Some(python) = python() else { return };
    let script = "from flockeye.contract import TYPES\n\
                  import ctypes\n\
                  for kind in TYPES:\n    \
                      print(kind.__name__, ctypes.sizeof(kind), ctypes.alignment(kind))\n    \
                      for name, *_ in kind._fields_: print(f'  {name} {getattr(kind, name).offset}')\n";
    let output = Command::new(python).args(["-c", script]).output().expect("it runs");
    assert_eq!(String::from_utf8_lossy(&output.stdout), flockeye_contract::description::layout());
}

#[test]
fn the_tool_that_looks_on_prints_neighbours_and_ends_with_the_pipeline() {
    let Some(python) = python() else { return };
    let mut flight = fly("py-tracks");
    let mut command = Command::new(python);
    command.arg(example("tracks.py")).arg(flight.instance.folder());
    let mut tool = Flight::launch("py-tracks-tool", command);
    tool.wait_for("alpha confirmed at ");
    succeeds(&["stop", "--instance", flight.instance.name()]);
    assert!(flight.wait().success(), "{}", flight.output());
    assert!(tool.wait().success(), "{}", tool.output());
    flight.assert_nothing_left();
}

/// The module for peers, in a process that links with the drone over the network.
#[test]
fn a_peer_in_python_hears_where_the_neighbour_is() {
    let Some(python) = python() else { return };
    let port = TcpListener::bind("127.0.0.1:0").expect("a port is free");
    let endpoint = format!("tcp/{}", port.local_addr().expect("it is bound"));
    drop(port);
    let swarm = unique("swarm");
    let (listen, name) =
        (format!("gateway.listen=[\"{endpoint}\"]"), format!("observer.swarm={swarm}"));
    let mut settings = SMALL_FLIGHT.to_vec();
    settings.extend(["gateway.enabled=true", &listen, &name]);
    let mut flight = Flight::with_poses("peerpy", &[], &settings);
    // A shell's background jobs ignore SIGINT, and Python leaves it so.
    let mut command = Command::new("env");
    command.arg("--default-signal=INT").arg(&python);
    command.arg(example("peers.py")).args([&endpoint, &swarm]);
    let mut peer = Flight::launch(&unique("peerpy"), command);
    peer.wait_for("observer sees alpha at ");
    peer.signal(Signal::INT);
    peer.wait();
    // Bytes that are no report are refused, each by its reason.
    let refused =
        Command::new(&python).args(["-c", REFUSED_IN_PYTHON]).output().expect("Python runs");
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(refused.status.success(), "{said}");
    flight.end_by(Signal::INT);
}

const REFUSED_IN_PYTHON: &str = r#"
import json, random
from flockeye_peers import MAX_FRAME_REPORT_BYTES, Refused, read
target = {"target": "kite", "state": "confirmed", "position": [1, 2, 3], "orientation": [0, 0, 0, 1],
          "covariance": [1] * 21, "linear_velocity": [0] * 3, "angular_velocity": [0] * 3}
frame = {"schema": "flockeye.frame/2", "observer": "wren", "frame": 1, "epoch": 0, "stamp_utc_ns": 5,
         "clock_synchronised": False, "latency_ms": 3.5, "targets": [target]}
key, good = "flockeye/s/wren/sees", json.dumps(frame).encode()
[report] = read(key, good)
assert report.covariance_matrix()[5][5] == 1 and report.age() >= 0.0035
bad = [b"", b"{", bytes([255, 254]), b"[" * 50000, b"NaN", b" " * (MAX_FRAME_REPORT_BYTES + 1)]
for name, value in [("schema", "flockeye.frame/9"), ("observer", "crow"), ("targets", [target] * 65),
                    ("latency_ms", float("nan"))]:
    bad.append(json.dumps({**frame, name: value}).encode())
for name, value in [("target", "../x"), ("state", "x"), ("position", [1, 2]), ("position", [1, 2, None]),
                    ("position", [float("inf")] * 3), ("orientation", [0, 0, 0, 2])]:
    bad.append(json.dumps({**frame, "targets": [{**target, name: value}]}).encode())
random.seed(1)
for payload in bad:
    try:
        read(key, payload)
        raise SystemExit(f"taken: {payload[:80]}")
    except Refused:
        pass
for _ in range(20000):
    broken = bytearray(good)
    broken[random.randrange(len(broken))] = random.randrange(256)
    try:
        read(key, bytes(broken))
    except Refused:
        pass
"#;
