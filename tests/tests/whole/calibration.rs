//! Parts that were built or mounted wrongly by a known amount are found as they are, by the real
//! stages: a body, a camera's mount, its lenses.

use std::time::Duration;

use flockeye_config::{Mount, isometry};
use flockeye_geometry::body::{Bodies, Body, Marker, squares};
use flockeye_lab::calibration::alignment;
use flockeye_tables::{TruthRow, read};
use flockeye_tests::{Flight, Scratch, flockeye, run, succeeds, unique};
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use serde_json::Value;

/// Repeatable numbers from -1 to 1, of deviation 0.58.
fn chance(count: usize) -> impl Iterator<Item = f64> {
    (1..=count).map(|k| 2.0 * (k as f64 * 0.754_877_666).fract() - 1.0)
}

/// The body with every marker up to 1.2 mm and 1.2 degrees off along each axis.
fn glued(designed: &Body) -> Body {
    let numbers: Vec<f64> = chance(6 * designed.markers.len()).collect();
    let markers = designed.markers.iter().zip(numbers.chunks(6)).map(|(marker, by)| {
        let centre = marker.centre();
        let shift = Vector3::new(by[0], by[1], by[2]) * 1.2e-3;
        let turn = Vector3::new(by[3], by[4], by[5]) * 1.2f64.to_radians();
        let turn = UnitQuaternion::from_scaled_axis(turn);
        let corners = marker.corners.map(|corner| centre + shift + turn * (corner - centre));
        Marker { id: marker.id, corners }
    });
    designed.with_markers(markers.collect()).expect("the same ids")
}

/// Distance between the centres, metres, and angle between the orientations, radians.
fn apart(a: &Marker, b: &Marker) -> (f64, f64) {
    let (a, b) = (a.markers_from_marker(), b.markers_from_marker());
    ((a.translation.vector - b.translation.vector).norm(), a.rotation.angle_to(&b.rotation))
}

fn root_mean_square(values: impl Iterator<Item = f64> + Clone) -> f64 {
    let count = values.clone().count() as f64;
    (values.map(|value| value * value).sum::<f64>() / count).sqrt()
}

#[test]
fn a_badly_glued_body_is_found_as_it_is() {
    let scratch = Scratch::new("glued");
    let designed = squares("alpha", 0.0625, 0.05, 0);
    let real = glued(&designed);
    let file = scratch.path("real.json");
    let bodies = Bodies::new("DICT_5X5_250".into(), vec![real.clone()]).expect("a body");
    std::fs::write(&file, bodies.to_json().to_string()).expect("it can be written");
    let out = scratch.path("found.json");
    let text = |path: &std::path::Path| path.to_str().expect("a text").to_owned();
    let mut command = std::process::Command::new(flockeye());
    command.args([
        "calibrate",
        "body",
        "--source",
        "sim",
        "--out",
        &text(&out),
        "--set",
        &format!("simulator.bodies={}", text(&file)),
        "--set",
        "simulator.frames=240",
        "--set",
        "simulator.frames_per_second=6",
        "--set",
        "simulator.distance_m=[0.4, 0.6]",
        "--set",
        "simulator.airframes=false",
        "--set",
        "camera.width=2048",
        "--set",
        "camera.height=1024",
    ]);
    let mut flight = Flight::launch(&unique("glued"), command);
    // A busy machine works on two of these frames in a second.
    let succeeded = flight.wait_for_end(Duration::from_secs(400)).success();
    let output = flight.output();
    assert!(succeeded, "{output}");
    println!("{output}");
    let found: serde_json::Value =
        serde_json::from_slice(&std::fs::read(&out).expect("it was written")).expect("JSON");
    // The written file is a valid bodies file.
    let read = Bodies::from_json(&found.to_string()).expect("a bodies file");
    let read = read.iter().find(|body| body.name == "alpha").expect("it is there");
    let listed = found["bodies"]["alpha"]["markers"].as_array().expect("a list");
    let stated: Vec<Option<(f64, f64)>> = listed
        .iter()
        .map(|marker| {
            Some((marker["shift_deviation_m"].as_f64()?, marker["turn_deviation_rad"].as_f64()?))
        })
        .collect();
    let is_found = |k: &usize| stated[*k].is_some();
    let which: Vec<usize> = (0..stated.len()).filter(is_found).collect();
    assert!(which.len() >= 13, "{} markers were found:\n{output}", which.len());
    // The truth in the frame that a calibration keeps: that of the found markers' design.
    let corners = |body: &Body| -> Vec<Point3<f64>> {
        which.iter().flat_map(|&k| body.markers[k].corners).collect()
    };
    let motion = alignment(&corners(&real), &corners(&designed));
    let truth = |k: usize| {
        let marker = &real.markers[k];
        Marker { id: marker.id, corners: marker.corners.map(|corner| motion * corner) }
    };
    let before: Vec<_> = which.iter().map(|&k| apart(&truth(k), &designed.markers[k])).collect();
    let after: Vec<_> = which.iter().map(|&k| apart(&truth(k), &read.markers[k])).collect();
    let stated: Vec<(f64, f64)> = stated.into_iter().flatten().collect();
    let rms = |list: &[(f64, f64)]| {
        let (shift, turn) = (list.iter().map(|x| x.0 * 1e3), list.iter().map(|x| x.1.to_degrees()));
        [root_mean_square(shift), root_mean_square(turn)]
    };
    let (before, after, stated) = (rms(&before), rms(&after), rms(&stated));
    println!("mm, degrees: {before:.3?} to {after:.3?}, stated {stated:.3?}");
    for part in 0..2 {
        assert!(after[part] < before[part] / 4.0, "{before:?} to {after:?}");
        let ratio = after[part] / stated[part];
        assert!((0.3..3.0).contains(&ratio), "{after:?} where {stated:?} is stated");
    }
}

