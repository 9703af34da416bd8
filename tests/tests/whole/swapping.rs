//! Stages that are swapped in flight, and a pipeline that is asked what runs.

use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::process::Command;
use std::time::Duration;

use flockeye_tables::{FrameTimes, PoseRow, read};
use flockeye_tests::{Flight, POSES_FLOW, Scratch, WATCHDOG, flockeye, run, small_flight, unique};
use serde_json::Value;

fn fly(name: &str, arguments: &[&str], more: &[&str]) -> Flight {
    Flight::with_poses(name, arguments, &small_flight(more))
}

fn silent_detector() -> String {
    flockeye().with_file_name("silent-detector").to_string_lossy().into_owned()
}

#[test]
fn no_frame_is_lost_and_no_pose_comes_twice_when_each_stage_is_swapped() {
    let scratch = Scratch::new("swaps");
    let files = ["poses.csv", "times.csv"].map(|name| scratch.path(name));
    let [poses, times] = [&files[0], &files[1]].map(|file| file.to_str().expect("a plain path"));
    let recorded = ["--poses", poses, "--frame-times", times];
    let mut flight = fly("swaps", &recorded, &[]);
    for worker in ["detection", "detection.1", "rectification", "egomotion", "fusion"] {
        // Tests beside this one take the processor at times.
        let (succeeded, output) = flight.ask(&["swap", worker, "--within", "60s"]);
        assert!(succeeded, "{output}\n{}", flight.output());
        for part in ["works in the old one's shadow", "it takes over at frame", "is swapped after"]
        {
            assert!(output.contains(part), "{part:?} is missing in:\n{output}");
        }
    }
    let (_, output) = flight.ask(&["status", "--json"]);
    let status: Value = serde_json::from_str(&output).expect("nothing but JSON");
    let generations: BTreeMap<&str, u64> = status["workers"]
        .as_array()
        .expect("a list")
        .iter()
        .map(|worker| {
            let name = worker["worker"].as_str().expect("a name");
            (name, worker["generation"].as_u64().expect("a number"))
        })
        .collect();
    for worker in ["detection", "detection.1", "rectification", "egomotion", "fusion"] {
        assert!(generations[worker] >= 1, "{generations:?}");
    }
    assert_eq!(generations["simulator"], 0);
    let (succeeded, output) = flight.ask(&["stop"]);
    assert!(succeeded, "{output}");
    flight.assert_ends_well();

    let rows: Vec<PoseRow> = read(files[0].as_path()).expect("poses were recorded");
    let told: BTreeSet<_> = rows.iter().map(|row| (row.frame, row.target.clone())).collect();
    assert_eq!(told.len(), rows.len(), "a pose came twice");
    let ends: Vec<FrameTimes> = read(files[1].as_path()).expect("times were recorded");
    let frames: BTreeSet<u64> = ends.iter().map(|times| times.frame).collect();
    assert_eq!(frames.len(), ends.len(), "a frame ended twice");
    // One track: coasting, it stays; broken, it would be lost and tentative again.
    assert!(!flight.output().contains("alpha lost"), "{}", flight.output());
    let measured = rows.iter().filter(|row| row.is_measured()).count();
    assert!(measured * 10 > frames.len() * 8, "{measured} of {}", frames.len());
}

#[test]
fn a_lossless_run_swaps_nothing() {
    let flight = fly("loss-swap", &["--profile", "repeat"], &[]);
    let (succeeded, output) = flight.ask(&["swap", "detection"]);
    assert!(!succeeded && output.contains("a lossless run is for evaluation"), "{output}");
    flight.stop();
}

#[test]
fn a_source_is_swapped_with_a_gap_that_is_told() {
    let flight = fly("swap-source", &[], &[]);
    let (succeeded, output) = flight.ask(&["swap", "simulator", "--within", "60s"]);
    assert!(succeeded, "{output}\n{}", flight.output());
    for part in ["the old process ends first", "simulator is swapped; ", " s passed without it"] {
        assert!(output.contains(part), "{part:?} is missing in:\n{output}");
    }
    // The old program is started again if the new one does not work.
    let command = ["swap", "simulator", "--within", "2s", "--", "sleep", "100"];
    let (succeeded, output) = flight.ask(&command);
    assert!(!succeeded && output.contains("The old program is started again"), "{output}");
    let (succeeded, output) = flight.ask(&["restart", "simulator"]);
    assert!(succeeded && output.contains("simulator runs (process "), "{output}");
    flight.stop();
}

