#![allow(clippy::unwrap_used, clippy::expect_used)]

use flockeye_config::Pipeline;
use flockeye_contract::{MeasuredBy, TrackState};
use flockeye_tables::MeasuredPose;
use nalgebra::{Matrix6, Translation3, UnitQuaternion, Vector3, Vector6};

use super::*;

fn transform(position: [f64; 3], turn: [f64; 3]) -> Isometry3<f64> {
    Isometry3::from_parts(
        Translation3::from(Vector3::from(position)),
        UnitQuaternion::from_scaled_axis(Vector3::from(turn)),
    )
}

/// The camera's real mount, and the configured one.
fn mounts() -> (Isometry3<f64>, Isometry3<f64>) {
    (
        transform([0.05, -0.01, 0.12], [0.02, -0.05, 0.3]),
        transform([0.0, 0.0, 0.1], [0.0, 0.0, 0.2]),
    )
}

/// The mount in a configuration.
fn mount_in(yaml: &str) -> Isometry3<f64> {
    let read = Pipeline::parse(yaml, &[], "the report").unwrap();
    isometry(&read.observer.observer_from_camera)
}

const PLACES: [[f64; 3]; 5] =
    [[0.8, 0.0, 0.0], [0.1, 0.9, 0.2], [-0.7, -0.1, 0.0], [0.0, -0.8, -0.3], [0.5, 0.5, 0.6]];

fn bench() -> MeasuringBench {
    let places = PLACES.map(|[x, y, z]| format!("{{position: [{x}, {y}, {z}]}}")).join(", ");
    parse(&format!("deviation_m: 0.002\nplaces: [{places}]")).unwrap()
}

fn parse(yaml: &str) -> anyhow::Result<MeasuringBench> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("places.yaml");
    std::fs::write(&path, yaml).unwrap();
    let bench: MeasuringBench = read_document(&path)?;
    bench.check()?;
    Ok(bench)
}

/// The row of a body at a place, as a pipeline with the configured mount records it.
fn row(frame: u64, target: &str, in_observer: [f64; 3]) -> PoseRow {
    let (real, configured) = mounts();
    let placed = transform(in_observer, [0.0, 0.0, 1.0]);
    let said = configured * real.inverse() * placed;
    let deviations = Vector6::new(1e-3, 1e-3, 1e-3, 0.01, 0.01, 0.01);
    let covariance = Some(Matrix6::from_diagonal(&deviations.component_mul(&deviations)));
    let (position, orientation) = (said.translation.vector, said.rotation);
    PoseRow {
        frame,
        stamp_s: frame as f64,
        target: target.into(),
        position,
        orientation,
        state: TrackState::Measured,
        markers: 3,
        measured_by: MeasuredBy::Aligned,
        measured: Some(MeasuredPose { position, orientation, covariance }),
        covariance,
        predicted: None,
        latency_ms: 1.0,
    }
}

fn rows() -> Vec<PoseRow> {
    (0..).zip(PLACES).map(|(frame, place)| row(frame, "alpha", place)).collect()
}

#[test]
fn what_is_printed_can_be_pasted_and_is_the_mount() {
    let (real, configured) = mounts();
    let report = MountReport::of(&bench(), &rows(), configured).unwrap();
    let printed = report.text();
    let yaml = printed.split_once("for pipeline.yaml:\n").unwrap().1;
    let read = mount_in(yaml);
    assert!((read.translation.vector - real.translation.vector).norm() < 2e-6, "{printed}");
    assert!(read.rotation.angle_to(&real.rotation) < 1e-6, "{printed}");
    let json = report.as_json();
    // A tenth of a radian about z is 150 mm at 1.5 m, and more with the rest.
    assert!(json["configured_error_mm_at_1.5_m"].as_f64().unwrap() > 150.0, "{json}");
    assert!(json["error_mm_at_1.5_m"].as_f64().unwrap() < 10.0, "{json}");
    assert!(printed.contains("at 1.5 m in the worst direction"), "{printed}");
}

