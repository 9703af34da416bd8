//! Another's program reads what is sent, and what it sends is understood: `pymavlink`, in Python.
#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

use common::neighbour;
use flockeye_autopilot::AutopilotLine;
use flockeye_config::Autopilot;
use flockeye_require::loopback::watched;
use flockeye_require::python::{Running, python};
use flockeye_runtime::clock;
use serde_json::Value;

/// When the autopilot's clock began, CLOCK_MONOTONIC, nanoseconds: long before this machine's, as
/// if by a clock that is wrong.
const STARTED_NS: i64 = -3_456_789_012_345;
const SYSTEM: u8 = 7;

fn numbers(value: &Value) -> Vec<f64> {
    match value.as_array() {
        Some(values) => values.iter().map(|value| value.as_f64().unwrap()).collect(),
        None => vec![value.as_f64().unwrap()],
    }
}

fn assert_close(found: &Value, wanted: &[f64]) {
    let found = numbers(found);
    assert_eq!(found.len(), wanted.len());
    for (found_part, wanted_part) in found.iter().zip(wanted) {
        assert!((found_part - wanted_part).abs() < 1e-5, "{found:?} is not {wanted:?}");
    }
}

#[test]
fn pymavlink_reads_the_messages_and_its_own_are_understood() {
    let Some(python) = python("pymavlink") else { return };
    watched(move || {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/foreign/autopilot.py");
        let mut child = Command::new(python);
        child.arg(script).args([SYSTEM.to_string(), STARTED_NS.to_string()]).stdout(Stdio::piped());
        let mut child = Running(child.spawn().unwrap());
        let mut lines = BufReader::new(child.0.stdout.take().unwrap()).lines();
        let mut next =
            move || -> Value { serde_json::from_str(&lines.next().unwrap().unwrap()).unwrap() };
        let port = next()["port"].as_u64().unwrap();
        let autopilot = AutopilotLine::open(&Autopilot {
            link: format!("udpout:127.0.0.1:{port}"),
            system_id: SYSTEM,
            target: Some("kite".into()),
            obstacle_range_m: [0.5, 40.0],
            ..Autopilot::default()
        })
        .unwrap();
        let began_utc_us = common::utc_us();
        let (told, heard) = std::thread::scope(|scope| {
            let reading = scope.spawn(next);
            while !reading.is_finished() {
                // What was exposed a while ago, so that the attitude then is known.
                let exposure_ns = clock::monotonic_ns() - 50_000_000;
                autopilot.neighbour(&neighbour("kite", exposure_ns)).unwrap();
                autopilot.neighbour(&neighbour("swift", exposure_ns)).unwrap();
                std::thread::sleep(Duration::from_millis(10));
            }
            let odometry = autopilot.take_odometry().map(|state| state.odometry);
            ((autopilot.status(), odometry), reading.join().unwrap())
        });
        let (status, odometry) = told;
        assert!(status.is_open && status.is_heard && status.sent > 0 && status.received > 0);
        // Its clock is found, and its odometry is understood.
        let offset = status.time_offset.unwrap();
        let error_ns = offset.autopilot_less_monotonic_ns + STARTED_NS;
        assert!(error_ns.abs() <= offset.bound_ns && offset.bound_ns < 100_000_000, "{offset:?}");
        let odometry = odometry.unwrap();
        assert!(
            (odometry.odom_from_base.translation.vector - nalgebra::Vector3::new(1.0, 3.0, 2.0))
                .norm()
                < 1e-5
        );
        assert!(odometry.odom_from_base.rotation.angle() < 1e-3, "the nose to the east");
        assert!(
            (odometry.linear_velocity_m_s - nalgebra::Vector3::new(5.0, 0.0, 0.0)).norm() < 1e-5
        );

        let of_kind = |kind: &str| heard["heard"][kind].as_array().unwrap().clone();
        for kind in ["HEARTBEAT", "TARGET_RELATIVE", "OBSTACLE_DISTANCE_3D", "TIMESYNC"] {
            for message in of_kind(kind) {
                assert_close(&message["sender"], &[f64::from(SYSTEM), 191.0]);
                assert_eq!(message["version"], 0xfd, "MAVLink 2");
            }
        }
        let heartbeat = &of_kind("HEARTBEAT")[0];
        // MAV_TYPE_ONBOARD_CONTROLLER, MAV_AUTOPILOT_INVALID.
        assert_eq!((&heartbeat["type"], &heartbeat["autopilot"]), (&18.into(), &8.into()));
        let targets = of_kind("TARGET_RELATIVE");
        let target = targets.last().unwrap();
        for (field, wanted) in [("x", 2.0), ("y", -1.0), ("z", -0.5), ("yaw_std", 0.5)] {
            assert_close(&target[field], &[wanted]);
        }
        assert_close(&target["pos_std"], &[0.2, 0.3, 0.4]);
        assert_close(&target["q_target"], &[0.25f64.cos(), 0.0, 0.0, -0.25f64.sin()]);
        assert_close(&target["q_sensor"], &[0.5f64.sqrt(), 0.0, 0.0, 0.5f64.sqrt()]);
        // TARGET_OBS_FRAME_BODY_FRD, LANDING_TARGET_TYPE_VISION_FIDUCIAL.
        assert_eq!((&target["frame"], &target["type"]), (&1.into(), &2.into()));
        let age_us = common::utc_us() - target["timestamp"].as_i64().unwrap();
        assert!((0..common::utc_us() - began_utc_us + 1_000_000).contains(&age_us), "{age_us}");
        let obstacles = of_kind("OBSTACLE_DISTANCE_3D");
        let [one, other] = &obstacles[obstacles.len() - 2..] else { panic!("{obstacles:?}") };
        let mut ids = [one, other].map(|obstacle| obstacle["obstacle_id"].as_i64().unwrap());
        ids.sort_unstable();
        assert!(ids == [0, 1] || obstacles.len() % 2 == 1, "{ids:?}");
        for (field, wanted) in
            [("x", 2.0), ("y", -1.0), ("z", -0.5), ("min_distance", 0.5), ("max_distance", 40.0)]
        {
            assert_close(&other[field], &[wanted]);
        }
        // MAV_FRAME_BODY_FRD.
        assert_eq!(other["frame"], 12);
        let age_ms = heard["now_ms"].as_i64().unwrap() - other["time_boot_ms"].as_i64().unwrap();
        assert!((0..5000).contains(&age_ms), "{age_ms} ms by the autopilot's own clock");
        let answers: Vec<Value> =
            of_kind("TIMESYNC").into_iter().filter(|time| time["tc1"] != 0).collect();
        assert!(!answers.is_empty() && answers.iter().all(|answer| answer["ts1"] == 4242));
    });
}
