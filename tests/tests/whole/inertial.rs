//! An inertial sensor beside the picture: simulated, recorded, and an autopilot's.

use std::net::UdpSocket;

use flockeye_contract::{FrameStamp, Rotation, RotationSource};
use flockeye_convert::{camera_turn, rotation};
use flockeye_tests::autopilot::{SimulatedAutopilot, YAW_DEG_S};
use flockeye_tests::onlooker::Tape;
use flockeye_tests::{Flight, SMALL_FLIGHT, Scratch, run, small_flight, succeeds};
use rustix::process::Signal;
use serde_json::Value;

const FRAMES: u64 = 75;

/// An observer that leans by up to 12 degrees and yaws unevenly.
const GUSTS: &[&str] = &[
    "camera.width=1280",
    "camera.height=640",
    "simulator.distance_m=[0.9, 1.2]",
    "simulator.frames=75",
    "simulator.exposure_ms=12",
    "simulator.tilt_deg=12",
    "simulator.yaw_swing_deg_s=40",
    "inertial.source=sim",
];

fn set<'a>(more: &[&'a str]) -> Vec<&'a str> {
    SMALL_FLIGHT.iter().chain(GUSTS).chain(more).copied().collect()
}

fn sources(tape: &Tape) -> Vec<u32> {
    tape.rotations.iter().map(|rotation| rotation.source).collect()
}

#[test]
fn a_sensor_that_agrees_makes_the_rotation_better() {
    let tape = Tape::record("inertial", &["--profile", "repeat"], &set(&[]));
    tape.assert_every_frame_ended_once(FRAMES);
    assert_eq!(tape.output.matches("the inertial sensor agrees").count(), 1, "{}", tape.output);
    let both = RotationSource::PictureAndInertial.code();
    let of_both = sources(&tape).iter().filter(|source| **source == both).count();
    assert!(of_both > 30, "{:?}", sources(&tape));
    let truth = |sequence: u64| {
        let of_frame = tape.truths.iter().find(|truth| truth.stamp.sequence == sequence);
        rotation(of_frame.expect("each frame has its truth").world_from_camera)
    };
    let (mut errors_deg, mut ahead_deg, mut normalised) = (Vec::new(), Vec::new(), 0.0);
    for message in tape.rotations.iter().filter(|message| message.source == both) {
        let turn = camera_turn(message).expect("it is known");
        let sequence = message.stamp.sequence;
        let expected = truth(sequence).inverse() * truth(sequence - 1);
        let off = (turn.later_from_earlier * expected.inverse()).scaled_axis();
        errors_deg.push(off.norm().to_degrees());
        let information = turn.covariance.try_inverse().expect("it is positive");
        normalised += off.dot(&(information * off)) / of_both as f64;
        // Samples are 5 ms apart, so some exposures end before the next one.
        let Some(ahead) = turn.ahead else { continue };
        assert!((0.0..0.02).contains(&(ahead.until_s - turn.later_s)), "{ahead:?}");
        ahead_deg.push(ahead.ahead_from_later.angle().to_degrees());
    }
    errors_deg.sort_by(f64::total_cmp);
    // The picture alone has more than that.
    assert!(errors_deg[of_both / 2] < 0.03, "{errors_deg:?}");
    assert!((0.3..8.0).contains(&normalised), "NEES {normalised}, 3 is right: {errors_deg:?}");
    assert!(ahead_deg.len() > of_both / 4, "{} of {of_both}", ahead_deg.len());
    assert!(ahead_deg.iter().any(|degrees| *degrees > 0.01), "{ahead_deg:?}");
}

/// The messages of egomotion without the times of publication, which differ from run to run.
fn timeless(tape: &Tape) -> Vec<Rotation> {
    let timeless = |rotation: &Rotation| Rotation {
        stamp: FrameStamp { published_ns: 0, ..rotation.stamp },
        ..*rotation
    };
    tape.rotations.iter().map(timeless).collect()
}

#[test]
fn a_lossless_flight_with_a_sensor_repeats() {
    let fly = || timeless(&Tape::record("repeats", &["--profile", "repeat"], &set(&[])));
    let (first, second) = (fly(), fly());
    assert_eq!(first.len() as u64, FRAMES);
    for (first, second) in first.iter().zip(&second) {
        assert_eq!(bytemuck::bytes_of(first), bytemuck::bytes_of(second), "{:?}", first.stamp);
    }
}

