//! The report: its size, its form, and what is refused.
#![allow(clippy::unwrap_used, clippy::expect_used)]

use std::collections::BTreeMap;

use super::*;
use crate::{MeasuredBy, TrackState};

/// As long as it can be: variances cannot be negative.
fn covariance() -> [f64; 21] {
    let variances = [0, 6, 11, 15, 18, 20];
    std::array::from_fn(|k| if variances.contains(&k) { 1.234_567e-12 } else { -1.234_567e-12 })
}

fn longest_target(name: &str) -> TargetReport {
    let (position, orientation) = ([-123.456_789_012; 3], [-0.500_000_123; 4]);
    TargetReport {
        name: name.into(),
        state: TrackState::Confirmed,
        measured_by: MeasuredBy::Decoded,
        markers: u32::MAX,
        unseen_s: 1.2345678901234,
        position,
        orientation,
        covariance: covariance(),
        linear_velocity: [-1.234_567_890_123e-5; 3],
        angular_velocity: [-1.234_567_890_123e-5; 3],
        measured: Some(Measurement { position, orientation, covariance: covariance() }),
        rival: None,
        predicted: Some(Predicted {
            after_s: 0.123_456_789,
            position,
            orientation,
            deviations: [1.234_567e-10; 6],
        }),
        degenerate: Some(Degenerate {
            position: Some([-0.577_35; 3]),
            rotation: Some([-0.577_35; 3]),
        }),
    }
}

/// As [`longest_target`], of an ambiguous track.
fn ambiguous_target(name: &str) -> TargetReport {
    let target = longest_target(name);
    let Measurement { position, orientation, covariance } = target.measured.clone().unwrap();
    let rival = Some(Rival { position, orientation, covariance, lead: 1.234_567 });
    TargetReport { measured: None, measured_by: MeasuredBy::Nothing, rival, ..target }
}

fn frame(targets: Vec<TargetReport>) -> FrameReport {
    FrameReport {
        schema: FRAME_SCHEMA.into(),
        observer: "wren".into(),
        frame: 7,
        epoch: 1,
        stamp_utc_ns: 1_700_000_000_000_000_000,
        clock_synchronised: true,
        stream_s: 0.25,
        latency_ms: 12.5,
        odometry: None,
        clocks: BTreeMap::new(),
        targets,
    }
}

#[test]
fn the_longest_target_fits_a_packet_and_the_most_targets_a_report() {
    let name = |k: usize| format!("{k:02}{}", "t".repeat(MAX_NAME_CHARS - 2));
    let target = |k: usize| match k % 2 {
        0 => ambiguous_target(&name(k)),
        _ => longest_target(&name(k)),
    };
    let mut report = frame((0..MAX_TARGETS).map(target).collect());
    let offset = ClockOffset { one_way_ms: -1e12, offset_ms: -1e12, deviation_ms: 1.234_567e-5 };
    report.clocks = (0..MAX_TARGETS).map(|k| (name(k), offset)).collect();
    report.odometry = Some(Odometry {
        position: [-1_234.567_891; 3],
        orientation: [-0.500_000_1; 4],
        deviations: Some([1.234e-10; 6]),
        linear_velocity: [-12.345_678; 3],
        angular_velocity: [-12.345_678; 3],
    });
    let json = report.to_json().expect("each target fits, and all do");
    let back = FrameReport::from_json(&json).expect("reads back");
    assert_eq!(back.targets.len(), MAX_TARGETS);
    let (sent, read) = (&report.targets[3], &back.targets[3]);
    assert_eq!(read.name, sent.name);
    assert!((read.position[0] - sent.position[0]).abs() < 1e-6);
    assert!((read.covariance[3] / sent.covariance[3] - 1.0).abs() < 5e-3);
    assert!(read.measured.is_some() && read.predicted.is_some() && read.degenerate.is_some());
}

