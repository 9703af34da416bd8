//! `flockeye partition` as a user runs it.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use flockeye_geometry::fixtures::BEST_KNOWN_DEG;
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};

use serde_json::Value;

fn flockeye_lab(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_flockeye-lab"))
        .arg("partition")
        .args(arguments)
        .output()
        .unwrap()
}

fn printed(arguments: &[&str]) -> String {
    let output = flockeye_lab(arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

fn scratch(name: &str) -> PathBuf {
    let folder = std::env::temp_dir().join(format!("flockeye-partition-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    folder.join(name)
}

#[test]
fn the_table_has_the_best_known_diameters() {
    let table: Value = serde_json::from_str(&printed(&["--counts", "4..32", "--json"])).unwrap();
    let rows = table["partitions"].as_array().unwrap();
    assert_eq!(rows.len(), 29);
    let theta = |count: u64| {
        let row = rows.iter().find(|row| row["count"] == count).unwrap();
        row["theta_deg"].as_f64().unwrap()
    };
    for (count, known) in BEST_KNOWN_DEG.into_iter().filter(|&(count, _)| count != 24) {
        assert!((theta(count as u64) - known).abs() < 1e-3, "{count}: {}", theta(count as u64));
    }
    assert!(theta(24) < 53.70, "{}", theta(24));
    assert_eq!(table["choice"], 12);
    for row in rows {
        let count = row["count"].as_u64().unwrap() as usize;
        assert_eq!(row["directions"].as_array().unwrap().len(), count);
        assert_eq!(row["rolls_deg"].as_array().unwrap().len(), count);
        let views = &row["views"];
        if let (Some(pixels), Some(round)) =
            (views["pixels"].as_f64(), views["circumscribed_pixels"].as_f64())
        {
            assert!(pixels < round, "{count}");
        }
    }
}

#[test]
fn what_is_stored_is_what_is_printed() {
    let stored = include_str!("../../../common/geometry/data/partitions.json");
    let cure = "cure: flockeye partition --json > /tmp/p && mv /tmp/p \
                common/geometry/data/partitions.json";
    assert_eq!(printed(&["--json"]), stored, "{cure}");
}

#[test]
fn the_papers_method_is_there() {
    let table = printed(&["--counts", "6,12,24", "--method", "paper", "--seed", "2"]);
    assert!(table.contains("method paper, seed 2"), "{table}");
    assert_eq!(printed(&["--counts", "6,12,24", "--method", "paper", "--seed", "2"]), table);
}

#[test]
fn wrong_arguments_are_refused_with_the_cure() {
    for (arguments, wanted) in [
        (["--counts", "3..8"], "4 to 128 views, not 3"),
        (["--counts", "32..4"], "write 4..32"),
        (["--counts", "many"], "no number"),
        (["--weights", "0.5,0.5,0.5"], "sum to 1"),
        (["--weights", "1,2"], "three numbers"),
        (["--margin", "nan"], "must be 0 or more"),
        (["--svg", "/nowhere/figure.svg"], "cannot write /nowhere/figure.svg"),
    ] {
        let output = flockeye_lab(&arguments);
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success() && message.contains(wanted), "{arguments:?}: {message}");
    }
}

#[test]
fn a_closed_pipe_is_no_panic() {
    let mut child = Command::new(env!("CARGO_BIN_EXE_flockeye-lab"))
        .args(["partition", "--json"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert!(!String::from_utf8_lossy(&output.stderr).contains("panicked"));
    assert!(output.status.success());
}

/// Whether tags are balanced, attributes quoted, and nothing is left over.
fn assert_is_xml(text: &str) {
    let mut open = Vec::new();
    let mut rest = text.trim();
    let mut elements = 0;
    while let Some(start) = rest.find('<') {
        let end = rest.find('>').expect("a tag ends");
        assert!(!rest[..start].contains('>') && !rest[..start].contains('&'));
        let tag = &rest[start + 1..end];
        assert!(!tag.contains('<') && tag.matches('"').count().is_multiple_of(2), "{tag}");
        let name = tag.trim_matches('/').split_whitespace().next().expect("a tag has a name");
        if tag.starts_with('/') {
            assert_eq!(open.pop(), Some(name));
        } else if !tag.ends_with('/') {
            open.push(name);
        }
        elements += 1;
        rest = &rest[end + 1..];
    }
    assert!(open.is_empty() && rest.is_empty() && elements > 10, "{open:?} {rest:?}");
    assert!(!text.contains("NaN") && !text.contains("inf"));
}

#[test]
fn drawings_are_well_formed() {
    let (figure, picture) = (scratch("figure.svg"), scratch("picture.svg"));
    let [figure_text, picture_text] = [&figure, &picture].map(|path| path.to_str().unwrap());
    printed(&["--counts", "6,12,13", "--svg", figure_text, "--picture", picture_text]);
    let figure = std::fs::read_to_string(figure).unwrap();
    assert_is_xml(&figure);
    // Three of each method, the paper's own three, the legend's three.
    assert_eq!(figure.matches("<circle").count(), 12);
    let picture = std::fs::read_to_string(picture).unwrap();
    assert_is_xml(&picture);
    assert!(picture.contains("N = 6"), "the first");
    std::fs::remove_dir_all(scratch("figure.svg").parent().unwrap()).unwrap();
}
