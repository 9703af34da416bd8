//! Stages that are tested alone against the contract.

use flockeye_tests::{flockeye, run};
use serde_json::Value;

/// A small sphere, so that the test takes seconds.
const SMALL: &[&str] = &["--set", "camera.width=1024", "--set", "camera.height=512"];

fn test(kind: &str, set: &[&str], candidate: &[&str]) -> (bool, String) {
    let candidate = if candidate.is_empty() { vec![] } else { [&["--"], candidate].concat() };
    run(&[&["stage", "test", kind], SMALL, set, &candidate].concat())
}

#[test]
fn our_own_stages_keep_the_contract() {
    for kind in ["detection", "rectification", "fusion"] {
        let (succeeded, output) = test(kind, &["--json"], &[]);
        assert!(succeeded, "{output}");
        let report: Value = serde_json::from_str(&output).expect("nothing but JSON");
        let checks = report["checks"].as_array().expect("a list");
        assert!(checks.len() > 10, "{output}");
        assert!(checks.iter().all(|check| check["wrong"].is_null()), "{output}");
        assert!(!report["figures"].as_array().expect("a list").is_empty(), "{output}");
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
    let (succeeded, output) = test("gateway", &[], &[]);
    assert!(!succeeded && output.contains("one of detection, rectification, fusion"), "{output}");
}
