//! What `flockeye eval` and `flockeye experiment` make of real flights, and of files that are not
//! as they should be.

use std::path::Path;

use flockeye_tests::{Flight, SMALL_FLIGHT, Scratch, run, succeeds};
use serde_json::Value;

fn text(path: &Path) -> &str {
    path.to_str().expect("temporary paths are plain")
}

/// The small flight, seen well enough to be found within a few frames.
fn settings() -> impl Iterator<Item = &'static str> {
    SMALL_FLIGHT.iter().copied().chain(["camera.width=2048", "camera.height=1024"])
}

/// Runs `flockeye` with these arguments and these settings, and reads the JSON object that it
/// prints.
fn found(arguments: &[&str], set: &[&'static str]) -> Value {
    let settings = settings().chain(set.iter().copied()).flat_map(|setting| ["--set", setting]);
    let arguments: Vec<&str> = arguments.iter().copied().chain(settings).collect();
    let output = succeeds(&arguments);
    let json = output.lines().find(|line| line.starts_with('{'));
    serde_json::from_str(json.unwrap_or_else(|| panic!("no JSON in:\n{output}"))).expect("JSON")
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

#[test]
fn a_flight_is_judged_and_drawn() {
    let scratch = Scratch::new("judged");
    let (poses, truth) = (scratch.path("poses.csv"), scratch.path("truth.csv"));
    let arguments = ["--profile", "repeat", "--poses", text(&poses), "--truth", text(&truth)];
    let set: Vec<&str> = settings().chain(["simulator.frames=40"]).collect();
    let mut flight = Flight::start("judged", &arguments, &set);
    flight.assert_ends_well();

    let report = scratch.path("report");
    let files = ["eval", "--poses", text(&poses), "--truth", text(&truth)];
    let output = succeeds(&[&files[..], &["--json", "--report", text(&report)]].concat());
    let evaluation: Value = serde_json::from_str(&output).expect("nothing but JSON");
    let bins = evaluation["bins"].as_array().expect("bins");
    let all = bins.last().expect("the last is everything");
    assert!(all["to_m"].is_null() && number(&all["eligible"]) > 20.0, "{all}");
    assert!(number(&all["measured"]) > 0.5 * number(&all["eligible"]), "{all}");
    for table in ["published", "measurement"] {
        let errors = &all[table];
        assert!(number(&errors["position_mm"]["median"]) < 20.0, "{table}: {errors}");
        assert!(number(&errors["rotation_deg"]["median"]) < 5.0, "{table}: {errors}");
        // Parts are no larger than the whole.
        let worst = |what: &str| number(&errors[what]["worst"]);
        assert!(worst("along_mm") <= worst("position_mm") + 1e-9, "{errors}");
        assert!(worst("across_mm") <= worst("position_mm") + 1e-9, "{errors}");
    }
    assert_eq!(evaluation["false_poses"], 0, "{evaluation}");
    let sources = &evaluation["sources"];
    assert_eq!(
        number(&sources["decoded"]) + number(&sources["aligned"]),
        number(&evaluation["measured"])
    );
    assert!(number(&evaluation["latency"]["median_ms"]) > 0.0);
    for what in ["measurements", "tracks"] {
        for part in ["position", "rotation"] {
            let nees = &evaluation["nees"][what][part];
            assert!(number(&nees["mean"]) > 0.0, "{what}, {part}: {nees}");
            assert!(number(&nees["low"]) < 3.0 && number(&nees["high"]) > 3.0, "{nees}");
        }
    }
    let page = std::fs::read_to_string(report.join("index.html")).expect("it was written");
    assert_eq!(page.matches("<svg").count(), 8, "distance, three axes, three looks, the error");
    assert!(!page.contains("http"), "nothing is fetched");

    let output = succeeds(&files);
    for wanted in ["distance m", "all ", "NEES of tracks, position: mean", "latency median"] {
        assert!(output.contains(wanted), "{wanted:?} is missing in:\n{output}");
    }
}

#[test]
fn poses_predicted_for_the_time_of_sending_are_judged_by_the_truth_of_then() {
    let scratch = Scratch::new("predicted");
    let (poses, truth) = (scratch.path("poses.csv"), scratch.path("truth.csv"));
    let recorded = ["--poses", text(&poses), "--truth", text(&truth)];
    let arguments = [&["--profile", "flight", "--for", "4s"], &recorded[..]].concat();
    let mut flight = Flight::start("predicted", &arguments, SMALL_FLIGHT);
    flight.assert_ends_well();
    let output = succeeds(&[&["eval", "--json"], &recorded[..]].concat());
    let found: Value = serde_json::from_str(&output).expect("nothing but JSON");
    let predictions = &found["predictions"]["measured"];
    assert!(number(&predictions["compared"]) > 10.0, "{predictions}");
    // A pose leaves some milliseconds after its exposure, and moves less meanwhile than it is off.
    assert!(number(&predictions["ahead_ms"]["median"]) > 1.0, "{predictions}");
    assert!(number(&predictions["position_mm"]["median"]) < 20.0, "{predictions}");
    assert!(number(&predictions["rotation_deg"]["median"]) < 5.0, "{predictions}");
    assert!(number(&predictions["nees"]["position"]["inside_99"]) > 0.5, "{predictions}");
    let (succeeded, output) = run(&[&["eval"], &recorded[..]].concat());
    assert!(succeeded && output.contains("poses predicted for the time of sending"), "{output}");
}

#[test]
fn searches_are_compared_on_the_same_flight() {
    let found = found(&["experiment", "search", "--frames", "12", "--json"], &[]);
    let rows = found["rows"].as_array().expect("rows");
    assert_eq!(
        rows.iter().map(|row| &row["mode"]).collect::<Vec<_>>(),
        ["greedy", "optimized", "roi"]
    );
    for row in rows {
        assert_eq!(row["frames"], 12, "{row}");
        assert_eq!(row["eligible"], rows[0]["eligible"], "another flight: {row}");
        // The greedy search stops at the first marker, which alone does not tell a pose.
        if row["mode"] != "greedy" {
            assert!(number(&row["captured"]) > 0.0 && number(&row["mean_error_cm"]) < 5.0, "{row}");
        }
        assert_eq!(row["false_poses"], 0, "{row}");
        // Which of the two is larger is for the machine to decide.
        assert!(number(&row["frames_per_s"]) > 0.0, "{row}");
        assert!(number(&row["wall_frames_per_s"]) > 0.0, "{row}");
    }
    assert_eq!(number(&found["paper"][1]["captured"]), 395.0);
}

#[test]
fn partitions_are_compared_on_the_same_flight() {
    let found = found(&["experiment", "partitions", "--frames", "4", "--json"], &[]);
    let rows = found["rows"].as_array().expect("rows");
    let ways: Vec<_> = rows.iter().map(|row| (number(&row["count"]), &row["method"])).collect();
    let wanted = [6.0, 12.0, 24.0].map(|count| [(count, "paper"), (count, "covering")]).concat();
    assert!(ways.iter().zip(&wanted).all(|(a, b)| a.0 == b.0 && a.1 == b.1), "{ways:?}");
    assert_eq!(ways.len(), wanted.len());
    for row in rows {
        assert_eq!((&row["frames"], &row["eligible"]), (&4.into(), &rows[0]["eligible"]), "{row}");
    }
    // In four frames not every cut shows it well enough.
    assert!(rows.iter().any(|row| number(&row["captured"]) > 0.0), "{rows:?}");
    // The smallest circles are no larger than those round spread points.
    for pair in rows.chunks(2) {
        assert!(number(&pair[1]["theta_deg"]) <= number(&pair[0]["theta_deg"]) + 1e-6, "{pair:?}");
    }
    assert_eq!(number(&found["paper"][1]["frames_per_s"]), 4.5);
}

#[test]
fn consistency_is_worked_out_over_flights_of_their_own() {
    let arguments = ["experiment", "consistency", "--runs", "3", "--frames", "10", "--json"];
    let found = found(&arguments, &["simulator.seed=5"]);
    assert_eq!(found["seeds"], serde_json::json!([5, 7]));
    for what in ["measurements", "tracks"] {
        for part in ["position", "rotation"] {
            let nees = &found[what][part];
            let samples = number(&nees["samples"]);
            assert!((4.0..=30.0).contains(&samples), "{what}, {part}: {nees}");
            assert!(number(&nees["mean"]) > 0.0, "{nees}");
            let consistent = nees["verdict"] == "consistent";
            let bounds = number(&nees["low"])..=number(&nees["high"]);
            assert_eq!(consistent, bounds.contains(&number(&nees["mean"])), "{nees}");
        }
    }
    assert!(found["passes"].is_boolean());
}

const POSES: &str = "frame,stamp_s,target,px,py,pz,qx,qy,qz,qw,state,markers,latency_ms\n\
                     3,0.1,alpha,1,0,0,0,0,0,1,confirmed,2,9.5\n";
const TRUTH: &str = "frame,t_s,body,x,y,z,qw,qx,qy,qz,n_markers_vis90,localisable\n\
                     3,0.1,alpha,1,0,0,1,0,0,0,2,1\n";

#[test]
fn files_that_are_not_as_they_should_be_are_refused_with_place_and_cure() {
    let scratch = Scratch::new("eval-bad");
    let (poses, truth) = (scratch.path("p.csv"), scratch.path("t.csv"));
    let header = |table: &str| table.lines().next().expect("a header").to_owned() + "\n";
    let cases = [
        (POSES.into(), TRUTH.replace(",z,", ",height,"), "has no column z. Cure: "),
        (POSES.replace(",state", ",stat"), TRUTH.into(), "has no column state. Cure: record"),
        (
            POSES.replace("alpha,1", "alpha,one"),
            TRUTH.into(),
            "p.csv, line 2, column px: 'one' is not",
        ),
        (
            POSES.into(),
            TRUTH.replace("0.1", "inf"),
            "t.csv, line 2, column t_s: 'inf' is not a finite",
        ),
        (POSES.into(), header(TRUTH), "says nothing of any frame"),
        (POSES.into(), String::new(), "has no column frame, t_s"),
        (POSES.replace("\n3,", "\n77,"), TRUTH.into(), "(frames 77 to 77) and"),
    ];
    for (poses_text, truth_text, wanted) in cases {
        std::fs::write(&poses, &poses_text).expect("it can be written");
        std::fs::write(&truth, &truth_text).expect("it can be written");
        let (succeeded, output) = run(&["eval", "--poses", text(&poses), "--truth", text(&truth)]);
        assert!(!succeeded, "{wanted:?}:\n{output}");
        assert!(output.contains(wanted) && output.contains("Cure: "), "{wanted:?}:\n{output}");
        assert!(!output.contains("panicked"), "{output}");
    }
    // Nobody found is an outcome, not a mistake.
    std::fs::write(&poses, header(POSES)).expect("it can be written");
    std::fs::write(&truth, TRUTH).expect("it can be written");
    let (succeeded, output) = run(&["eval", "--poses", text(&poses), "--truth", text(&truth)]);
    assert!(succeeded && output.contains("0 poses measured"), "{output}");
}

#[test]
fn experiments_say_what_they_lack() {
    let scratch = Scratch::new("experiment-bad");
    let truth = scratch.path("t.csv");
    std::fs::write(&truth, TRUTH).expect("it can be written");
    for (arguments, wanted) in [
        (&["search", "--source", "nowhere.mp4"][..], "has no truth of its own. Cure: give it with"),
        (&["search", "--truth", text(&truth)], "a simulated flight has its own truth. Cure: "),
        (&["partitions", "--profile", "flight"], "works on every frame. Cure: leave out"),
        (&["consistency", "--source", "nowhere.mp4"], "cannot be had. Cure: simulate them"),
        (&["search", "--set", "simulator.distance_m=[2, 1]"], "simulator.distance_m"),
    ] {
        let (succeeded, output) = run(&[&["experiment"], arguments].concat());
        assert!(!succeeded && output.contains(wanted), "{wanted:?}:\n{output}");
    }
}
