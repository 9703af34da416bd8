//! The same scene over Foxglove's protocol, read by a client that has none of its code.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::SystemTime;

use flockeye_require::loopback::free_port;
use flockeye_tests::{Flight, SMALL_FLIGHT};
use rustix::process::Signal;
use serde_json::Value;

use super::View;
use crate::python::python;

/// Topics and their schemas.
const TOPICS: [(&str, &str); 8] = [
    ("/tf", "foxglove.FrameTransforms"),
    ("/scene", "foxglove.SceneUpdate"),
    ("/pose/alpha", "foxglove.PoseInFrame"),
    ("/sphere", "foxglove.CompressedImage"),
    ("/sphere/annotations", "foxglove.ImageAnnotations"),
    ("/closeup/alpha", "foxglove.CompressedImage"),
    ("/frames", ""),
    ("/stages", ""),
];

#[test]
fn foxglove_sees_the_same_scene() {
    let Some(python) = python() else { return };
    let mut flight = Flight::with_poses("foxglove", &[], SMALL_FLIGHT);
    let address = format!("127.0.0.1:{}", free_port());
    let view = View::of(&flight, &["--foxglove", &address]);
    let mut command = Command::new(python);
    command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("src/foxglove.py"));
    command.arg(format!("ws://{address}"));
    // Right after it has joined, the view may know no neighbour.
    command.args(TOPICS.map(|(topic, _)| match topic {
        "/tf" | "/scene" | "/sphere/annotations" | "/frames" => format!("{topic}=alpha"),
        "/stages" => format!("{topic}=fusion"),
        other => other.to_owned(),
    }));
    // The script has a watchdog of its own.
    let output = command.stdin(Stdio::null()).output().expect("it can be started");
    let (said, complaints) = (text(&output.stdout), text(&output.stderr));
    assert!(output.status.success(), "{said:.2000}\n{complaints}");
    let lines = said.lines().map(|line| serde_json::from_str::<Value>(line).expect("JSON"));
    let heard: BTreeMap<String, Value> =
        lines.map(|line| (line["topic"].as_str().expect("a name").to_owned(), line)).collect();
    let now = SystemTime::UNIX_EPOCH.elapsed().expect("it is later").as_secs_f64();
    for (topic, schema) in TOPICS {
        let line = &heard[topic];
        assert_eq!(line["schema"].as_str().unwrap_or_default(), schema, "{topic}");
        let stamp = line["stamp"].as_f64().expect("a number") * 1e-9;
        assert!((now - stamp).abs() < 300.0, "{topic} is of {stamp}, now it is {now}");
    }
    let message = |topic: &str| &heard[topic]["message"];
    let place = |vector: &Value| ["x", "y", "z"].map(|axis| vector[axis].as_f64().unwrap_or(0.0));
    let range = |[x, y, z]: [f64; 3]| (x * x + y * y + z * z).sqrt();

    let transforms = message("/tf")["transforms"].as_array().expect("a list");
    let alpha = transforms.iter().find(|one| one["child_frame_id"] == "alpha").expect("alpha");
    assert_eq!(alpha["parent_frame_id"], "observer");
    let of_transform = place(&alpha["translation"]);
    let pose = message("/pose/alpha");
    let of_pose = place(&pose["pose"]["position"]);
    assert_eq!(pose["frame_id"], "observer");
    for place in [of_transform, of_pose] {
        assert!((0.3..0.8).contains(&range(place)), "the flight is at 0.45 to 0.6 m: {place:?}");
    }
    let entity = &message("/scene")["entities"][0];
    assert_eq!((&entity["id"], &entity["frame_id"]), (&"alpha".into(), &"observer".into()));
    let corners = entity["triangles"][0]["points"].as_array().expect("a list");
    assert_eq!(corners.len(), 3 * (18 * 2 + 8), "18 squares and 8 triangles");
    assert!(place(&entity["spheres"][0]["size"]).iter().all(|size| *size > 0.0), "{entity}");

    for topic in ["/sphere", "/closeup/alpha"] {
        let picture = message(topic);
        assert_eq!(picture["format"], "jpeg");
        let data = picture["data"].as_str().expect("bytes in base 64");
        assert!(data.starts_with("/9j/") && data.len() > 500, "{topic} is a JPEG");
    }
    let annotations = message("/sphere/annotations");
    let named = annotations["texts"][0]["text"].as_str().expect("a name");
    assert!(named.starts_with("alpha 0."), "{named}");
    let outlines = annotations["points"].as_array().expect("a list");
    assert!(outlines.len() >= 6, "the facets that face the camera: {}", outlines.len());
    assert_eq!(message("/frames")["tracks"][0]["name"], "alpha");
    let stages = message("/stages")["stages"].as_array().expect("a list");
    assert!(stages.iter().any(|stage| stage["stage"] == "fusion"), "{stages:?}");

    // All topics of the layout exist.
    let layout = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/foxglove-layout.json");
    let layout = std::fs::read_to_string(layout).expect("it is in the repository");
    let layout: Value = serde_json::from_str(&layout).expect("JSON");
    let mut shown = Vec::new();
    topics_in(&layout, &mut shown);
    assert!(shown.len() >= 5, "{shown:?}");
    for path in shown {
        let topic = path.split('.').next().expect("something");
        assert!(TOPICS.iter().any(|(known, _)| *known == topic), "{path}");
    }

    view.end();
    flight.end_by(Signal::INT);
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Everything in a layout that is a topic or a path into one.
fn topics_in(value: &Value, found: &mut Vec<String>) {
    match value {
        Value::String(text) if text.starts_with('/') => found.push(text.clone()),
        Value::Array(items) => items.iter().for_each(|item| topics_in(item, found)),
        Value::Object(map) => {
            found.extend(map.keys().filter(|key| key.starts_with('/')).cloned());
            map.values().for_each(|item| topics_in(item, found));
        }
        _ => {}
    }
}
