//! Stages that `flockeye stage new` writes, of each kind in each language.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use flockeye_contract::{Detections, MeasuredBy, Track, Tracks, Truths};
use flockeye_tests::onlooker::{join, subscribe};
use flockeye_tests::{Flight, SMALL_FLIGHT, Scratch, WATCHDOG, flockeye, run, succeeds};
use nalgebra::Vector3;
use serde_json::Value;

/// The kinds of stages of which there is an example in a language, and where it lies.
const EXAMPLES: [(&str, &[(&str, &str)]); 3] = [
    (
        "python",
        &[
            ("detection", "detector.py"),
            ("rectification", "rectifier.py"),
            ("fusion", "bearings.py"),
        ],
    ),
    ("c", &[("detection", "c/detector")]),
    ("rust", &[("detection", "rust/detector")]),
];

/// Writes a new stage, and returns its folder and what was said of it.
fn write(scratch: &Scratch, kind: &str, lang: &str) -> (PathBuf, String) {
    let folder = scratch.path(&format!("{kind}-{lang}"));
    let output =
        succeeds(&["stage", "new", kind, "--lang", lang, folder.to_str().expect("a plain path")]);
    (folder, output)
}

fn assert_keeps_the_contract(kind: &str, program: &str) {
    let small = ["--set", "camera.width=1024", "--set", "camera.height=512"];
    let (succeeded, output) =
        run(&[&["stage", "test", kind], &small[..], &["--", program]].concat());
    assert!(succeeded, "{kind} by {program}: {output}");
}

/// Flies, and swaps in a detector for both of ours. Sees that it finds markers, and that poses
/// follow.
fn assert_takes_over(name: &str, detector: &str) {
    let mut flight = Flight::with_poses(name, &[], SMALL_FLIGHT);
    let instance = flight.instance.name().to_owned();
    for worker in ["detection", "detection.1"] {
        let swap = ["swap", worker, "--instance", &instance, "--within", "60s", "--accept-worse"];
        let (succeeded, output) = run(&[&swap[..], &["--", detector]].concat());
        assert!(succeeded && output.contains("is swapped after"), "{output}\n{}", flight.output());
    }
    let mut ports = join(&mut flight);
    let mut detections = subscribe::<Detections>(&mut flight, &mut ports);
    let mut tracks = subscribe::<Tracks>(&mut flight, &mut ports);
    let mut truths = subscribe::<Truths>(&mut flight, &mut ports);
    let (mut known, mut hits, mut seen) = (BTreeMap::new(), 0, 0);
    let start = Instant::now();
    while hits < 20 || seen < 20 {
        assert!(start.elapsed() < WATCHDOG, "{hits} hits, {seen} seen:\n{}", flight.output());
        while let Some(message) = detections.receive().expect("it can be read") {
            assert!(message.header.generation > 0, "the old detection answers a view");
            assert_eq!(message.header.failed, 0);
            hits += message.header.hits;
        }
        while let Some(message) = truths.receive().expect("it can be read") {
            known.insert(message.header.stamp.order(), message.items().to_vec());
        }
        while let Some(message) = tracks.receive().expect("it can be read") {
            let Some(bodies) = known.get(&message.header.stamp.order()) else { continue };
            let is_measured = |track: &&Track| track.measured_by != MeasuredBy::Nothing.code();
            for track in message.items().iter().filter(is_measured) {
                let body = bodies.iter().find(|body| body.target == track.target);
                let really = body.expect("it flies").observer_from_target;
                let [found, really] =
                    [track.observer_from_target, really].map(|pose| Vector3::from(pose.position));
                assert!((found - really).norm() < 0.1, "{found:?} against {really:?}");
                seen += 1;
            }
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    drop((detections, tracks, truths, ports));
    succeeds(&["stop", "--instance", &instance]);
    flight.assert_ends_well();
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
    for (lang, kind, cure) in [
        ("python", "gateway", "Cure: one of detection, rectification, fusion"),
        ("rust", "gateway", "Cure: one of detection"),
        ("c", "fusion", "Cure: one of detection, or --lang python"),
    ] {
        let (succeeded, output) = run(&["stage", "new", kind, "--lang", lang, folder]);
        assert!(!succeeded && output.contains(cure), "{output}");
    }
}

#[test]
fn each_new_stage_is_the_example_and_names_its_own_place() {
    let scratch = Scratch::new("stage-new-each");
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples");
    for (lang, kinds) in EXAMPLES {
        for &(kind, name) in kinds {
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

/// What cargo knows of the packages of a manifest.
fn metadata(manifest: &Path) -> Value {
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--offline", "--no-deps", "--format-version", "1", "--manifest-path"])
        .arg(manifest)
        .output()
        .expect("cargo runs this test");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    serde_json::from_slice(&output.stdout).expect("it is JSON")
}

/// The package with this name.
fn package<'a>(metadata: &'a Value, name: &str) -> &'a Value {
    let packages = metadata["packages"].as_array().expect("there are some");
    packages.iter().find(|package| package["name"] == name).expect("it is one of them")
}

/// A stage whose manifest lacks a dependency or a feature would not build outside of the workspace.
/// Its text was built with these tests.
#[test]
fn a_new_stage_in_rust_depends_on_all_that_its_example_depends_on() {
    let scratch = Scratch::new("stage-new-rust");
    let nowhere = scratch.path("nowhere");
    let nowhere = nowhere.to_str().expect("a plain path");
    let new = ["stage", "new", "detection", "--lang", "rust", nowhere, "--sources", "/nowhere"];
    let (succeeded, output) = run(&new);
    assert!(!succeeded && output.contains("Cure: --sources FOLDER"), "{output}");
    let (folder, _) = write(&scratch, "detection", "rust");
    let example =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/rust/detector/Cargo.toml");
    let (written, ours) = (metadata(&folder.join("Cargo.toml")), metadata(&example));
    let [written, ours] = [&written, &ours].map(|known| package(known, "my-detector"));
    assert_eq!(written["edition"], ours["edition"]);
    let dependencies = |package: &Value| {
        let known = package["dependencies"].as_array().expect("there are some").iter();
        known
            .map(|known| {
                let facts = ["name", "req", "features", "uses_default_features", "path", "kind"];
                facts.map(|fact| known[fact].to_string())
            })
            .collect::<BTreeSet<_>>()
    };
    assert!(!dependencies(ours).is_empty());
    assert_eq!(dependencies(written), dependencies(ours));
}

#[test]
fn the_example_in_rust_keeps_the_contract_and_takes_over() {
    // Its text was built with these tests.
    let detector = flockeye().with_file_name("my-detector");
    let detector = detector.to_str().expect("a plain path");
    assert_keeps_the_contract("detection", detector);
    assert_takes_over("new-rust", detector);
}