#[test]
fn a_flight_too_short_says_what_is_missing() {
    let scratch = Scratch::new("short");
    let out = scratch.path("found.json");
    let (succeeded, output) = run(&[
        "calibrate",
        "body",
        "--source",
        "sim",
        "--out",
        out.to_str().expect("a text"),
        "--set",
        "simulator.frames=12",
        "--set",
        "simulator.distance_m=[0.4, 0.6]",
        "--set",
        "camera.width=1024",
        "--set",
        "camera.height=512",
    ]);
    assert!(!succeeded, "{output}");
    assert!(output.contains("body 'alpha' was seen with two markers or more in"), "{output}");
    assert!(output.contains("30 are needed"), "{output}");
}

/// The settings as arguments.
fn set<'a>(settings: &[&'a str]) -> Vec<&'a str> {
    settings.iter().flat_map(|setting| ["--set", *setting]).collect()
}

/// The numbers of a list in a report.
fn numbers<const N: usize>(value: &Value) -> [f64; N] {
    let list = value.as_array().unwrap_or_else(|| panic!("{value} is no list"));
    let numbers: Vec<f64> = list.iter().filter_map(Value::as_f64).collect();
    numbers.try_into().unwrap_or_else(|_| panic!("{value} has not {N} numbers"))
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

/// A mount in a report.
fn transform(value: &Value) -> Isometry3<f64> {
    isometry(&Mount {
        position: numbers(&value["position"]),
        orientation: numbers(&value["orientation"]),
    })
}

/// A known error of a mount, metres and radians, in the axes that it leads to.
fn moved(mount: &Isometry3<f64>, shift: [f64; 3], turn: [f64; 3]) -> Isometry3<f64> {
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::from(turn)) * mount.rotation;
    Isometry3::from_parts((mount.translation.vector + Vector3::from(shift)).into(), rotation)
}

/// The errors of a mount, as roots of the summed squares of position, then rotation. Fails if one
/// exceeds its stated deviation 2.5 times.
fn left_as_stated(truth: &Isometry3<f64>, found: &Isometry3<f64>, report: &Value) -> [f64; 2] {
    let norm = |key: &str| Vector3::from(numbers::<3>(&report[key])).norm();
    let stated = [norm("position_deviation_m"), norm("rotation_deviation_rad")];
    let shift = (truth.translation.vector - found.translation.vector).norm();
    let left = [shift, truth.rotation.angle_to(&found.rotation)];
    println!("left {left:.5?}, stated {stated:.5?}");
    for part in 0..2 {
        assert!(left[part] < 2.5 * stated[part], "{left:?} where {stated:?} is stated");
    }
    left
}

