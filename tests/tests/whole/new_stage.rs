//! Stages that `flockeye stage new` writes, of each kind in each language.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use flockeye_contract::{FrameEnds, Tracks, Truths};
use flockeye_tests::onlooker::{join, subscribe};
use flockeye_tests::{Flight, SMALL_FLIGHT, Scratch, WATCHDOG, flockeye, run};
use nalgebra::Vector3;

use crate::c_client;

const KINDS: [&str; 3] = ["detection", "rectification", "fusion"];

/// A body's markers are at most so far from its middle as an observer at the flight's distance sees it, radians.
const BODY_RAD: f64 = 0.25;

/// Writes a new stage, and returns its folder and what was said of it.
fn write(scratch: &Scratch, kind: &str, lang: &str) -> (PathBuf, String) {
    let folder = scratch.path(&format!("{kind}-{lang}"));
    let (succeeded, output) =
        run(&["stage", "new", kind, "--lang", lang, folder.to_str().expect("a plain path")]);
    assert!(succeeded, "{output}");
    (folder, output)
}

fn assert_keeps_the_contract(kind: &str, program: &str) {
    let small = ["--set", "camera.width=1024", "--set", "camera.height=512"];
    let (succeeded, output) =
        run(&[&["stage", "test", kind], &small[..], &["--", program]].concat());
    assert!(succeeded, "{kind} by {program}: {output}");
}

