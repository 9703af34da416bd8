//! Pipelines that fly on when their launcher dies.

mod hand_over_faults;

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use flockeye_contract::Tracks;
use flockeye_runtime::clock;
use flockeye_tests::onlooker::{join, subscribe};
use flockeye_tests::{Flight, POSES_FLOW, SMALL_FLIGHT, WATCHDOG, ask, flockeye, run, unique};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;

fn kept_flight(instance: &str) -> Flight {
    let mut flight = Flight::start_as(instance, &["--keep"], SMALL_FLIGHT);
    flight.wait_for(POSES_FLOW);
    flight
}

/// The process of each worker that has one.
fn workers(instance: &str) -> BTreeMap<String, i32> {
    let (succeeded, output) = ask(instance, &["status", "--json"]);
    assert!(succeeded, "{output}");
    let status: Value = serde_json::from_str(&output).expect("nothing but JSON");
    let list = status["workers"].as_array().expect("a list");
    let pid = |worker: &Value| Some(i32::try_from(worker["pid"].as_i64()?).expect("a number"));
    list.iter()
        .filter_map(|worker| Some((worker["worker"].as_str()?.to_owned(), pid(worker)?)))
        .collect()
}

/// Waits for a measured pose in a frame that is exposed from now on.
fn wait_for_a_pose(flight: &mut Flight) {
    let mut ports = join(flight);
    let mut tracks = subscribe::<Tracks>(flight, &mut ports);
    let (since_ns, start) = (clock::monotonic_ns(), Instant::now());
    ports
        .attend(|| {
            while let Some(message) = tracks.receive()? {
                let is_new = message.header.stamp.exposure_ns > since_ns;
                if is_new && message.items().iter().any(|track| track.measured_by != 0) {
                    return Ok(None);
                }
            }
            assert!(start.elapsed() < WATCHDOG, "no pose comes:\n{}", flight.output());
            Ok(Some(Duration::from_millis(50)))
        })
        .expect("messages can be waited for");
}

fn kill(pid: i32) {
    let pid = Pid::from_raw(pid).expect("a process");
    // An error is ignored: the process may have ended by itself.
    kill_process(pid, Signal::KILL).ok();
}

#[test]
fn stages_fly_on_without_their_launcher_and_the_next_one_takes_them_over() {
    let instance = unique("keep");
    let mut first = kept_flight(&instance);
    let (succeeded, output) = ask(&instance, &["stop", "detection.1"]);
    assert!(succeeded, "{output}");
    let before = workers(&instance);
    first.signal(Signal::KILL);
    first.wait();
    // Poses flow, tools can look on, and nobody takes the living for leftovers.
    wait_for_a_pose(&mut first);
    let refusals = [
        run(&["up", "--set", &format!("instance={instance}")]),
        ask(&instance, &["status"]),
        run(&["clean", "--instance", &instance]),
    ];
    for (_, output) in refusals {
        assert!(output.contains("fly on without a launcher"), "{output}");
    }
    let other = [SMALL_FLIGHT, &["fusion.covariance_scale=1.5"]].concat();
    let mut second = Flight::start_as(&instance, &["--keep"], &other);
    second.wait_for("what flies has other settings in fusion; they stay");
    second.wait_for("takes over fusion (process");
    wait_for_a_pose(&mut second);
    assert_eq!(workers(&instance), before, "{}", second.output());
    assert!(!second.output().contains("started again"), "{}", second.output());
    // The second launcher manages these stages like its own: lines, ends, restarts.
    kill(before["fusion"]);
    second.wait_for("fusion ended (an earlier launcher had started it");
    second.wait_for("fusion is started again");
    wait_for_a_pose(&mut second);
    for worker in ["detection", "simulator"] {
        let (succeeded, output) = ask(&instance, &["swap", worker, "--within", "60s"]);
        assert!(succeeded, "{output}\n{}", second.output());
    }
    second.stop();
}

#[test]
fn what_has_ended_without_a_launcher_is_started_again_by_the_next_one_and_the_stopped_stay_stopped()
{
    let instance = unique("keep-dead");
    let mut flight = kept_flight(&instance);
    let own = flockeye().with_file_name("flockeye-detection");
    let own = own.to_str().expect("a plain path");
    let program = ["swap", "detection", "--within", "60s", "--", "nice", own];
    let (succeeded, output) = ask(&instance, &program);
    assert!(succeeded, "{output}\n{}", flight.output());
    let (succeeded, output) = ask(&instance, &["stop", "egomotion"]);
    assert!(succeeded, "{output}");
    let before = workers(&instance);
    flight.signal(Signal::KILL);
    flight.wait();
    for worker in ["detection", "simulator", "fusion"] {
        kill(before[worker]);
    }
    let start = Instant::now();
    while flight.stages("").iter().any(|pid| pid.as_raw_nonzero().get() == before["fusion"]) {
        assert!(start.elapsed() < WATCHDOG, "it does not end");
        std::thread::sleep(Duration::from_millis(10));
    }
    let mut second = Flight::start_as(&instance, &["--keep"], SMALL_FLIGHT);
    second.wait_for("takes over ");
    assert!(!second.output().contains("other settings"), "{}", second.output());
    for worker in ["detection", "simulator", "fusion"] {
        second.wait_for(&format!("{worker} is started again"));
    }
    wait_for_a_pose(&mut second);
    let (_, output) = ask(&instance, &["status", "--json"]);
    let status: Value = serde_json::from_str(&output).expect("nothing but JSON");
    let of = |worker: &str| {
        let all = status["workers"].as_array().expect("a list");
        all.iter().find(|found| found["worker"] == worker).expect("it is one").clone()
    };
    assert_eq!(of("egomotion")["state"], "stopped", "{output}");
    assert_eq!(of("detection")["command"][0], "nice", "{output}");
    assert_eq!(of("detection")["generation"], 2, "{output}");
    assert_eq!(of("simulator")["generation"], 1, "{output}");
    second.stop();
}

#[test]
fn stages_without_a_launcher_can_be_ended() {
    let instance = unique("keep-stop");
    let mut flight = kept_flight(&instance);
    flight.signal(Signal::KILL);
    flight.wait();
    assert!(!flight.stages("").is_empty(), "they fly on");
    let (succeeded, output) = ask(&instance, &["stop"]);
    assert!(succeeded && output.contains("stages without a launcher have ended"), "{output}");
    assert!(flight.stages("").is_empty(), "none is left");
    flight.assert_nothing_left();
}

#[test]
fn a_lossless_run_is_not_kept() {
    let (succeeded, output) = run(&["up", "--keep", "--profile", "repeat"]);
    assert!(!succeeded && output.contains("waits for its launcher"), "{output}");
}
