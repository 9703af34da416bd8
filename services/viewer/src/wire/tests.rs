#![allow(clippy::unwrap_used)]
use std::collections::BTreeSet;

use flockeye_config::{Pipeline, Resolved};
use serde_json::Value;

use super::*;
use crate::scene::PageScene;

/// All keys of a value, those of what is in it too.
fn keys(value: &Value, found: &mut BTreeSet<String>) {
    match value {
        Value::Object(fields) => {
            found.extend(fields.keys().cloned());
            fields.values().for_each(|value| keys(value, found));
        }
        Value::Array(items) => items.iter().for_each(|item| keys(item, found)),
        _ => {}
    }
}

fn pose() -> PagePose {
    PagePose { p: [0.0; 3], q: [0.0, 0.0, 0.0, 1.0] }
}

/// A frame in which nothing is absent.
fn whole_frame() -> FrameMessage {
    let header = flockeye_contract::TrackHeader { is_last: 1, ..Default::default() };
    let track: flockeye_contract::Track = bytemuck::Zeroable::zeroed();
    let mut frame = PageScene::new(true).tracks(&header, &[track], 0).unwrap().message;
    let view = ViewSquare { q: [0.0; 4], half: 1.0 };
    frame.regions = vec![RegionView { target: 0, view }];
    frame.markers = vec![Detected { id: 0, rays: [[0.0; 3]; 4] }];
    frame.truth = vec![Truth { target: 0, pose: pose() }];
    frame
}

/// RECORDING.md has a row for each message, for authors of a page. That row, or the rows of its
/// fields, name each key.
#[test]
fn the_document_names_every_key() {
    let document = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/RECORDING.md");
    let document = std::fs::read_to_string(document).unwrap();
    let resolved = Resolved::of(Pipeline::default()).unwrap();
    let mut hello = crate::setting::hello(&resolved, "x", 1.0);
    let file = "flight.mcap".to_owned();
    hello.recording =
        Some(RecordingSummary { file, began_s: 0.0, duration_s: 1.0, pictures: true });
    let mut reports = PageScene::new(true);
    reports.health(&Default::default());
    let drone = DroneSummary {
        name: String::new(),
        pose: pose(),
        covariance: [0.0; 6],
        way: "direct",
        through: String::new(),
        age_s: 0.0,
    };
    let sighting = SightingSummary {
        observer: String::new(),
        target: String::new(),
        state: "confirmed",
        range_m: 1.0,
        age_s: 0.0,
    };
    let overview = Overview {
        states: vec![TargetStates { target: 0, states: Vec::new() }],
        losses: vec![TopicLoss { topic: String::new(), recorded: 1, lost: 1 }],
        ..Overview::default()
    };
    let (frame, stages) = (whole_frame(), reports.stages(0));
    let messages = [
        TextMessage::Hello(&hello),
        TextMessage::Frame(&frame),
        TextMessage::Stages { stages: &stages },
        TextMessage::Swarm { drones: &[drone], sightings: &[sighting] },
        TextMessage::Status { running: false, trouble: "" },
        TextMessage::Position { key: None, at_s: 0.0, speed: 0.0, picture: None, answers: 0 },
        TextMessage::Overview(&overview),
    ];
    let json = |message: Message| serde_json::from_str(message.to_text().unwrap()).unwrap();
    let mut values: Vec<Value> = messages.iter().map(|message| json(text(message))).collect();
    let picture = BinaryHead::Picture { key: String::new(), size: [1, 1] };
    let score = Some(Likeness { correlation: 0.0, log_odds: 0.0, facets: 0 });
    let closeup = CloseupHead { key: String::new(), target: 0, size: [1, 1], panels: 1, score };
    values.extend(
        [picture, BinaryHead::Closeup(closeup)].map(|head| serde_json::to_value(head).unwrap()),
    );
    let rows: Vec<&str> = document.lines().filter(|line| line.starts_with("| `")).collect();
    let row = |name: &str| {
        let start = format!("| `{name}` |");
        rows.iter().find(|row| row.starts_with(&start)).copied().unwrap_or_default()
    };
    for value in &values {
        let kind = value["kind"].as_str().unwrap();
        assert!(!row(kind).is_empty(), "{kind} has no row");
        for (name, inner) in value.as_object().unwrap() {
            let here = row(kind);
            assert!(
                name == "kind" || here.contains(&format!("`{name}`")),
                "{name} is not in the row of {kind}"
            );
            let mut inside = BTreeSet::new();
            keys(inner, &mut inside);
            let table = row(&format!("{kind}.{name}"));
            for key in inside {
                assert!(
                    table.contains(&format!("`{key}`")),
                    "{key} is not in the row of {kind}.{name}"
                );
            }
        }
    }
}

#[test]
fn a_binary_message_says_where_its_picture_begins() {
    let head = BinaryHead::Picture { key: "0.1.2".into(), size: [4, 2] };
    let message = binary(&head, b"jpeg").into_data();
    let length = u32::from_le_bytes(message[..4].try_into().unwrap()) as usize;
    let read: Value = serde_json::from_slice(&message[4..4 + length]).unwrap();
    assert_eq!((read["kind"].as_str(), read["key"].as_str()), (Some("picture"), Some("0.1.2")));
    assert_eq!(&message[4 + length..], b"jpeg");
}
