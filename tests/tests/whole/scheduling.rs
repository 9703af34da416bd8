//! Processors and scheduling classes of stages.

use std::path::{Path, PathBuf};

use flockeye_tests::{Flight, small_flight};
use rustix::process::{Pid, Signal};

/// A field of the stat file of a process or thread (proc(5)), counted from 1.
fn field(stat: &Path, number: usize) -> String {
    let text = std::fs::read_to_string(stat).expect("it runs");
    // The second, the program's name, may hold blanks.
    let (_, from_third) = text.rsplit_once(") ").expect("its name is in parentheses");
    from_third.split_whitespace().nth(number - 3).expect("there are 52").to_owned()
}

fn stat(pid: Pid) -> PathBuf {
    PathBuf::from(format!("/proc/{}/stat", pid.as_raw_nonzero()))
}

/// The stat file of a process's thread of this name, if there is one.
fn thread(pid: Pid, name: &str) -> Option<PathBuf> {
    let threads = std::fs::read_dir(format!("/proc/{}/task", pid.as_raw_nonzero()));
    let named = |path: &PathBuf| {
        std::fs::read_to_string(path.join("comm")).is_ok_and(|comm| comm.trim() == name)
    };
    let threads = threads.expect("it runs").filter_map(|thread| Some(thread.ok()?.path()));
    Some(threads.into_iter().find(named)?.join("stat"))
}

fn nice(pid: Pid) -> String {
    field(&stat(pid), 19)
}

fn priority(pid: Pid) -> String {
    field(&stat(pid), 40)
}

fn class(pid: Pid) -> String {
    field(&stat(pid), 41)
}

fn processors(pid: Pid) -> String {
    let text =
        std::fs::read_to_string(format!("/proc/{}/status", pid.as_raw_nonzero())).expect("it runs");
    let line = text.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:"));
    line.expect("the kernel says it").trim().to_owned()
}

#[test]
fn stages_run_where_and_when_they_are_told_to() {
    let own = Pid::from_raw(std::process::id().cast_signed()).expect("a process has a number");
    let allowed = processors(own);
    let first = allowed.split([',', '-']).next().expect("some processor runs this");
    let placed = format!("stages.fusion.cpus=[{first}]");
    let more = [
        "stages.detection.replicas=1",
        &placed,
        "stages.fusion.scheduling=batch",
        "stages.rectification.nice=3",
    ];
    let set = small_flight(&more);
    let mut flight = Flight::with_poses("scheduled", &[], &set);
    let of = |stage: &str| flight.stages(&format!("flockeye-{stage}"))[0];
    assert_eq!(processors(of("fusion")), first);
    assert_eq!(class(of("fusion")), "3", "SCHED_BATCH");
    assert_eq!(class(of("detection")), "0", "SCHED_OTHER");
    assert_eq!(nice(of("simulator")), nice(own));
    // Niceness cannot be lowered if the tests themselves are nice.
    if nice(own) == "0" {
        assert_eq!(nice(of("rectification")), "3");
        assert_eq!(nice(of("detection")), "5");
    }
    flight.end_by(Signal::INT);
}

#[test]
fn real_time_classes_are_had_with_the_privilege_and_refused_aloud_without() {
    let more = [
        "stages.detection.replicas=1",
        "stages.fusion.scheduling=fifo",
        "stages.fusion.priority=3",
        "stages.rectification.scheduling=round_robin",
    ];
    let set = small_flight(&more);
    let mut flight = Flight::with_poses("real-time", &[], &set);
    let of = |stage: &str| flight.stages(&format!("flockeye-{stage}"))[0];
    let refused = "scheduling policy fifo is refused";
    if flight.output().contains(refused) {
        assert_eq!([class(of("fusion")), class(of("rectification"))], ["0", "0"], "SCHED_OTHER");
    } else {
        assert_eq!((&*class(of("fusion")), &*priority(of("fusion"))), ("1", "3"), "SCHED_FIFO");
        assert_eq!(class(of("rectification")), "2", "SCHED_RR");
        assert_eq!(class(of("detection")), "0", "SCHED_OTHER");
    }
    // The background pass is in no real-time class, and gives way to all other threads.
    let aside = thread(of("fusion"), "background-pass").expect("it looks again in flight");
    assert_eq!(field(&aside, 41), "0", "SCHED_OTHER");
    let own = Pid::from_raw(std::process::id().cast_signed()).expect("a process has a number");
    let usual: i32 = nice(own).parse().expect("a number");
    assert_eq!(field(&aside, 19), (usual.max(0) + 10).min(19).to_string());
    flight.end_by(Signal::INT);
}

#[test]
fn a_lossless_run_leaves_nothing_to_a_thread_of_its_own() {
    let more = ["stages.detection.replicas=1", "profile=repeat"];
    let set = small_flight(&more);
    let mut flight = Flight::with_poses("no-aside", &[], &set);
    assert_eq!(thread(flight.stages("flockeye-fusion")[0], "background-pass"), None);
    flight.end_by(Signal::INT);
}

#[test]
fn what_the_system_refuses_is_said_and_costs_nothing_else() {
    let more = ["stages.detection.replicas=1", "stages.fusion.cpus=[9999]"];
    let set = small_flight(&more);
    let mut flight = Flight::start("refused", &[], &set);
    flight.wait_for("processors [9999] are refused");
    flight.wait_for("alpha confirmed");
    flight.end_by(Signal::INT);
}