/// Readers in other languages know these names.
#[test]
fn the_fields_of_a_report_have_their_names() {
    let json = frame(vec![longest_target("kite"), ambiguous_target("kea")]).to_json();
    let json = json.expect("fits");
    let value: serde_json::Value = serde_json::from_slice(&json).unwrap();
    let keys = |value: &serde_json::Value| {
        value.as_object().expect("an object").keys().cloned().collect::<Vec<_>>().join(" ")
    };
    assert_eq!(
        keys(&value),
        "schema observer frame epoch stamp_utc_ns clock_synchronised stream_s latency_ms targets"
    );
    assert_eq!(
        keys(&value["targets"][0]),
        "target state measured_by markers unseen_s position orientation covariance \
         linear_velocity angular_velocity measured predicted degenerate"
    );
    assert_eq!(keys(&value["targets"][1]["rival"]), "position orientation covariance lead");
    assert_eq!(value["schema"], "flockeye.frame/2");
    let target = &value["targets"][0];
    assert_eq!(
        (target["state"].as_str(), target["measured_by"].as_str()),
        (Some("confirmed"), Some("decoded"))
    );
}

/// `docs/schemas/` is what people validate against. `UPDATE_SCHEMAS=1` writes it anew.
#[test]
fn the_schemas_in_the_repository_are_those_of_the_types() {
    let schemas = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/schemas");
    let path = schemas.join("frame-report-2.json");
    let schema = schemars::schema_for!(FrameReport);
    let text = serde_json::to_string_pretty(&schema).unwrap() + "\n";
    if std::env::var_os("UPDATE_SCHEMAS").is_some() {
        std::fs::write(&path, &text).unwrap();
    }
    let stored = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(stored == text, "{} is not what the types say", path.display());
}

#[test]
fn foreign_bytes_are_refused_with_their_reason() {
    let error = |bytes: &[u8]| FrameReport::from_json(bytes).expect_err("refused").to_string();
    assert!(error(b"\xff\xfe").starts_with("not a report"));
    assert!(error(&[b' '; 90_000]).contains("90000 bytes"));
    let changed = |change: &dyn Fn(&mut FrameReport)| {
        let mut report = frame(vec![longest_target("kite"), longest_target("swift")]);
        change(&mut report);
        error(&serde_json::to_vec(&report).unwrap())
    };
    for schema in ["flockeye.pose/1", "flockeye.frame/9"] {
        assert!(changed(&|report| report.schema = schema.into()).contains(schema));
    }
    assert!(changed(&|report| report.targets[0].orientation = [0.0; 4]).contains("orientation"));
    assert!(changed(&|report| report.targets[0].covariance[6] = -1.0).contains("covariance"));
    assert!(changed(&|report| report.schema = "x".repeat(99)).len() < 100);
    assert!(changed(&|report| report.targets[1].name = "kite".into()).contains("twice"));
    assert!(changed(&|report| report.targets[1].name = "../kite".into()).contains("no name"));
    assert!(changed(&|report| report.targets[0].covariance[20] = -1e-9).contains("covariance"));
    let turned = |report: &mut FrameReport| {
        if let Some(predicted) = &mut report.targets[0].predicted {
            predicted.orientation = [0.1; 4];
        }
    };
    assert!(changed(&turned).contains("predicted orientation"));
    let many = |report: &mut FrameReport| {
        report.targets = (0..65).map(|k| longest_target(&format!("t{k}"))).collect();
        report
            .targets
            .iter_mut()
            .for_each(|target| (target.measured, target.predicted) = (None, None));
    };
    assert!(changed(&many).contains("65 targets"));
}

/// Every single byte of a report, changed, is either refused or a report that is in order.
#[test]
fn a_report_with_a_broken_byte_is_refused_or_in_order() {
    let json = frame(vec![longest_target("kite")]).to_json().unwrap();
    for index in 0..json.len() {
        for byte in [0, b'"', b'9', b'-', b'e', b'}', 0xff] {
            let mut broken = json.clone();
            broken[index] = byte;
            if let Ok(report) = FrameReport::from_json(&broken) {
                assert!(report.targets.iter().all(|target| {
                    target.position.iter().all(|x| x.is_finite()) && is_name(&target.name)
                }));
            }
        }
    }
}
