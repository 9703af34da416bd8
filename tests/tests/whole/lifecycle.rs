//! How a pipeline begins, goes on when parts of it die, and ends: over real processes.

use std::net::TcpListener;
use std::process::Command;
use std::time::{Duration, Instant};

use flockeye_contract::wire::FRAME_SCHEMA;
use flockeye_contract::{Health, Healths, MeasuredBy, Track, TrackHeader, Tracks};
use flockeye_runtime::clock;
use flockeye_runtime::onlooker;
use flockeye_runtime::ports::{Ports, Subscriber};
use flockeye_tables::{PoseRow, TruthRow, read};
use flockeye_tests::{Flight, POSES_FLOW, SMALL_FLIGHT, Scratch, WATCHDOG, flockeye, run, unique};
use rustix::process::{Pid, Signal, kill_process};

use crate::foreign::assert_is_true;

/// The small flight with one process of each stage, and some settings of a test's own.
fn small<'a>(more: &[&'a str]) -> Vec<&'a str> {
    SMALL_FLIGHT.iter().chain(&["stages.detection.replicas=1"]).chain(more).copied().collect()
}

/// The only process of a stage, once it is there.
fn process_of(flight: &Flight, program: &str) -> Pid {
    let start = Instant::now();
    loop {
        if let [pid] = flight.stages(program)[..] {
            return pid;
        }
        assert!(start.elapsed() < WATCHDOG, "{program} does not run:\n{}", flight.output());
        std::thread::sleep(Duration::from_millis(20));
    }
}