#[test]
fn a_camera_that_was_mounted_wrongly_is_found_by_a_body_at_measured_places() {
    let scratch = Scratch::new("mount");
    let text = |path: &std::path::Path| path.to_str().expect("a text").to_owned();
    // Stills: the body is somewhere else in each.
    let world = [
        "camera.width=2048",
        "camera.height=1024",
        "simulator.frames=10",
        "simulator.frames_per_second=0.2",
        "simulator.distance_m=[0.5, 1.0]",
        "simulator.airframes=false",
        "observer.observer_from_camera.position=[0.1, 0.0, 0.2]",
        "observer.observer_from_camera.orientation=[0.0, 0.0, 0.6, 0.8]",
    ];
    let truth_file = text(&scratch.path("truth.csv"));
    let quick = ["profile=repeat", "search.mode=greedy", "gateway.enabled=false"];
    let mut flight =
        Flight::start("places", &["--truth", &truth_file], &[&world[..], &quick].concat());
    assert!(flight.wait().success(), "{}", flight.output());
    let truth: Vec<TruthRow> = read(std::path::Path::new(&truth_file)).expect("the truth");
    assert_eq!(truth.len(), 10);
    let configured =
        isometry(&Mount { position: [0.1, 0.0, 0.2], orientation: [0.0, 0.0, 0.6, 0.8] });
    let real = moved(&configured, [0.012, -0.008, 0.005], [0.02, -0.03, 0.025]);
    // A ruler's errors of 1 mm.
    let errors: Vec<f64> = chance(30).map(|x| x * 1e-3 / 0.58).collect();
    let places = truth.iter().zip(errors.chunks(3)).map(|(row, error)| {
        let place = real * Point3::from(row.position()) + Vector3::from_row_slice(error);
        serde_json::json!({ "position": place.coords.as_slice() })
    });
    let places: Vec<Value> = places.collect();
    let bench = serde_json::json!({ "deviation_m": 0.001, "places": places });
    let file = text(&scratch.path("places.json"));
    std::fs::write(&file, bench.to_string()).expect("it can be written");
    let arguments = ["calibrate", "mount", "--json", "--places", &file];
    let output = succeeds(&[&arguments[..], &set(&world)].concat());
    println!("{output}");
    let report: Value = serde_json::from_str(&output).expect("nothing but JSON");
    let found = transform(&report["observer_from_camera"]);
    let left = left_as_stated(&real, &found, &report);
    let before = configured.translation.vector - real.translation.vector;
    assert!(left[0] < before.norm() / 4.0 && left[1] < 0.005, "{left:?}");
    // Two degrees and a half are 65 mm at 1.5 m.
    let [after_mm, before_mm] =
        ["error_mm_at_1.5_m", "configured_error_mm_at_1.5_m"].map(|key| number(&report[key]));
    assert!((55.0..85.0).contains(&before_mm) && after_mm < before_mm / 8.0, "{output}");
    let listed = report["places"].as_array().expect("a list");
    assert!(listed.len() >= 9, "{output}");
    assert!(listed.iter().all(|place| place["kept"] == true), "{output}");
}

#[test]
fn places_that_do_not_tell_a_mount_are_refused_with_the_cure() {
    let scratch = Scratch::new("bench");
    let file = scratch.path("places.yaml");
    std::fs::write(&file, "deviation_m: 0.001\nplaces:\n  - {position: [1, 0]}\n")
        .expect("written");
    let arguments = ["calibrate", "mount", "--places", file.to_str().expect("a text")];
    let (succeeded, output) = run(&arguments);
    assert!(!succeeded && output.contains("places.0.position"), "{output}");
    assert!(output.contains("line 3"), "{output}");
    // Two pictures are not enough.
    std::fs::write(
        &file,
        "deviation_m: 0.001\nplaces:\n  - {position: [1, 0, 0]}\n  - {position: [0, 1, 0]}\n",
    )
    .expect("written");
    let world = ["camera.width=1024", "camera.height=512", "simulator.frames=2"];
    let near = ["simulator.distance_m=[0.45, 0.6]", "simulator.airframes=false"];
    let (succeeded, output) = run(&[&arguments[..], &set(&world), &set(&near)].concat());
    assert!(!succeeded && output.contains("3 or more are needed. Cure:"), "{output}");
}

