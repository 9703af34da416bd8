//! Processes that do not do what they owe: each is named with its process, and the others fly on.

use std::time::Duration;

use flockeye_tests::{Flight, POSES_FLOW, flockeye, small_flight};
use rustix::process::{Signal, kill_process};

/// A setting by which detection worker 1 misbehaves, and worker 0 is Flockeye's own.
fn second_worker_that(misdeed: &str) -> String {
    let [bad, good] = ["silent-detector", "flockeye-detection"]
        .map(|program| flockeye().with_file_name(program).to_string_lossy().into_owned());
    let script =
        format!("if [ $FLOCKEYE_REPLICA = 1 ]; then exec {bad} {misdeed}; else exec {good}; fi");
    format!("stages.detection.command=[sh, -c, \"{script}\"]")
}

/// The lines that are no regular report.
fn wait_for_all(flight: &mut Flight, wanted: &[&str]) {
    for part in wanted {
        flight.wait_for(part);
    }
}

fn end(mut flight: Flight) {
    flight.end_by(Signal::INT);
}

/// A worker that takes part and answers nothing is named, kept out and replaced, and poses flow.
fn a_worker_that(misdeed: &str) {
    let command = second_worker_that(misdeed);
    let mut flight = Flight::start(misdeed, &[], &small_flight(&[&command]));
    wait_for_all(
        &mut flight,
        &[
            POSES_FLOW,
            "detection.1 (process ",
            "no view answered for 500 ms: it gets none until it answers",
            "no view answered for 500 ms, 3 times; it is killed and started again",
            "detection.1 is started again",
        ],
    );
    end(flight);
}

#[test]
fn a_worker_that_is_mute_is_named_and_replaced() {
    a_worker_that("mute");
}

#[test]
fn a_worker_that_holds_its_views_is_named_and_replaced() {
    a_worker_that("hold");
}

#[test]
fn a_worker_that_spins_is_named_and_replaced() {
    a_worker_that("spin");
}

#[test]
fn a_worker_that_hangs_is_replaced_after_a_heartbeat() {
    let command = second_worker_that("hang");
    let mut flight = Flight::start("hang", &[], &small_flight(&[&command]));
    wait_for_all(
        &mut flight,
        &[POSES_FLOW, "hangs: no health for 1.", "detection.1 is started again"],
    );
    end(flight);
}

#[test]
fn a_stage_that_is_stopped_is_replaced_after_a_heartbeat() {
    for stage in ["fusion", "egomotion"] {
        let mut flight = Flight::with_poses("stopped", &[], &small_flight(&[]));
        let pids = flight.stages(&format!("flockeye-{stage}"));
        let pid = pids.first().expect("it runs");
        kill_process(*pid, Signal::STOP).expect("it can be stopped");
        let line = format!("{stage} (process {}) hangs: no health for 1.", pid.as_raw_nonzero());
        wait_for_all(&mut flight, &[&line, &format!("{stage} is started again")]);
        end(flight);
    }
}

#[test]
fn a_worker_whose_messages_are_refused_is_replaced_and_given_up_for_a_while() {
    let command = second_worker_that("lie");
    let set = small_flight(&[&command, "stages.detection.backoff_s=[0.1, 0.1]"]);
    let mut flight = Flight::start("lie", &[], &set);
    wait_for_all(
        &mut flight,
        &[
            POSES_FLOW,
            // The number in the first warning depends on the number of views.
            "): flockeye/detection: 3 hits among the markers",
            "times; it is killed and started again",
            "also after it was started again. It is given up for 30 s; what is left: 1 other of this stage go on",
        ],
    );
    end(flight);
}

#[test]
fn a_worker_whose_records_cannot_be_true_is_named_and_replaced() {
    let command = second_worker_that("impersonate");
    let mut flight = Flight::start("impersonate", &[], &small_flight(&[&command]));
    let reason = "flockeye/detection: a record of worker 99; there are 2, counted from 0";
    wait_for_all(
        &mut flight,
        &[
            POSES_FLOW,
            "detection.1 (process ",
            &format!("): {reason}, "),
            "times; it is killed and started again",
        ],
    );
    end(flight);
}

#[test]
fn a_stage_that_is_never_ready_is_named_and_a_flight_without_a_frame_is_an_error() {
    let late = flockeye().with_file_name("silent-detector");
    let command = format!("stages.detection.command=[{}, late]", late.display());
    for (command, what) in [
        (command.as_str(), "detection (process "),
        ("stages.rectification.command=[sleep, \"100\"]", "rectification (process "),
    ] {
        let set = small_flight(&[command, "supervision.start_s=1"]);
        let mut flight = Flight::start("late", &["--for", "3s"], &set);
        let status = flight.wait();
        let output = flight.output();
        assert!(output.contains(what) && output.contains("for 1 s after its start"), "{output}");
        if what.starts_with("rectification") {
            assert_eq!(status.code(), Some(1), "{output}");
            assert!(output.contains("no frame was ever worked on"), "{output}");
        }
        flight.assert_nothing_left();
    }
}

#[test]
fn sigterm_to_one_process_is_a_polite_restart() {
    let mut flight = Flight::with_poses("polite", &[], &small_flight(&[]));
    for stage in ["detection", "fusion", "simulator"] {
        let pid = *flight.stages(&format!("flockeye-{stage}")).first().expect("it runs");
        kill_process(pid, Signal::TERM).expect("it can be asked to end");
        flight.wait_for(&format!("{stage} is started again"));
    }
    assert!(flight.output().contains("ended with status 0; it is started again in"));
    end(flight);
}

#[test]
fn what_is_left_without_a_stage_is_said_and_flies_on() {
    for (stage, left) in [
        ("egomotion", "neighbours are tracked as if the camera did not turn"),
        ("detection", "tracked neighbours are measured by their pixels"),
        ("rectification", "nothing is searched: tracks coast and end"),
        ("fusion", "the sphere is swept, and no pose is made of what is found"),
    ] {
        let never = format!("stages.{stage}.restart=never");
        let mut flight =
            Flight::start("never", &[], &small_flight(&[&never, "stages.detection.replicas=1"]));
        flight.wait_for(POSES_FLOW);
        let pid = *flight.stages(&format!("flockeye-{stage}")).first().expect("it runs");
        kill_process(pid, Signal::KILL).expect("it can be killed");
        let line = format!(
            "{stage} was killed by signal 9, and its restart policy does not start it again. It is \
             given up; what is left: {left}"
        );
        flight.wait_for(&line);
        std::thread::sleep(Duration::from_millis(300));
        assert!(!flight.has_ended(), "{}", flight.output());
        end(flight);
    }
}

#[test]
fn without_a_source_the_flight_ends_with_the_reason() {
    let mut flight =
        Flight::start("sourceless", &[], &small_flight(&["stages.simulator.restart=never"]));
    flight.wait_for(POSES_FLOW);
    let pid = *flight.stages("flockeye-simulator").first().expect("it runs");
    kill_process(pid, Signal::KILL).expect("it can be killed");
    assert_eq!(flight.wait().code(), Some(1), "{}", flight.output());
    let wanted = "simulator was killed by signal 9, and its restart policy does not start it again";
    assert!(flight.output().contains(wanted), "{}", flight.output());
    flight.assert_nothing_left();
}