#[test]
fn places_without_a_pose_and_wrong_ones_are_named() {
    let (real, configured) = mounts();
    let mut rows = rows();
    rows.remove(1);
    let text = MountReport::of(&bench(), &rows, configured).unwrap().text();
    assert!(text.contains("place 2: the body has no pose there"), "{text}");
    rows.truncate(2);
    let error = MountReport::of(&bench(), &rows, configured).err().unwrap().to_string();
    assert!(error.contains("2 places with a pose") && error.contains("[2, 4, 5]"), "{error}");
    // The third place was written down wrongly.
    let mut bench = bench();
    bench.places[2].position[0] += 0.1;
    let report = MountReport::of(&bench, &self::rows(), configured).unwrap();
    let text = report.text();
    assert!(text.contains("contradicts the others: left out"), "{text}");
    assert!(!report.found.places[2].is_kept);
    let error = report.found.error_of_m(&real, 1.5);
    assert!(error < 1e-6, "{error}");
}

#[test]
fn frames_of_a_place_are_those_of_the_file() {
    let (_, configured) = mounts();
    let mut bench = bench();
    let mut rows = Vec::new();
    for (k, place) in (0..).zip(&mut bench.places) {
        place.frames = Some([10 * k, 10 * k + 4]);
        rows.extend((10 * k..10 * k + 6).map(|frame| row(frame, "alpha", place.position)));
    }
    // In one of them the body was still in a hand; the sixth is of no place.
    rows[2] = row(2, "alpha", [0.9, 0.1, 0.1]);
    let report = MountReport::of(&bench, &rows, configured).unwrap();
    let [first, second] = [0, 1].map(|k| &report.seen[k].1);
    assert_eq!((first.frames, first.odd, second.frames), (4, 1, 5));
    assert!(report.text().contains("place 1: 1 frames have another pose"), "{}", report.text());
}

#[test]
fn the_body_is_the_only_one_or_the_named_one() {
    let mut bench = bench();
    let mut rows = rows();
    assert_eq!(bench.body(&rows).unwrap(), "alpha");
    rows.push(row(0, "bravo", [1.0, 0.0, 0.0]));
    assert!(bench.body(&rows).unwrap_err().to_string().contains("Cure: name the one"));
    bench.body = Some("bravo".into());
    assert_eq!(bench.body(&rows).unwrap(), "bravo");
    bench.body = Some("charlie".into());
    assert!(bench.body(&rows).unwrap_err().to_string().contains("'charlie' is never seen"));
    assert!(bench.body(&[]).unwrap_err().to_string().contains("no body is seen"));
}

#[test]
fn a_wrong_file_is_refused_with_its_place() {
    for (yaml, wanted) in [
        ("places: []", "deviation_m: is missing"),
        ("deviation_m: 0\nplaces: []", "deviation_m"),
        ("deviation_m: 0.001\nplaces:\n  - {position: [1, 2]}", "places.0.position"),
        ("deviation_m: 0.001\nplaces:\n  - {positon: [1, 2, 3]}", "did you mean 'position'?"),
        (
            "deviation_m: 0.001\nplaces:\n  - {position: [1, 2, 3], frames: [5, 2]}",
            "the last frame, 2, is before 5",
        ),
        (
            "deviation_m: 0.001\nplaces:\n  - {position: [1, 2, 3], frames: [5, 6]}\n  - {position: [1, 2, 3]}",
            "1 of 2 places have frames",
        ),
        (
            "deviation_m: 0.001\nplaces:\n  - {position: [1, 2, 3], orientation: [0, 0, 0, 1]}",
            "Cure: orientation_deviation_deg",
        ),
        (
            "deviation_m: 0.001\norientation_deviation_deg: 1\nplaces:\n  - {position: [1, 2, 3], orientation: [0, 0, 1, 1]}",
            "has length 1, not 1.4142",
        ),
    ] {
        let error = parse(yaml).err().map(|error| format!("{error:#}")).unwrap_or_default();
        assert!(error.contains(wanted), "{yaml}: {error}");
    }
}