/// Flies, and swaps in a rectification, then a fusion that reports bearings. Sees that frames are cut, and that
/// neighbours are found where they are.
fn assert_take_over(name: &str, rectifier: &str, bearings: &str) {
    let mut flight = Flight::start(name, &[], SMALL_FLIGHT);
    flight.wait_for("alpha confirmed");
    let instance = flight.instance.name().to_owned();
    for (worker, program) in [("rectification", rectifier), ("fusion", bearings)] {
        let swap = ["swap", worker, "--instance", &instance, "--within", "60s", "--accept-worse"];
        let (succeeded, output) = run(&[&swap[..], &["--", program]].concat());
        assert!(succeeded && output.contains("is swapped after"), "{output}\n{}", flight.output());
    }
    let mut ports = join(&mut flight);
    let mut ends = subscribe::<FrameEnds>(&mut flight, &mut ports);
    let mut tracks = subscribe::<Tracks>(&mut flight, &mut ports);
    let mut truths = subscribe::<Truths>(&mut flight, &mut ports);
    let (mut known, mut ended, mut seen) = (BTreeMap::new(), 0, 0);
    let start = Instant::now();
    while ended < 20 || seen < 10 {
        assert!(start.elapsed() < WATCHDOG, "{ended} ended, {seen} seen:\n{}", flight.output());
        while let Some(message) = ends.receive().expect("it can be read") {
            assert!(message.header.generation > 0, "the old rectification ends a frame");
            ended += u32::from(message.header.views_issued > 0);
        }
        while let Some(message) = truths.receive().expect("it can be read") {
            known.insert(message.header.stamp.order(), message.items().to_vec());
        }
        while let Some(message) = tracks.receive().expect("it can be read") {
            assert!(message.header.generation > 0, "the old fusion reports a frame");
            let Some(bodies) = known.get(&message.header.stamp.order()) else { continue };
            for track in message.items() {
                let body = bodies.iter().find(|body| body.target == track.target);
                let really = body.expect("it flies").observer_from_target;
                let [found, really] =
                    [track.observer_from_target, really].map(|pose| Vector3::from(pose.position));
                assert!(found.angle(&really) < BODY_RAD, "{found:?} against {really:?}");
                seen += 1;
            }
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    drop((ends, tracks, truths, ports));
    let (succeeded, output) = run(&["stop", "--instance", &instance]);
    assert!(succeeded, "{output}");
    assert!(flight.wait().success(), "{}", flight.output());
    flight.assert_nothing_left();
}

#[test]
fn a_new_stage_is_written_once_and_only_where_there_is_an_example() {
    let scratch = Scratch::new("stage-new");
    let folder = scratch.path("mine");
    let folder = folder.to_str().expect("a plain path");
    let (succeeded, output) = run(&["stage", "new", "detection", folder]);
    assert!(succeeded && output.contains("flockeye swap detection"), "{output}");
    let (succeeded, output) = run(&["stage", "new", "detection", folder]);
    assert!(!succeeded && output.contains("is there already"), "{output}");
    for lang in ["python", "rust", "c"] {
        let (succeeded, output) = run(&["stage", "new", "gateway", "--lang", lang, folder]);
        let cure = "Cure: one of detection, rectification, fusion";
        assert!(!succeeded && output.contains(cure), "{output}");
    }
}

#[test]
fn each_new_stage_is_the_example_and_names_its_own_place() {
    let scratch = Scratch::new("stage-new-each");
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples");
    for (lang, names) in [
        ("python", ["detector.py", "rectifier.py", "bearings.py"]),
        ("c", ["c/detector", "c/rectifier", "c/bearings"]),
        ("rust", ["rust/detector", "rust/rectifier", "rust/bearings"]),
    ] {
        for (kind, name) in KINDS.into_iter().zip(names) {
            let (folder, output) = write(&scratch, kind, lang);
            let place = folder.to_str().expect("a plain path");
            let has_test = output.lines().any(|line| {
                line.contains(&format!("flockeye stage test {kind}")) && line.contains(place)
            });
            assert!(has_test, "{output}");
            let is_source = |path: &Path| !path.ends_with("Cargo.toml");
            let example = examples.join(name);
            // In Python the example is one file.
            let (example, files) = match lang {
                "python" => (examples.clone(), vec![PathBuf::from(name)]),
                _ => (example.clone(), files_below(&example)),
            };
            assert!(!files.is_empty(), "{name} is not there");
            for file in files.iter().filter(|file| is_source(file)) {
                let text = |path: &Path| std::fs::read_to_string(path).expect("it is there");
                let (example, written) = (text(&example.join(file)), text(&folder.join(file)));
                assert_eq!(example.lines().count(), written.lines().count(), "{name}");
                for (example, written) in example.lines().zip(written.lines()) {
                    let is_place = example.contains("examples/") && written.contains(place);
                    assert!(example == written || is_place, "{example}\n{written}");
                }
                assert!(!written.contains("examples/"), "{written}");
            }
        }
    }
}

/// The files of an example, relative to it.
fn files_below(example: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    let mut open = vec![PathBuf::new()];
    while let Some(path) = open.pop() {
        match std::fs::read_dir(example.join(&path)) {
            // What a build has left there is no part of it.
            Ok(entries) => open.extend(
                entries
                    .map(|entry| path.join(entry.expect("it can be read").file_name()))
                    .filter(|path| !path.ends_with("build") && !path.ends_with("target")),
            ),
            Err(_) => files.push(path),
        }
    }
    files
}

#[test]
fn new_stages_in_c_keep_the_contract_and_take_over() {
    let scratch = Scratch::new("stage-new-c");
    let Some(rectifier) = c_client::new_stage(&scratch, "rectification") else { return };
    let Some(bearings) = c_client::new_stage(&scratch, "fusion") else { return };
    assert_keeps_the_contract("rectification", &rectifier);
    assert_keeps_the_contract("fusion", &bearings);
    assert_take_over("new-c", &rectifier, &bearings);
}

/// A cargo command for the stage in `folder`, with the versions that Flockeye is built with.
fn cargo(folder: &Path, command: &str, arguments: &[&str]) -> String {
    let locked = Path::new(env!("CARGO_MANIFEST_DIR")).join("../Cargo.lock");
    std::fs::copy(locked, folder.join("Cargo.lock")).expect("it can be written");
    let output = Command::new(env!("CARGO"))
        .args([command, "--offline", "--manifest-path"])
        .arg(folder.join("Cargo.toml"))
        .args(arguments)
        // As small as can be: what it says is not looked into, and it is built once.
        .env("CARGO_PROFILE_DEV_DEBUG", "0")
        .env("CARGO_INCREMENTAL", "0")
        .output()
        .expect("cargo runs this test");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[test]
fn new_stages_in_rust_have_the_dependencies_that_they_name() {
    let scratch = Scratch::new("stage-new-rust");
    let nowhere = scratch.path("nowhere");
    let nowhere = nowhere.to_str().expect("a plain path");
    let new = ["stage", "new", "detection", "--lang", "rust", nowhere, "--sources", "/nowhere"];
    let (succeeded, output) = run(&new);
    assert!(!succeeded && output.contains("Cure: --sources FOLDER"), "{output}");
    for (kind, name, paths) in [
        ("detection", "my-detector", ["common/contract", "services/detection"]),
        ("rectification", "my-rectifier", ["common/contract", "common/config"]),
        ("fusion", "my-bearings", ["common/contract", "common/runtime"]),
    ] {
        let (folder, _) = write(&scratch, kind, "rust");
        let text = cargo(&folder, "metadata", &["--no-deps", "--format-version", "1"]);
        for part in [[name].as_slice(), &paths].concat() {
            assert!(text.contains(part), "{part} is missing in {text}");
        }
    }
}

#[test]
fn a_new_fusion_in_rust_is_built_and_keeps_the_contract() {
    let scratch = Scratch::new("stage-new-build");
    let (folder, _) = write(&scratch, "fusion", "rust");
    // It stays there, so that what it depends on is built once.
    let target = flockeye().with_file_name("new-stage");
    cargo(&folder, "build", &["--target-dir", target.to_str().expect("a plain path")]);
    let program = target.join("debug/my-bearings");
    assert_keeps_the_contract("fusion", program.to_str().expect("a plain path"));
}

#[test]
fn the_examples_in_rust_keep_the_contract_and_take_over() {
    // Their texts were built with these tests.
    let [detector, rectifier, bearings] =
        ["my-detector", "my-rectifier", "my-bearings"].map(|name| {
            let example = flockeye().with_file_name(name);
            example.to_str().expect("a plain path").to_owned()
        });
    assert_keeps_the_contract("detection", &detector);
    assert_keeps_the_contract("rectification", &rectifier);
    assert_take_over("new-rust", &rectifier, &bearings);
}
