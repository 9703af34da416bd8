//! Commands that `flockeye` passes on to `flockeye-lab`, and runs that the lab starts.

use std::process::Command;
use std::time::{Duration, Instant};

use flockeye_runtime::instance::Instance;
use flockeye_tests::{Flight, SMALL_FLIGHT, Scratch, WATCHDOG, flockeye, run, succeeds, unique};
use rustix::process::Signal;

#[test]
fn flockeye_has_the_commands_of_the_lab() {
    let said = succeeds(&["--help"]);
    for wanted in ["  up ", "(by flockeye-lab):", "  eval        Compare recorded poses"] {
        assert!(said.contains(wanted), "{wanted:?} is missing in:\n{said}");
    }
    for arguments in [&["eval", "--help"][..], &["help", "eval"]] {
        let (is_well, said) = run(arguments);
        assert!(is_well && said.contains("Usage: flockeye eval"), "{said}");
        assert!(said.contains("--report"), "{said}");
    }
    let mut command = Command::new(flockeye());
    command.args(["partition", "--counts", "3"]);
    let mut flight = Flight::launch(&unique("status"), command);
    assert_eq!(flight.wait().code(), Some(2), "the lab's own status:\n{}", flight.output());
}

#[test]
fn a_missing_lab_is_reported_with_the_cure() {
    let scratch = Scratch::new("alone");
    let alone = scratch.path("flockeye");
    std::fs::copy(flockeye(), &alone).expect("it can be copied");
    let mut command = Command::new(&alone);
    command.args(["eval", "--help"]).env("PATH", scratch.path(""));
    let mut flight = Flight::launch(&unique("alone"), command);
    assert_eq!(flight.wait().code(), Some(1), "{}", flight.output());
    let output = flight.output();
    for wanted in
        ["`flockeye eval` is a command of flockeye-lab", "Cure: build the whole workspace"]
    {
        assert!(output.contains(wanted), "{wanted:?} is missing in:\n{output}");
    }
}

/// `flockeye experiment search` on the small flight.
fn experiment(name: &str, set: &[&str]) -> Flight {
    let mut command = Command::new(flockeye());
    command.args(["experiment", "search", "--frames", "2000"]);
    for assignment in SMALL_FLIGHT.iter().chain(set) {
        command.args(["--set", assignment]);
    }
    Flight::launch(&unique(name), command)
}

#[test]
fn ctrl_c_ends_an_experiment_and_its_run() {
    let mut flight = experiment("stopped", &[]);
    let started = Instance::named(&format!("x{}-0", flight.pid().as_raw_nonzero()));
    let start = Instant::now();
    while !started.is_running() {
        assert!(start.elapsed() < WATCHDOG && !flight.has_ended(), "{}", flight.output());
        std::thread::sleep(Duration::from_millis(5));
    }
    // The experiment alone gets the signal, as from `kill`: it passes it on.
    flight.signal(Signal::INT);
    assert_eq!(flight.wait().code(), Some(1), "{}", flight.output());
    assert!(flight.output().contains("flockeye: stopped"), "{}", flight.output());
    assert!(started.shared_memory().is_empty() && !started.folder().exists());
}

#[test]
fn a_run_that_fails_is_reported_with_its_reason() {
    let broken = [r#"stages.fusion.command=["/nowhere/fusion"]"#];
    let mut flight = experiment("broken", &broken);
    assert_eq!(flight.wait().code(), Some(1), "{}", flight.output());
    let output = flight.output();
    for wanted in ["search greedy: fusion cannot start", "cannot start /nowhere/fusion"] {
        assert!(output.contains(wanted), "{wanted:?} is missing in:\n{output}");
    }
}
