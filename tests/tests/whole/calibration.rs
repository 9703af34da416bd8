//! A body that was glued a millimetre and a degree off is found as it is, by the real stages.

use std::time::Duration;

use flockeye_geometry::body::{Bodies, Body, Marker, squares};
use flockeye_geometry::calibration::alignment;
use flockeye_tests::{Flight, Scratch, flockeye, run, unique};
use nalgebra::{Point3, UnitQuaternion, Vector3};

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
    // Who reads bodies reads these too.
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
