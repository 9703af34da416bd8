//! The camera's own rotation, from the picture to the tracks.

use flockeye_contract::{MeasuredBy, RotationSource};
use flockeye_convert::{camera_turn, rotation};
use flockeye_tests::onlooker::Tape;
use flockeye_tests::{Flight, SMALL_FLIGHT, Scratch, run, succeeds};
use nalgebra::Vector3;
use rustix::process::{Signal, kill_process};
use serde_json::Value;

const FRAMES: u64 = 45;

/// An observer that leans by up to 12 degrees and yaws unevenly.
const GUSTS: &[&str] = &[
    "camera.width=1920",
    "camera.height=960",
    "simulator.distance_m=[0.9, 1.2]",
    "simulator.tilt_deg=12",
    "simulator.yaw_swing_deg_s=40",
];

fn fly(name: &str, more: &[&str]) -> Tape {
    let frames = format!("simulator.frames={FRAMES}");
    let set: Vec<&str> = SMALL_FLIGHT
        .iter()
        .chain(GUSTS)
        .copied()
        .chain([frames.as_str()])
        .chain(more.iter().copied())
        .collect();
    Tape::record(name, &["--profile", "repeat"], &set)
}

fn measured(tape: &Tape) -> usize {
    let tracks = tape.tracks.iter().flat_map(|(_, tracks)| tracks);
    tracks.filter(|track| track.measured_by != MeasuredBy::Nothing.code()).count()
}

#[test]
fn the_rotation_in_gusts_is_that_of_the_truth_and_velocities_do_without_it() {
    let tape = fly("gusts", &[]);
    assert_eq!(tape.rotations.len() as u64, FRAMES, "{}", tape.output);
    let known: Vec<_> = tape
        .rotations
        .iter()
        .filter_map(|message| Some((message, camera_turn(message)?)))
        .collect();
    assert!(known.len() as u64 >= FRAMES - 2, "{} known", known.len());
    let truth = |sequence: u64| {
        let of_frame = tape.truths.iter().find(|truth| truth.stamp.sequence == sequence);
        rotation(of_frame.expect("each frame has its truth").world_from_camera)
    };
    let (mut errors_deg, mut normalised, mut fastest_deg_s) = (Vec::new(), 0.0, 0.0f64);
    for (message, turn) in &known {
        let (earlier, later) = (truth(message.stamp.sequence - 1), truth(message.stamp.sequence));
        let expected = later.inverse() * earlier;
        let off = (turn.later_from_earlier * expected.inverse()).scaled_axis();
        errors_deg.push(off.norm().to_degrees());
        let information = turn.covariance.try_inverse().expect("it is positive");
        normalised += off.dot(&(information * off)) / known.len() as f64;
        fastest_deg_s = fastest_deg_s.max(turn.rate_in_camera.norm().to_degrees());
    }
    errors_deg.sort_by(f64::total_cmp);
    let median_deg = errors_deg[errors_deg.len() / 2];
    assert!(median_deg < 0.06, "{errors_deg:?}");
    assert!((0.3..12.0).contains(&normalised), "NEES {normalised}, 3 is right: {errors_deg:?}");
    assert!(fastest_deg_s > 25.0, "the flight was to be wild: {fastest_deg_s} degrees/s");
    assert!(measured(&tape) as u64 > FRAMES / 2, "{}", tape.output);
    // The simulated neighbour flies below 0.8 m/s and both sway; to the camera's axes it moves
    // faster.
    let last = tape.tracks.iter().rev().find_map(|(_, tracks)| tracks.first()).expect("a track");
    let speed = Vector3::from(last.linear_velocity).norm();
    assert!(speed < 2.0, "{speed} m/s");
}