fn wait_until_no_stage_runs(flight: &Flight) {
    let start = Instant::now();
    while !flight.stages("").is_empty() {
        assert!(start.elapsed() < WATCHDOG, "stages outlive the launcher: {:?}", flight.stages(""));
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// Somebody who reads the pipeline's own messages: a viewer, say.
struct Onlooker {
    // Ports go before what they are made of.
    tracks: Subscriber<Tracks>,
    healths: Subscriber<Healths>,
    ports: Ports,
}

impl Onlooker {
    fn of(flight: &Flight) -> Self {
        let (mut ports, _) = onlooker::join(&flight.instance).expect("the flight has begun");
        Self {
            tracks: ports.subscriber().expect("there is room for an onlooker"),
            healths: ports.subscriber().expect("there is room for an onlooker"),
            ports,
        }
    }

    /// Waits for a stage's report that is as wanted.
    fn wait_for_health(&mut self, flight: &Flight, is_wanted: impl Fn(&Health) -> bool) {
        self.wait(flight, |readers| {
            while let Some(message) = readers.healths.receive().expect("health can be read") {
                if is_wanted(&message.header) {
                    return true;
                }
            }
            false
        });
    }

    /// Waits for a track that is as wanted.
    fn wait_for_track(
        &mut self,
        flight: &Flight,
        mut is_wanted: impl FnMut(&TrackHeader, &Track) -> bool,
    ) {
        self.wait(flight, |readers| {
            while let Some(message) = readers.tracks.receive().expect("tracks can be read") {
                if message.items().iter().any(|track| is_wanted(&message.header, track)) {
                    return true;
                }
            }
            false
        });
    }

    fn wait(&mut self, flight: &Flight, mut has_come: impl FnMut(&mut Readers<'_>) -> bool) {
        let start = Instant::now();
        let Self { tracks, healths, ports } = self;
        let mut readers = Readers { tracks, healths };
        ports
            .attend(|| {
                assert!(start.elapsed() < WATCHDOG, "waited in vain:\n{}", flight.output());
                Ok((!has_come(&mut readers)).then_some(Duration::from_millis(100)))
            })
            .expect("messages can be waited for");
    }
}

struct Readers<'a> {
    tracks: &'a mut Subscriber<Tracks>,
    healths: &'a mut Subscriber<Healths>,
}

#[test]
fn poses_flow_and_nothing_is_left_afterwards() {
    let scratch = Scratch::new("flow");
    let (poses, truth) = (scratch.path("poses.csv"), scratch.path("truth.csv"));
    let files = [poses.to_str().expect("plain"), truth.to_str().expect("plain")];
    let mut flight = Flight::start(
        "flow",
        &["--for", "4s", "--poses", files[0], "--truth", files[1]],
        &small(&[]),
    );
    assert!(flight.wait().success(), "{}", flight.output());
    assert!(flight.output().contains("frames searched"), "{}", flight.output());
    let poses: Vec<PoseRow> = read(&poses).expect("poses were recorded");
    let truths: Vec<TruthRow> = read(&truth).expect("the truth was recorded");
    let measured: Vec<_> = poses.iter().filter(|row| row.is_measured()).collect();
    assert!(!measured.is_empty(), "no pose in:\n{}", flight.output());
    measured.into_iter().for_each(|row| assert_is_true(row, &truths));
    assert!(flight.stages("").is_empty());
    flight.assert_nothing_left();
}

#[test]
fn ctrl_c_stops_everything_at_once() {
    let scratch = Scratch::new("ctrlc");
    let poses = scratch.path("poses.csv");
    let arguments = ["--poses", poses.to_str().expect("plain")];
    let mut flight = Flight::with_poses("ctrlc", &arguments, &small(&[]));
    let asked = Instant::now();
    flight.signal(Signal::INT);
    let status = flight.wait();
    let took = asked.elapsed();
    println!("stopped after {took:.2?}");
    assert!(status.success(), "{status}:\n{}", flight.output());
    // Two seconds are promised; a loaded machine gets more.
    assert!(took < Duration::from_secs(5), "it took {took:?}:\n{}", flight.output());
    let rows: Vec<PoseRow> = read(&poses).expect("what was recorded is there");
    assert!(!rows.is_empty());
    assert!(flight.stages("").is_empty());
    flight.assert_nothing_left();
}

#[test]
fn a_killed_launcher_leaves_no_orphan_and_clean_removes_the_rest() {
    let mut flight = Flight::with_poses("killed", &[], &small(&[]));
    assert!(!flight.stages("").is_empty());
    flight.signal(Signal::KILL);
    flight.wait();
    wait_until_no_stage_runs(&flight);
    assert!(!flight.instance.shared_memory().is_empty(), "there is nothing for clean to do");
    let (succeeded, output) = run(&["clean", "--instance", flight.instance.name()]);
    assert!(succeeded && output.contains("removed"), "{output}");
    flight.assert_nothing_left();
}

#[test]
fn a_killed_launchers_name_can_be_used_again() {
    let name = unique("again");
    let mut first = Flight::start_as(&name, &[], &small(&[]));
    first.wait_for(POSES_FLOW);
    first.signal(Signal::KILL);
    first.wait();
    wait_until_no_stage_runs(&first);
    let mut second = Flight::start_as(&name, &[], &small(&[]));
    second.wait_for(POSES_FLOW);
    second.end_by(Signal::TERM);
}

/// Kills a stage in flight, and waits for its successor and for poses of frames after it.
fn survives_the_death_of(stage: &str, name: &str) {
    let mut flight = Flight::with_poses(name, &[], &small(&[]));
    let program = format!("flockeye-{stage}");
    let first = process_of(&flight, &program);
    let mut onlooker = Onlooker::of(&flight);
    kill_process(first, Signal::KILL).expect("it can be killed");
    flight.wait_for(&format!("{stage} was killed by signal 9; it is started again in"));
    flight.wait_for(&format!("{stage} is started again"));
    onlooker.wait_for_health(&flight, |health| {
        health.stage.to_string() == stage && health.generation == 1
    });
    let replaced_ns = clock::monotonic_ns();
    assert_ne!(process_of(&flight, &program), first);
    onlooker.wait_for_track(&flight, |header, track| {
        header.stamp.published_ns > replaced_ns && track.measured_by != MeasuredBy::Nothing.code()
    });
    drop(onlooker);
    flight.end_by(Signal::INT);
}

#[test]
fn detection_that_is_killed_is_replaced_and_poses_flow_again() {
    survives_the_death_of("detection", "detect");
}

#[test]
fn a_second_worker_goes_on_while_the_first_one_stays_away() {
    let set = ["stages.detection.replicas=2", "stages.detection.backoff_s=[100, 100]"];
    let mut flight = Flight::with_poses("workers", &[], &small(&set));
    let mut onlooker = Onlooker::of(&flight);
    let workers = flight.stages("flockeye-detection");
    assert_eq!(workers.len(), 2);
    kill_process(workers[0], Signal::KILL).expect("it can be killed");
    flight.wait_for("was killed by signal 9; it is started again in 100.0 s");
    let killed_ns = clock::monotonic_ns();
    onlooker.wait_for_track(&flight, |header, track| {
        header.stamp.published_ns > killed_ns && track.measured_by != MeasuredBy::Nothing.code()
    });
    drop(onlooker);
    flight.end_by(Signal::INT);
}

#[test]
fn rectification_that_is_killed_is_replaced_and_poses_flow_again() {
    survives_the_death_of("rectification", "rectify");
}

#[test]
fn fusion_that_is_killed_is_replaced_and_poses_flow_again() {
    survives_the_death_of("fusion", "fusion");
}

#[test]
fn fusion_that_is_killed_goes_on_with_its_tracks() {
    // Tests beside this one take the processor at times: the track has to be known when fusion is
    // back.
    let mut flight = Flight::with_poses("succession", &[], &small(&["fusion.coast_s=30"]));
    let mut onlooker = Onlooker::of(&flight);
    let mut tracked = Vec::new();
    onlooker.wait_for_track(&flight, |_, track| {
        let is_old = track.age_ns > 500_000_000;
        tracked.extend(is_old.then_some(*track));
        is_old
    });
    kill_process(process_of(&flight, "flockeye-fusion"), Signal::KILL).expect("it can be killed");
    flight.wait_for("going on where the last process was");
    onlooker.wait_for_track(&flight, |header, track| {
        let is_successors = header.generation == 1;
        tracked.extend(is_successors.then_some(*track));
        is_successors
    });
    drop(onlooker);
    let [before, after] = tracked[..] else { panic!("{tracked:?}") };
    assert_eq!(after.track_id, before.track_id);
    assert!(after.age_ns > before.age_ns, "{} ns", after.age_ns);
    flight.end_by(Signal::INT);
}

#[test]
fn a_source_that_is_killed_is_replaced_and_poses_flow_again() {
    survives_the_death_of("simulator", "source");
}

#[test]
fn a_lossless_flight_comes_to_its_end_although_stages_die() {
    let mut flight =
        Flight::start("lossless", &["--profile", "repeat"], &small(&["simulator.frames=150"]));
    for stage in ["detection", "rectification", "fusion"] {
        flight.wait_for(POSES_FLOW);
        kill_process(process_of(&flight, &format!("flockeye-{stage}")), Signal::KILL)
            .expect("it can be killed");
        flight.wait_for(&format!("{stage} is started again"));
    }
    flight.assert_ends_well();
}

#[test]
fn a_second_pipeline_of_the_same_name_is_refused_and_told_who_has_it() {
    let name = unique("twice");
    let mut first = Flight::start_as(&name, &[], &small(&[]));
    first.wait_for(POSES_FLOW);
    let mut second = Flight::start_as(&name, &[], &small(&[]));
    let status = second.wait();
    assert_eq!(status.code(), Some(1), "{}", second.output());
    let pid = first.pid().as_raw_nonzero();
    let wanted = format!("a pipeline called '{name}' is running already (process {pid})");
    assert!(second.output().contains(&wanted), "{}", second.output());
    // The first one goes on as if nothing had been.
    let mut onlooker = Onlooker::of(&first);
    let refused_ns = clock::monotonic_ns();
    onlooker.wait_for_track(&first, |header, _| header.stamp.published_ns > refused_ns);
    drop(onlooker);
    first.end_by(Signal::INT);
}

#[test]
fn a_stage_whose_program_is_not_there_ends_the_start_with_its_name() {
    let missing = r#"stages.detection.command=["/nowhere/detector"]"#;
    for set in [small(&[missing]), small(&[missing, "stages.detection.restart=never"])] {
        let mut flight = Flight::start("missing", &[], &set);
        assert_eq!(flight.wait().code(), Some(1), "{}", flight.output());
        let output = flight.output();
        for part in ["cannot start /nowhere/detector: No such file", "detection cannot start"] {
            assert!(output.contains(part), "{part:?} is missing in:\n{output}");
        }
        flight.assert_nothing_left();
    }
}

#[test]
fn a_stage_that_fails_and_must_not_be_restarted_ends_the_flight_with_the_reason() {
    let set = small(&[
        r#"stages.detection.command=["sh","-c","echo no lens today; exit 7"]"#,
        "stages.detection.restart=never",
    ]);
    let mut flight = Flight::start("fails", &[], &set);
    assert_eq!(flight.wait().code(), Some(1), "{}", flight.output());
    let output = flight.output();
    let wanted = [
        "no lens today",
        "detection ended with status 7, and its restart policy does not start it again",
    ];
    for part in wanted {
        assert!(output.contains(part), "{part:?} is missing in:\n{output}");
    }
    flight.assert_nothing_left();
}

#[test]
fn a_stage_that_does_not_listen_is_ended_all_the_same() {
    let deaf = r#"stages.gateway.command=["sh","-c","trap '' TERM; echo deaf; while :; do sleep 0.1; done"]"#;
    let mut flight = Flight::start("deaf", &[], &small(&["gateway.enabled=true", deaf]));
    flight.wait_for("deaf");
    flight.signal(Signal::INT);
    assert!(flight.wait().success(), "{}", flight.output());
    let output = flight.output();
    assert!(output.contains("gateway does not stop and is killed"), "{output}");
    wait_until_no_stage_runs(&flight);
    flight.assert_nothing_left();
}

#[test]
fn a_foreign_stage_that_crashes_is_tried_again_and_again_while_the_rest_flies() {
    let set = small(&[
        "gateway.enabled=true",
        r#"stages.gateway.command=["sh","-c","echo broken; exit 7"]"#,
        "stages.gateway.backoff_s=[0.2, 0.8]",
    ]);
    let mut flight = Flight::start("crashes", &[], &set);
    for wait in ["0.2", "0.4", "0.8"] {
        flight.wait_for(&format!("gateway ended with status 7; it is started again in {wait} s"));
    }
    flight.wait_for(POSES_FLOW);
    flight.end_by(Signal::INT);
}

#[test]
fn two_instances_fly_side_by_side() {
    let mut flights =
        ["left", "right"].map(|name| Flight::start(name, &[], &small(&["simulator.yaw_deg_s=0"])));
    for flight in &mut flights {
        flight.wait_for(POSES_FLOW);
    }
    let [left, right] = &mut flights;
    left.end_by(Signal::INT);
    // The end of one is nothing to the other.
    let mut onlooker = Onlooker::of(right);
    let left_ended_ns = clock::monotonic_ns();
    onlooker.wait_for_track(right, |header, _| header.stamp.published_ns > left_ended_ns);
    drop(onlooker);
    right.end_by(Signal::INT);
}

#[test]
fn clean_leaves_a_running_pipeline_alone() {
    let mut flight = Flight::with_poses("clean", &[], &small(&[]));
    let (succeeded, output) = run(&["clean", "--instance", flight.instance.name()]);
    let wanted = format!(
        "{}: running (process {}), left alone",
        flight.instance.name(),
        flight.pid().as_raw_nonzero()
    );
    assert!(succeeded && output.contains(&wanted), "{output}");
    let mut onlooker = Onlooker::of(&flight);
    let cleaned_ns = clock::monotonic_ns();
    onlooker.wait_for_track(&flight, |header, _| header.stamp.published_ns > cleaned_ns);
    drop(onlooker);
    flight.end_by(Signal::INT);
}

#[test]
fn a_finite_flight_ends_by_itself() {
    for profile in ["flight", "repeat"] {
        let mut flight =
            Flight::start("finite", &["--profile", profile], &small(&["simulator.frames=20"]));
        assert!(flight.wait().success(), "{}", flight.output());
        let output = flight.output();
        match profile {
            "repeat" => assert!(output.contains("20 frames searched, 0 skipped"), "{output}"),
            _ => assert!(output.contains(" frames searched, "), "{output}"),
        }
        flight.assert_nothing_left();
    }
}

/// An endpoint on this machine that nobody has, and what keeps it from everybody else.
fn endpoint() -> (String, TcpListener) {
    let listener = TcpListener::bind("127.0.0.1:0").expect("a port is free");
    let address = listener.local_addr().expect("it is bound");
    (format!("tcp/{address}"), listener)
}

#[test]
fn peers_see_poses_over_the_network() {
    let (endpoint, port) = endpoint();
    let listen = format!("gateway.listen=[\"{endpoint}\"]");
    let swarm = format!("observer.swarm={}", unique("swarm"));
    drop(port);
    let mut flight =
        Flight::start("network", &[], &small(&["gateway.enabled=true", &listen, &swarm]));
    flight.wait_for(POSES_FLOW);
    let name = flight.instance.name().to_owned();
    let mut output = String::new();
    // Through the configuration, through the running pipeline, and from anywhere else.
    for way in [
        ["--set", &listen, "--set", &swarm],
        ["--instance", &name, "--for", "100s"],
        ["--connect", &endpoint, "--set", &swarm],
    ] {
        let mut command = Command::new(flockeye());
        command.args(["peers", "--json"]).args(way);
        let mut peers = Flight::launch(&unique("peers"), command);
        peers.wait_for(FRAME_SCHEMA);
        peers.signal(Signal::INT);
        assert!(peers.wait().success(), "{}", peers.output());
        output = peers.output();
    }
    let (succeeded, refusal) = run(&["peers", "--instance", "nobody"]);
    assert!(!succeeded && refusal.contains("no pipeline 'nobody' runs here"), "{refusal}");
    let line = output.lines().find(|line| line.contains(FRAME_SCHEMA)).expect("it was waited for");
    let heard: serde_json::Value = serde_json::from_str(line).expect("each line is an object");
    let report = &heard["report"];
    assert_eq!((&report["observer"], &report["target"]), (&"observer".into(), &"alpha".into()));
    let exposure_ns = heard["exposure_monotonic_ns"].as_i64().expect("a time");
    let arrived_ns = heard["arrived_monotonic_ns"].as_i64().expect("a time");
    assert!((0..10_000_000_000).contains(&(arrived_ns - exposure_ns)), "{heard}");
    flight.end_by(Signal::INT);
}

#[test]
fn a_gateway_without_its_port_holds_nobody_up() {
    let (endpoint, _taken) = endpoint();
    let listen = format!("gateway.listen=[\"{endpoint}\"]");
    let mut flight = Flight::start("taken", &[], &small(&["gateway.enabled=true", &listen]));
    flight.wait_for(&format!("nothing goes over the network yet: cannot listen on {endpoint}"));
    flight.wait_for(POSES_FLOW);
    flight.end_by(Signal::INT);
}
