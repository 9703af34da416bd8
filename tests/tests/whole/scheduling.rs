//! Where and when stages run.

use flockeye_tests::{Flight, SMALL_FLIGHT};
use rustix::process::{Pid, Signal};

/// The fields of /proc/PID/stat behind the program's name, from the third on.
fn stat(pid: Pid) -> Vec<String> {
    let text =
        std::fs::read_to_string(format!("/proc/{}/stat", pid.as_raw_nonzero())).expect("it runs");
    let (_, fields) = text.rsplit_once(") ").expect("its name is in parentheses");
    fields.split_whitespace().map(str::to_owned).collect()
}

fn nice(pid: Pid) -> String {
    stat(pid)[19 - 3].clone()
}

fn priority(pid: Pid) -> String {
    stat(pid)[40 - 3].clone()
}

fn class(pid: Pid) -> String {
    stat(pid)[41 - 3].clone()
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
    let set: Vec<&str> = SMALL_FLIGHT.iter().chain(&more).copied().collect();
    let mut flight = Flight::start("scheduled", &[], &set);
    flight.wait_for("alpha confirmed");
    let of = |stage: &str| flight.stages(&format!("flockeye-{stage}"))[0];
    assert_eq!(processors(of("fusion")), first);
    assert_eq!(class(of("fusion")), "3", "SCHED_BATCH");
    assert_eq!(class(of("detection")), "0", "SCHED_OTHER");
    assert_eq!(nice(of("simulator")), nice(own));
    // Where the tests themselves give way, less is not to be had.
    if nice(own) == "0" {
        assert_eq!(nice(of("rectification")), "3");
        assert_eq!(nice(of("detection")), "5");
    }
    flight.signal(Signal::INT);
    assert!(flight.wait().success(), "{}", flight.output());
    flight.assert_nothing_left();
}

#[test]
fn real_time_classes_are_had_with_the_privilege_and_refused_aloud_without() {
    let more = [
        "stages.detection.replicas=1",
        "stages.fusion.scheduling=fifo",
        "stages.fusion.priority=3",
        "stages.rectification.scheduling=round_robin",
    ];
    let set: Vec<&str> = SMALL_FLIGHT.iter().chain(&more).copied().collect();
    let mut flight = Flight::start("real-time", &[], &set);
    flight.wait_for("alpha confirmed");
    let of = |stage: &str| flight.stages(&format!("flockeye-{stage}"))[0];
    let refused = "scheduling class fifo is not to be had";
    if flight.output().contains(refused) {
        assert_eq!([class(of("fusion")), class(of("rectification"))], ["0", "0"], "SCHED_OTHER");
    } else {
        assert_eq!((&*class(of("fusion")), &*priority(of("fusion"))), ("1", "3"), "SCHED_FIFO");
        assert_eq!(class(of("rectification")), "2", "SCHED_RR");
        assert_eq!(class(of("detection")), "0", "SCHED_OTHER");
    }
    flight.signal(Signal::INT);
    assert!(flight.wait().success(), "{}", flight.output());
    flight.assert_nothing_left();
}

#[test]
fn what_the_system_refuses_is_said_and_costs_nothing_else() {
    let more = ["stages.detection.replicas=1", "stages.fusion.cpus=[9999]"];
    let set: Vec<&str> = SMALL_FLIGHT.iter().chain(&more).copied().collect();
    let mut flight = Flight::start("refused", &[], &set);
    flight.wait_for("processors [9999] are not to be had");
    flight.wait_for("alpha confirmed");
    flight.signal(Signal::INT);
    assert!(flight.wait().success(), "{}", flight.output());
    flight.assert_nothing_left();
}