/// A large body with small markers near the camera: where it spans the seam, both lenses see whole
/// markers.
const NEAR: [&str; 6] = [
    "camera.width=2048",
    "camera.height=1024",
    "bodies.list=[{name: alpha, edge_m: 0.1, marker_m: 0.04}]",
    "simulator.frames_per_second=5",
    "simulator.distance_m=[0.45, 0.7]",
    "simulator.airframes=false",
];

/// The report of `calibrate lenses` on the simulated flight.
fn lenses(name: &str, settings: &[&str]) -> Value {
    let mut command = std::process::Command::new(flockeye());
    command.args(["calibrate", "lenses", "--json"]).args(set(&NEAR)).args(set(settings));
    let mut flight = Flight::launch(&unique(name), command);
    // A busy machine works on two of these frames in a second.
    let succeeded = flight.wait_for_end(Duration::from_secs(400)).success();
    let output = flight.output();
    assert!(succeeded, "{output}");
    println!("{output}");
    serde_json::from_str(&output).expect("nothing but JSON")
}

#[test]
fn the_distance_between_stitched_lenses_is_found_from_a_flight() {
    let real_m = 0.016;
    // The camera turns about as fast as the body flies round it, which so stays near the seam.
    let report = lenses(
        "stitched",
        &[
            "camera.lens_distance_m=0.002",
            &format!("simulator.lens_distance_m={real_m}"),
            "simulator.seed=2",
            "simulator.yaw_deg_s=-38",
            "simulator.frames=110",
        ],
    );
    let [found_m, deviation_m] = ["lens_distance_m", "deviation_m"].map(|key| number(&report[key]));
    let off_m = (found_m - real_m).abs();
    assert!(off_m < 0.0003 && off_m < 3.5 * deviation_m, "{report}");
    let [after_mm, before_mm] =
        ["error_mm_at_1.5_m", "configured_error_mm_at_1.5_m"].map(|key| number(&report[key]));
    assert!((before_mm - 7.0).abs() < 0.5 && after_mm < 0.5, "{report}");
}

#[test]
fn a_second_fisheye_lens_is_found_where_it_is() {
    // One lens looks up, one down: so their seam is the horizon, where bodies fly.
    let up = "{centre_px: [511.5, 511.5], circle_px: 505, field_deg: 194, camera_from_lens: \
              {position: [0, 0, 0.008], orientation: [0, 0, 0, 1]}}";
    let second = |mount: &Isometry3<f64>| {
        let (position, orientation) = (mount.translation.vector, mount.rotation.coords);
        format!(
            "{{centre_px: [1535.5, 511.5], circle_px: 505, field_deg: 194, camera_from_lens: \
             {{position: {:?}, orientation: {:?}}}}}",
            position.as_slice(),
            orientation.as_slice()
        )
    };
    let configured =
        isometry(&Mount { position: [0.0, 0.0, -0.008], orientation: [1.0, 0.0, 0.0, 0.0] });
    let real = moved(&configured, [-0.003, 0.002, -0.002], [0.008, -0.006, 0.010]);
    let report = lenses(
        "fisheyes",
        &[
            "camera.projection=dual_fisheye",
            &format!("camera.lenses=[{up}, {}]", second(&configured)),
            &format!("simulator.lenses=[{up}, {}]", second(&real)),
            "simulator.frames=140",
        ],
    );
    let found = transform(&report["camera_from_lens"]);
    let left = left_as_stated(&real, &found, &report);
    // Off by 4 mm and 14 mrad before.
    assert!(left[0] < 0.0015 && left[1] < 0.003, "{left:?}");
    let [after_mm, before_mm] =
        ["error_mm_at_1.5_m", "configured_error_mm_at_1.5_m"].map(|key| number(&report[key]));
    assert!(before_mm > 18.0 && after_mm < before_mm / 4.0, "{report}");
}

#[test]
fn a_camera_with_one_centre_has_no_lenses_to_calibrate() {
    let (succeeded, output) =
        run(&["calibrate", "lenses", "--set", "camera.projection=stereographic"]);
    assert!(!succeeded && output.contains("has one centre. Cure:"), "{output}");
}