#[test]
fn a_stage_that_owns_a_port_or_device_is_put_back_if_the_new_one_does_not_work() {
    let mut flight =
        fly("gateway", &[], &["gateway.enabled=true", "gateway.listen=[tcp/127.0.0.1:0]"]);
    let (succeeded, output) = flight.ask(&["swap", "gateway", "--within", "60s"]);
    assert!(succeeded && output.contains("s passed without it"), "{output}\n{}", flight.output());
    for worker in ["gateway", "simulator"] {
        for program in ["false", "sleep"] {
            let swap = ["swap", worker, "--within", "2s", "--", program, "60"];
            let (succeeded, output) = flight.ask(&swap);
            let wanted = format!("{worker} is not swapped: the new process did not work within");
            assert!(!succeeded && output.contains(&wanted), "{output}\n{}", flight.output());
            let (succeeded, output) = flight.ask(&["restart", worker]);
            assert!(succeeded, "{output}\n{}", flight.output());
            let (_, output) = flight.ask(&["status", "--json"]);
            let status: Value = serde_json::from_str(&output).expect("nothing but JSON");
            let workers = status["workers"].as_array().expect("a list");
            let found = workers.iter().find(|found| found["worker"] == worker).expect("it is one");
            let command = found["command"][0].as_str().expect("a program");
            assert!(command.ends_with(&format!("flockeye-{worker}")), "{output}");
        }
    }
    let frames = flight.output().matches(POSES_FLOW).count();
    let start = std::time::Instant::now();
    while flight.output().matches(POSES_FLOW).count() < frames + 2 {
        assert!(start.elapsed() < WATCHDOG, "no pose any more:\n{}", flight.output());
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(!flight.has_ended());
    flight.stop();
}

#[test]
fn what_cannot_take_over_is_refused_with_its_reason_and_the_old_one_stays() {
    let scratch = Scratch::new("refused-swaps");
    let plain = scratch.path("plain");
    std::fs::write(&plain, "no program").expect("a file can be written");
    let plain = plain.to_str().expect("a plain path");
    let flight = fly("refused", &[], &[]);
    let before = flight.stages("flockeye-detection");
    let silent = silent_detector();
    for (command, wanted) in [
        (vec!["swap", "detection", "--", "/nowhere/detector"], "there is no program /nowhere"),
        (vec!["swap", "detection", "--", plain], "cannot be executed. Cure: chmod +x"),
        (vec!["swap", "detection", "--", "false"], "the new process ended with status 1"),
        (vec!["swap", "detection", "--within", "2s", "--", "sleep", "100"], "has answered nothing"),
        (
            vec!["swap", "detection", "--within", "8s", "--", &silent],
            "it found 0 where the old one",
        ),
        (vec!["swap", "detection", "--within", "2s", "--", &silent, "mute"], "answered nothing"),
        (vec!["swap", "detection.7"], "detection.7 is not part of this pipeline. Parts: "),
        (vec!["swap", "gateway"], "gateway is not part of this pipeline"),
        (
            vec!["swap", "detection", "--set", "simulator.seed=9"],
            "simulator cannot be changed by a swap",
        ),
        (vec!["swap", "detection", "--set", "detection.windows=[7"], "the running configuration"),
    ] {
        let (succeeded, output) = flight.ask(&command);
        assert!(!succeeded && output.contains(wanted), "{wanted:?} is missing in:\n{output}");
    }
    assert_eq!(flight.stages("flockeye-detection"), before, "the old ones are untouched");
    // With --accept-worse it takes over, and can be swapped back.
    let (succeeded, output) = flight.ask(&["swap", "detection", "--accept-worse", "--", &silent]);
    assert!(succeeded, "{output}");
    assert_eq!(flight.stages("silent-detector").len(), 1);
    // There is nothing to compare it with: half of the time is waited for that.
    let own = flockeye().with_file_name("flockeye-detection");
    let (succeeded, output) =
        flight.ask(&["swap", "detection", "--within", "12s", "--", own.to_str().expect("plain")]);
    assert!(succeeded, "{output}");
    flight.stop();
}

#[test]
fn one_that_fails_after_it_took_over_is_taken_back() {
    let mut flight = fly("back", &[], &[]);
    let silent = silent_detector();
    let command = ["swap", "detection", "--accept-worse", "--", &silent, "leave"];
    let (succeeded, output) = flight.ask(&command);
    assert!(!succeeded, "{output}");
    for part in
        ["it takes over at frame", "the old process counts again", "after it had taken over"]
    {
        assert!(output.contains(part), "{part:?} is missing in:\n{output}");
    }
    assert_eq!(flight.stages("flockeye-detection").len(), 2);
    flight.wait_for(POSES_FLOW);
    flight.stop();
}

#[test]
fn a_second_swap_at_once_is_told_to_wait() {
    let mut flight = fly("at-once", &[], &[]);
    let mut command = Command::new(flockeye());
    command.args(["swap", "detection", "--instance", flight.instance.name(), "--within", "5s"]);
    command.args(["--", "sleep", "100"]);
    let mut first = Flight::launch(&unique("first"), command);
    flight.wait_for("detection: process ");
    let (succeeded, output) = flight.ask(&["swap", "fusion"]);
    assert!(!succeeded && output.contains("detection is being swapped. Cure: wait"), "{output}");
    assert!(!first.wait().success(), "{}", first.output());
    flight.stop();
}

#[test]
fn settings_are_swapped_in_and_stay() {
    let flight = fly("settings", &[], &[]);
    let set = ["swap", "fusion", "--within", "60s", "--set", "fusion.covariance_scale=1.5"];
    let (succeeded, output) = flight.ask(&set);
    assert!(succeeded, "{output}\n{}", flight.output());
    let resolved = flight.instance.pipeline().expect("it is there");
    let value = serde_json::to_value(&resolved).expect("it is plain");
    assert_eq!(value["fusion"]["covariance_scale"], 1.5);
    flight.stop();
}

#[test]
fn what_runs_is_shown_and_workers_are_ended_and_started() {
    let flight = fly("manage", &[], &[]);
    let (succeeded, output) = flight.ask(&["status"]);
    assert!(succeeded, "{output}");
    for part in ["worker", "fusion", "detection.1", "ready", "flockeye-simulator"] {
        assert!(output.contains(part), "{part:?} is missing in:\n{output}");
    }
    let (succeeded, output) = flight.ask(&["stop", "egomotion"]);
    assert!(succeeded && output.contains("egomotion has stopped"), "{output}");
    assert!(flight.stages("flockeye-egomotion").is_empty());
    let (_, output) = flight.ask(&["status"]);
    assert!(output.contains("stopped"), "{output}");
    let (succeeded, output) = flight.ask(&["start", "egomotion"]);
    assert!(succeeded && output.contains("egomotion runs (process "), "{output}");
    let (succeeded, output) = flight.ask(&["start", "egomotion"]);
    assert!(!succeeded && output.contains("egomotion runs already"), "{output}");
    let before = flight.stages("flockeye-detection");
    let (succeeded, output) = flight.ask(&["restart", "detection.1"]);
    assert!(succeeded && output.contains("generation 1"), "{output}");
    assert_ne!(flight.stages("flockeye-detection"), before);
    let (succeeded, output) = flight.ask(&["restart", "fusions"]);
    assert!(!succeeded && output.contains("there is no stage 'fusions'"), "{output}");
    flight.stop();
}

#[test]
fn control_clients_that_babble_or_hang_are_dropped() {
    let flight = fly("babble", &[], &[]);
    let path = flight.instance.folder().join("control");
    let hanging = UnixStream::connect(&path).expect("it listens");
    let mut babbling = UnixStream::connect(&path).expect("it listens");
    babbling.set_read_timeout(Some(Duration::from_secs(60))).expect("a time");
    babbling.write_all(&[0xff; 5000]).expect("it takes it");
    babbling.write_all(b"\n").expect("it takes it");
    let mut answer = String::new();
    BufReader::new(&babbling).read_line(&mut answer).expect("it answers");
    assert!(answer.contains("not a request"), "{answer}");
    let (succeeded, output) = flight.ask(&["status"]);
    assert!(succeeded, "{output}");
    hanging.set_read_timeout(Some(Duration::from_secs(60))).expect("a time");
    let mut answer = String::new();
    BufReader::new(&hanging).read_line(&mut answer).expect("it is told");
    assert!(answer.contains("no request came"), "{answer}");
    flight.stop();
}

#[test]
fn clean_refuses_a_name_that_is_not_there() {
    let (succeeded, output) = run(&["clean", "--instance", "no-such-flight"]);
    assert!(!succeeded && output.contains("no pipeline 'no-such-flight' left files"), "{output}");
}
