//! Stages that `flockeye stage new` writes, in each language.

use std::process::Command;

use flockeye_tests::{Scratch, flockeye, run};

#[test]
fn a_new_stage_is_written_once_and_only_where_there_is_an_example() {
    let scratch = Scratch::new("stage-new");
    let folder = scratch.path("mine");
    let folder = folder.to_str().expect("a plain path");
    let (succeeded, output) = run(&["stage", "new", "detection", folder]);
    assert!(succeeded && output.contains("flockeye swap detection"), "{output}");
    let text = std::fs::read_to_string(format!("{folder}/detector.py")).expect("it is written");
    assert!(text.contains(&format!("python3 {folder}/detector.py")), "{text}");
    let (succeeded, output) = run(&["stage", "new", "detection", folder]);
    assert!(!succeeded && output.contains("is there already"), "{output}");
    let (succeeded, output) = run(&["stage", "new", "gateway", folder]);
    assert!(!succeeded && output.contains("one of detection, rectification, fusion"), "{output}");
    let (succeeded, output) = run(&["stage", "new", "fusion", "--lang", "c", folder]);
    assert!(!succeeded && output.contains("'fusion' in C. Cure: one of detection"), "{output}");
}

#[test]
fn a_new_stage_in_c_is_the_example() {
    let scratch = Scratch::new("stage-new-c");
    let folder = scratch.path("mine");
    let folder = folder.to_str().expect("a plain path");
    let (succeeded, output) = run(&["stage", "new", "detection", "--lang", "c", folder]);
    assert!(
        succeeded && output.contains(&format!("-- {folder}/build/apriltag-detector")),
        "{output}"
    );
    let set = "--set bodies.dictionary=DICT_APRILTAG_36h11";
    let test = format!("flockeye stage test detection {set} -- {folder}");
    assert!(output.contains(&test), "{output}");
    let source = std::fs::read_to_string(format!("{folder}/apriltag_detector.c"));
    let source = source.expect("it is written");
    assert!(source.contains(&format!("cmake -S {folder} -B {folder}/build ")), "{source}");
    for (file, part) in
        [("apriltag_detector.c", "flockeye_stage_run"), ("CMakeLists.txt", "flockeye::stage")]
    {
        let text = std::fs::read_to_string(format!("{folder}/{file}")).expect("it is written");
        assert!(text.contains(part), "{text}");
    }
}

#[test]
fn a_new_stage_in_rust_has_the_dependencies_that_it_names_and_the_example_runs() {
    let scratch = Scratch::new("stage-new-rust");
    let folder = scratch.path("mine");
    let folder = folder.to_str().expect("a plain path");
    let nowhere = ["--sources", "/nowhere"];
    let new = ["stage", "new", "detection", "--lang", "rust", folder];
    let (succeeded, output) = run(&[&new[..], &nowhere].concat());
    assert!(!succeeded && output.contains("Cure: --sources FOLDER"), "{output}");
    let (succeeded, output) = run(&new);
    assert!(succeeded, "{output}");
    let manifest = format!("{folder}/Cargo.toml");
    let metadata = Command::new(env!("CARGO"))
        .args(["metadata", "--no-deps", "--format-version", "1", "--manifest-path", &manifest])
        .output()
        .expect("cargo runs this test");
    let text = String::from_utf8_lossy(&metadata.stdout);
    assert!(metadata.status.success() && text.contains("my-detector"), "{text}");
    for path in ["common/contract", "services/detection", "common/runtime"] {
        assert!(text.contains(path), "{path} is missing in {text}");
    }
    // The same text was built with these tests. It keeps the contract.
    let example = flockeye().with_file_name("my-detector");
    let example = example.to_str().expect("a plain path");
    let small = ["--set", "camera.width=1024", "--set", "camera.height=512"];
    let (succeeded, output) =
        run(&[&["stage", "test", "detection"], &small[..], &["--", example]].concat());
    assert!(succeeded, "{output}");
}