#[test]
fn a_sensor_that_hangs_upside_down_is_said_once_and_left_out() {
    let upside_down = "simulator.inertial.camera_from_sensor=[1, 0, 0, 0]";
    let tape = Tape::record("upside-down", &["--profile", "repeat"], &set(&[upside_down]));
    tape.assert_every_frame_ended_once(FRAMES);
    assert_eq!(tape.output.matches("the inertial sensor disagrees").count(), 1, "{}", tape.output);
    assert!(!tape.output.contains("agrees with the picture;"), "{}", tape.output);
    let [nothing, picture] = [RotationSource::Nothing, RotationSource::Picture].map(|s| s.code());
    assert_eq!(sources(&tape)[0], nothing);
    assert!(sources(&tape)[1..].iter().all(|source| *source == picture), "{:?}", sources(&tape));
}

#[test]
fn mounting_and_clock_are_calibrated_from_a_flight() {
    // Turned by 90 degrees about z, and 120 ms late.
    let mounted = "simulator.inertial.camera_from_sensor=[0, 0, 0.70710678, 0.70710678]";
    let set = set(&[mounted, "simulator.inertial.time_offset_ms=-120", "simulator.frames=90"]);
    let set: Vec<&str> = set.iter().flat_map(|assignment| ["--set", assignment]).collect();
    let output = succeeds(&[&["calibrate", "imu", "--json"], &set[..]].concat());
    let found: Value = serde_json::from_str(&output).expect("nothing but JSON");
    let number = |value: &Value| value.as_f64().unwrap_or_else(|| panic!("{value} in {found}"));
    assert!((number(&found["time_offset_ms"]) + 120.0).abs() < 4.0, "{found}");
    let mounting: Vec<f64> =
        found["camera_from_sensor"].as_array().expect("four numbers").iter().map(number).collect();
    let off = rotation([0.0, 0.0, 0.5f64.sqrt(), 0.5f64.sqrt()]).angle_to(&rotation([
        mounting[0],
        mounting[1],
        mounting[2],
        mounting[3],
    ]));
    assert!(off.to_degrees() < 1.0, "{found}");

    // With a sensor whose clock is right the offset is the latency of the camera's frames.
    let late = [&set[..], &["--set", "simulator.inertial.time_offset_ms=180"]].concat();
    let output = succeeds(&[&["calibrate", "latency", "--json"], &late[..]].concat());
    let found: Value = serde_json::from_str(&output).expect("nothing but JSON");
    assert!((number(&found["latency_ms"]) - 180.0).abs() < 4.0, "{found}");
    assert!(number(&found["error_turning_mm"]) > 0.0, "{found}");

    let (succeeded, output) = run(&["calibrate", "imu", "--set", "simulator.frames=9"]);
    assert!(!succeeded && output.contains("there is no inertial sensor"), "{output}");
}

#[test]
fn samples_that_were_recorded_can_be_read_again() {
    let scratch = Scratch::new("imu");
    let file = scratch.path("imu.csv");
    let path = file.to_str().expect("a plain path");
    let set = set(&["simulator.frames=6"]);
    let mut flight = Flight::start("imu", &["--profile", "repeat", "--imu", path], &set);
    flight.assert_ends_well();
    let rows: Vec<flockeye_tables::ImuRow> = flockeye_tables::read(&file).expect("they are read");
    assert!(rows.len() > 100, "{}", rows.len());
    assert!(rows.windows(2).all(|pair| ((pair[1].t_s - pair[0].t_s) * 200.0 - 1.0).abs() < 1e-3));
    assert!((rows[0].t_s + 0.5).abs() < 1e-6, "{:?}", rows[0]);
    // A recorded sensor belongs to a recording.
    let source = format!("inertial.source={path}");
    let (succeeded, output) = run(&["check", "--set", &source]);
    assert!(!succeeded && output.contains("inertial.source: a recorded sensor"), "{output}");
}

#[test]
fn an_autopilot_is_heard_judged_and_missed() {
    let address =
        UdpSocket::bind("127.0.0.1:0").expect("a port").local_addr().expect("its address");
    let source = format!("inertial.source=mavlink:udp:{address}");
    let yaw = format!("simulator.yaw_deg_s={YAW_DEG_S}");
    let set = small_flight(&[source.as_str(), yaw.as_str()]);
    let mut flight = Flight::start("autopilot", &[], &set);
    flight.wait_for("no samples come. Cure: check the autopilot's stream rates");
    let autopilot = SimulatedAutopilot::start(address.to_string());
    flight.wait_for("samples come in HIGHRES_IMU");
    flight.wait_for("the inertial sensor agrees with the picture");
    // Its rates become ten times as large.
    autopilot.set_percent(1000);
    flight.wait_for("the inertial sensor disagrees with the picture");
    drop(autopilot);
    flight.wait_for("samples have stopped");
    flight.end_by(Signal::INT);
}
