//! Other people's programs read what is published: `rosbags`, which reads ROS messages, and
//! `zenoh-ros2-sdk`, which subscribes as ROS nodes do, both in Python and without ROS.

#![allow(clippy::unwrap_used, clippy::expect_used)]

mod common;

use std::{
    io::{BufRead, BufReader},
    path::Path,
    process::{Command, Stdio},
    sync::atomic::{AtomicBool, Ordering::SeqCst},
    thread,
    time::Duration,
};

use common::{free_port, neighbour, parameters, router, seen, watched};
use flockeye_require::python::{Running, python};
use flockeye_ros2::{Ros2Node, UNKNOWN_VARIANCE, messages::MessageType};
use serde_json::{Value, json};

fn script(python: &Path, name: &str, arguments: &[String]) -> Command {
    let mut command = Command::new(python);
    command
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/foreign").join(name))
        .args(arguments)
        .env("GIT_PYTHON_REFRESH", "quiet")
        .env_remove("ZENOH_SESSION_CONFIG_URI")
        .env_remove("ZENOH_CONFIG_OVERRIDE");
    command
}

const TYPES: [MessageType; 3] =
    [MessageType::PoseWithCovarianceStamped, MessageType::TfMessage, MessageType::Odometry];

#[test]
fn rosbags_knows_the_types_and_reads_the_golden_bytes() {
    let Some(python) = python("rosbags, zenoh_ros2_sdk") else { return };
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
    let arguments = TYPES.map(|message| message.ros_name().to_owned());
    let arguments = [vec![golden.to_string_lossy().into_owned()], arguments.to_vec()].concat();
    let output = script(&python, "decode.py", &arguments).output().unwrap();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{errors}");
    let read: Value = serde_json::from_slice(&output.stdout).unwrap();
    for message in TYPES {
        assert_eq!(read["hashes"][message.ros_name()], message.hash());
    }
    assert_pose(&read["messages"]["pose"]["pose"]);
    assert_eq!(read["messages"]["tf"]["transforms"][1]["child_frame_id"], "a_seen_by_wren");
    assert_eq!(read["messages"]["odometry"]["twist"]["twist"]["angular"]["y"], -0.5);
}

/// The pose and covariance of [`neighbour`] and [`seen`], and of the golden files.
fn assert_pose(pose: &Value) {
    assert_eq!(pose["pose"]["position"], json!({ "x": 1.0, "y": -2.0, "z": 0.5 }));
    assert_eq!(pose["pose"]["orientation"], json!({ "x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8 }));
    let covariance: Vec<_> = (0..36).map(|k| f64::from(k) / 1024.0).collect();
    assert_eq!(pose["covariance"], json!(covariance));
}

fn assert_header(header: &Value, frame: &str) {
    let stamp = json!({ "sec": 1_700_000_000, "nanosec": 123 });
    assert_eq!(*header, json!({ "stamp": stamp, "frame_id": frame }));
}

#[test]
fn a_subscriber_of_ros_hears_all_three_topics() {
    let Some(python) = python("rosbags, zenoh_ros2_sdk") else { return };
    watched(move || {
        let port = free_port();
        let _router = router(port);
        let node = Ros2Node::open(&parameters(port), "wren").unwrap();
        let topics = ["/wren/neighbours/kite_2/pose", "/tf", "/wren/seen_by/kite_2/odometry"];
        let wanted = topics
            .iter()
            .zip(TYPES)
            .map(|(topic, message)| format!("{topic}={}", message.ros_name()));
        let arguments: Vec<_> =
            [port.to_string(), "3".to_owned()].into_iter().chain(wanted).collect();
        let child =
            script(&python, "subscribe.py", &arguments).stdout(Stdio::piped()).spawn().unwrap();
        let mut running = Running(child);
        let lines = BufReader::new(running.0.stdout.take().unwrap()).lines();

        let heard_all = AtomicBool::new(false);
        let heard: Vec<Value> = thread::scope(|scope| {
            scope.spawn(|| {
                while !heard_all.load(SeqCst) {
                    node.publish_neighbour(&neighbour("kite-2")).unwrap();
                    node.publish_transforms(&[neighbour("kite-2")]).unwrap();
                    node.publish_odometry(&seen("kite-2")).unwrap();
                    // As often as a camera.
                    thread::sleep(Duration::from_millis(33));
                }
            });
            let heard = lines.map(|line| serde_json::from_str(&line.unwrap()).unwrap()).collect();
            heard_all.store(true, SeqCst);
            heard
        });
        assert!(running.0.wait().unwrap().success(), "{heard:?}");

        let of = |key: &str, value: &str| {
            heard.iter().find(|line| line[key] == value).unwrap_or_else(|| panic!("{heard:?}"))
        };
        let pose = &of("topic", topics[0])["message"];
        assert_header(&pose["header"], "wren/base_link");
        assert_pose(&pose["pose"]);

        let transform = &of("topic", topics[1])["message"]["transforms"][0];
        assert_header(&transform["header"], "wren/base_link");
        assert_eq!(transform["child_frame_id"], "kite_2_seen_by_wren");
        let translation = &transform["transform"]["translation"];
        assert_eq!(*translation, json!({ "x": 1.0, "y": -2.0, "z": 0.5 }));

        let odometry = &of("topic", topics[2])["message"];
        assert_header(&odometry["header"], "kite_2/base_link");
        assert_eq!(odometry["child_frame_id"], "wren/base_link");
        assert_pose(&odometry["pose"]);
        // 74 degrees to the left of the peer, flying to the peer's left: 0.96 of it is straight
        // ahead.
        let linear = &odometry["twist"]["twist"]["linear"];
        assert!((linear["x"].as_f64().unwrap() - 1.92).abs() < 1e-9, "{linear}");
        assert!((linear["y"].as_f64().unwrap() - 0.56).abs() < 1e-9, "{linear}");
        assert_eq!(odometry["twist"]["covariance"][35], UNKNOWN_VARIANCE);

        // As `ros2 topic list -t` and `ros2 topic info -v` would say.
        for (topic, message) in topics.iter().zip(TYPES) {
            let info = &of("listed", topic)["info"];
            assert_eq!(info["types"], json!([message.ros_name()]));
            assert_eq!(info["publishers"][0]["node"], "/wren/flockeye");
            assert_eq!(info["publishers"][0]["type_hash"], message.hash());
        }
    });
}
