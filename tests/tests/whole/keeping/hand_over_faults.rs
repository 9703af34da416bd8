//! Hand-overs in the middle of which the launcher, the old or the new process is killed.

use std::collections::BTreeSet;

use flockeye_tests::absent;

use super::*;

/// A hand-over, and the steps at which somebody is killed.
struct HandOver {
    name: &'static str,
    command: &'static [&'static str],
    steps: &'static [&'static str],
}

/// Each kind has the steps that those before it do not have.
const HAND_OVERS: [HandOver; 5] = [
    HandOver {
        name: "plain",
        command: &["swap", "fusion", "--within", "60s"],
        steps: &[
            "the shadow is written",
            "the shadow is said",
            "it is started",
            "taking over is written",
            "taking over is said",
            "it is swapped",
            "the old one is asked to end",
            "the end is written",
            "the end is said",
        ],
    },
    HandOver {
        name: "set",
        command: &["swap", "fusion", "--within", "60s", "--set", "fusion.covariance_scale=1.5"],
        steps: &["settings are written", "taking over is said", "it is swapped"],
    },
    // The new process works in the shadow, and ends by itself after it has taken over.
    HandOver {
        name: "back",
        command: &["swap", "detection", "--accept-worse", "--", SILENT_DETECTOR, "leave"],
        steps: &[
            "taking back is written",
            "taking back is said",
            "it is refused",
            "the new one is asked to end",
        ],
    },
    // The world's simulator is not doubled.
    HandOver {
        name: "alone",
        command: &["swap", "simulator", "--within", "60s"],
        steps: &["the old one ends first", "it is replaced"],
    },
    HandOver {
        name: "vain",
        command: &["swap", "simulator", "--within", "2s", "--", "sleep", "60"],
        steps: &["the old program is asked for"],
    },
];

/// Stands for the path of that program.
const SILENT_DETECTOR: &str = "silent-detector";

/// Begins a hand-over, and calls `strike` with the processes that were there before when it has
/// come to `step`.
fn hand_over_until(
    flight: &mut Flight,
    command: &[&str],
    step: &str,
    strike: impl FnOnce(&mut Flight, &BTreeSet<i32>),
) {
    let instance = flight.instance.name().to_owned();
    let before = pids(flight);
    let reached = flight.instance.folder().join("fault-reached");
    std::fs::write(flight.instance.folder().join("fault"), step).expect("it can be written");
    let silent = flockeye().with_file_name(SILENT_DETECTOR).to_string_lossy().into_owned();
    let command: Vec<String> = command
        .iter()
        .map(|word| if *word == SILENT_DETECTOR { silent.clone() } else { (*word).to_owned() })
        .collect();
    let begin = || {
        let (instance, command) = (instance.clone(), command.clone());
        std::thread::spawn(move || {
            ask(&instance, &command.iter().map(String::as_str).collect::<Vec<_>>())
        })
    };
    let mut swap = begin();
    let start = Instant::now();
    while !reached.exists() {
        assert!(start.elapsed() < WATCHDOG, "{step:?} is not reached:\n{}", flight.output());
        // On a busy machine a new process may rightly be found worse than the old one, before that
        // step.
        if swap.is_finished() && !reached.exists() {
            swap = begin();
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    strike(flight, &before);
    std::fs::remove_file(&reached).expect("it is there");
    // Whether it succeeds depends on who has died.
    swap.join().expect("it ends");
}

/// The processes of an instance's stages.
fn pids(flight: &Flight) -> BTreeSet<i32> {
    flight.stages("").into_iter().map(|pid| pid.as_raw_nonzero().get()).collect()
}

/// Whether the launcher has fault points; says so where it has none.
fn has_fault_points(flight: &Flight) -> bool {
    let has = flight.output().contains("this build has fault points");
    if !has {
        absent("fault-points", "a launcher with fault points (`make test` builds one)");
    }
    has
}

/// Waits until there are no processes but one for each worker, and no swap is under way.
fn wait_until_it_is_over(flight: &Flight) {
    let start = Instant::now();
    loop {
        let (_, output) = ask(flight.instance.name(), &["status", "--json"]);
        let status: Value = serde_json::from_str(&output).unwrap_or_default();
        let list = status["workers"].as_array().cloned().unwrap_or_default();
        let known: Option<BTreeSet<i32>> =
            list.iter().map(|worker| i32::try_from(worker["pid"].as_i64()?).ok()).collect();
        let all_run = !list.is_empty() && known == Some(pids(flight));
        if all_run && status["swapping"].is_null() {
            return;
        }
        assert!(start.elapsed() < WATCHDOG, "it is not over:\n{output}\n{}", flight.output());
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn a_launcher_that_dies_at_any_step_of_a_hand_over_leaves_a_flight_that_the_next_one_takes_over() {
    let instance = unique("fault-launcher");
    let mut flight = kept_flight(&instance);
    if !has_fault_points(&flight) {
        return;
    }
    for HandOver { name, command, steps } in HAND_OVERS {
        for step in steps {
            println!("{name}: {step}");
            hand_over_until(&mut flight, command, step, |flight, _| {
                flight.signal(Signal::KILL);
                flight.wait();
            });
            let mut next = Flight::start_as(&instance, &["--keep"], SMALL_FLIGHT);
            next.wait_for("egomotion (process");
            wait_for_a_pose(&mut next);
            wait_until_it_is_over(&next);
            flight = next;
        }
    }
    flight.stop();
}

fn survives_the_death_in_a_hand_over(name: &str, is_victim: fn(i32, &BTreeSet<i32>) -> bool) {
    let instance = unique(name);
    let mut flight = kept_flight(&instance);
    if !has_fault_points(&flight) {
        return;
    }
    for HandOver { name, command, steps } in HAND_OVERS {
        let worker = command[1];
        for step in steps {
            println!("{name}: {step}");
            let old = workers(&instance)[worker];
            hand_over_until(&mut flight, command, step, |flight, before| {
                let others: BTreeSet<i32> =
                    before.iter().copied().filter(|pid| *pid != old).collect();
                let of_worker = pids(flight).into_iter().filter(|pid| !others.contains(pid));
                of_worker.filter(|pid| is_victim(*pid, before)).for_each(kill);
            });
            wait_for_a_pose(&mut flight);
            wait_until_it_is_over(&flight);
        }
    }
    flight.stop();
}

#[test]
fn an_old_process_that_dies_at_any_step_of_a_hand_over_leaves_a_working_pipeline() {
    survives_the_death_in_a_hand_over("fault-old", |pid, before| before.contains(&pid));
}

#[test]
fn a_new_process_that_dies_at_any_step_of_a_hand_over_leaves_a_working_pipeline() {
    survives_the_death_in_a_hand_over("fault-new", |pid, before| !before.contains(&pid));
}