#[test]
fn recorded_rotations_are_judged_by_the_truth() {
    let scratch = Scratch::new("rotations");
    let files = ["poses.csv", "truth.csv", "rotations.csv"].map(|name| scratch.path(name));
    let [poses, truth, rotations] =
        [&files[0], &files[1], &files[2]].map(|file| file.to_str().expect("a plain path"));
    let frames = format!("simulator.frames={FRAMES}");
    let set: Vec<&str> = SMALL_FLIGHT.iter().chain(GUSTS).copied().chain([&*frames]).collect();
    let recorded = ["--poses", poses, "--truth", truth, "--rotations", rotations];
    let arguments = [&["--profile", "repeat"], &recorded[..]].concat();
    let mut flight = Flight::start("rotations", &arguments, &set);
    flight.assert_ends_well();

    let output = succeeds(&[&["eval", "--json"], &recorded[..]].concat());
    let found: Value = serde_json::from_str(&output).expect("nothing but JSON");
    // The first frame has none before it.
    let judged = &found["rotations"];
    assert_eq!((&judged["known"], &judged["not_known"]), (&(FRAMES - 1).into(), &1.into()));
    assert_eq!(judged["compared"], FRAMES - 1);
    let number = |value: &Value| value.as_f64().unwrap_or_else(|| panic!("{value} in {judged}"));
    assert!(number(&judged["error_deg"]["median"]) < 0.06, "{judged}");
    assert!((0.3..12.0).contains(&number(&judged["nees"]["mean"])), "{judged}");
    // The rate settles in some frames.
    assert!(number(&judged["rate_error_deg_s"]["median"]) < 2.0, "{judged}");
    // A lossless run predicts to the exposure itself: nothing to judge.
    assert!(found["predictions"].is_null() && number(&found["measured"]) > 0.0, "{found}");

    let output = succeeds(&["eval", "--rotations", rotations, "--truth", truth]);
    for wanted in ["known in 44 frames, not known in 1", "error to each frame median", "its NEES"] {
        assert!(output.contains(wanted), "{wanted:?} is missing in:\n{output}");
    }
    for (arguments, wanted) in [
        (&["--rotations", rotations][..], "there is nothing to compare"),
        (&["--rotations", poses, "--truth", truth], "no column exposure_s, source, earlier_s"),
        (&["--rotations", rotations, "--gyro", truth], "no column gx, gy, gz. Cure: write"),
    ] {
        let (succeeded, output) = run(&[&["eval"], arguments].concat());
        assert!(!succeeded && output.contains(wanted), "{wanted:?}:\n{output}");
    }
}

#[test]
fn bodies_are_measured_at_the_time_of_their_rows() {
    let scratch = Scratch::new("readout");
    let files = ["poses.csv", "truth.csv"].map(|name| scratch.path(name));
    let [poses, truth] = [&files[0], &files[1]].map(|file| file.to_str().expect("a plain path"));
    let frames = format!("simulator.frames={FRAMES}");
    let readout = ["camera.readout_ms=25", &frames];
    let set: Vec<&str> = SMALL_FLIGHT.iter().chain(GUSTS).chain(&readout).copied().collect();
    let recorded = ["--poses", poses, "--truth", truth];
    let mut flight =
        Flight::start("readout", &[&["--profile", "repeat"], &recorded[..]].concat(), &set);
    assert!(flight.wait().success(), "{}", flight.output());
    let output = succeeds(&[&["eval", "--json"], &recorded[..]].concat());
    let found: Value = serde_json::from_str(&output).expect("nothing but JSON");
    let all = found["bins"].as_array().and_then(|bins| bins.last()).expect("a bin of all");
    let number = |value: &Value| value.as_f64().unwrap_or_else(|| panic!("{value} in {all}"));
    assert!(number(&all["measured"]) > 0.8 * number(&all["eligible"]), "{all}");
    // Taken as exposed in the middle of the frame, they are off by 4.6 mm in the median.
    assert!(number(&all["measurement"]["position_mm"]["median"]) < 2.5, "{all}");
    assert_eq!(found["false_poses"], 0, "{found}");
}

#[test]
fn without_egomotion_nothing_is_said_of_the_rotation_and_nobody_waits() {
    let tape = fly("calm", &["egomotion.enabled=false"]);
    assert!(tape.rotations.is_empty());
    assert!(!tape.output.contains("egomotion"), "{}", tape.output);
    tape.assert_every_frame_ended_once(FRAMES);
}

#[test]
fn a_lossless_flight_outlives_an_egomotion_that_says_nothing() {
    let silent = r#"stages.egomotion.command=["sh","-c","while :; do sleep 0.1; done"]"#;
    let tape = fly("silent", &[silent, "fusion.deadline_ms=1000"]);
    tape.assert_every_frame_ended_once(FRAMES);
    assert!(tape.output.contains("no rotation of the camera has come: egomotion is away"));
    assert!(measured(&tape) > 0, "{}", tape.output);
}

#[test]
fn a_flight_goes_on_while_egomotion_is_replaced() {
    let set: Vec<&str> = SMALL_FLIGHT.to_vec();
    let mut flight = Flight::start("replaced", &[], &set);
    flight.wait_for("confirmed");
    let egomotion = flight.stages("flockeye-egomotion")[0];
    kill_process(egomotion, Signal::KILL).expect("it can be killed");
    flight.wait_for("egomotion was killed by signal 9; it is started again");
    flight.wait_for("confirmed");
    flight.end_by(Signal::INT);
}

#[test]
fn a_rotation_says_what_it_was_measured_by() {
    let tape = fly("source", &["simulator.frames=3"]);
    let sources: Vec<u32> = tape.rotations.iter().map(|rotation| rotation.source).collect();
    let (nothing, picture) = (RotationSource::Nothing.code(), RotationSource::Picture.code());
    assert_eq!(sources, [nothing, picture, picture], "the first frame has none before it");
}
