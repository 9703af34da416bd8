//! Every camera flies: from its configuration to poses that meet the truth.

use std::fmt::Write;

use flockeye_tests::{Flight, Scratch, run, succeeds};
use serde_json::Value;

/// Two equidistant lenses, 16 mm apart.
const DUAL_FISHEYE: &str = "\
camera:
  width: 2048
  height: 1024
  projection: dual_fisheye
  lenses:
    - centre_px: [511.5, 511.5]
      circle_px: 505
      field_deg: 194
      camera_from_lens: {position: [0.008, 0, 0], orientation: [-0.5, 0.5, -0.5, 0.5]}
    - centre_px: [1535.5, 511.5]
      circle_px: 505
      field_deg: 194
      camera_from_lens: {position: [-0.008, 0, 0], orientation: [-0.5, -0.5, 0.5, 0.5]}
";

/// A stitched camera whose lenses are that far apart.
const STITCHED: &str = "camera: {width: 2048, height: 1024, lens_distance_m: 0.016}\n";

const STEREOGRAPHIC: &str = "camera: {width: 2048, height: 2048, projection: stereographic, stereographic_field_deg: 320}\n";

const FRAMES: u32 = 90;

/// A lossless simulated flight of one near neighbour with this camera; the evaluation's summary of
/// all distances, and what was said.
fn fly(name: &str, camera: &str, set: &[&str]) -> (Value, String) {
    let scratch = Scratch::new(name);
    let mut yaml = camera.to_owned();
    write!(
        yaml,
        "profile: repeat\nsimulator: {{frames: {FRAMES}, distance_m: [0.45, 0.6]}}\n\
         gateway: {{enabled: false}}\n"
    )
    .expect("a string takes everything");
    let path = |name: &str| scratch.path(name).to_str().expect("a plain path").to_owned();
    let (pipeline, poses, truth) = (path("pipeline.yaml"), path("poses.csv"), path("truth.csv"));
    std::fs::write(&pipeline, yaml).expect("a temporary file can be written");
    let mut flight = Flight::start(name, &[&pipeline, "--poses", &poses, "--truth", &truth], set);
    flight.assert_ends_well();
    let report = succeeds(&["eval", "--poses", &poses, "--truth", &truth, "--json"]);
    let report: Value = serde_json::from_str(&report).expect("the report is JSON");
    (report, flight.output())
}

/// Most of the frames are measured, and to a few millimetres. With both lenses taken for one point
/// the errors would be the 8 mm of each lens from it.
fn assert_sound((report, output): &(Value, String)) {
    // The last bin holds all distances.
    let all = report["bins"].as_array().and_then(|bins| bins.last()).expect("there are bins");
    let number = |key: &str| all[key].as_f64().unwrap_or_else(|| panic!("{key} in {report}"));
    assert!(number("measured") > 0.5 * f64::from(FRAMES), "{report}\n{output}");
    let median_mm = all["published"]["position_mm"]["median"].as_f64();
    assert!(median_mm.is_some_and(|median| median < 3.0), "{report}\n{output}");
    assert_eq!(report["false_poses"].as_u64(), Some(0), "{report}");
}

#[test]
fn a_dual_fisheye_camera_flies() {
    assert_sound(&fly("fisheye", DUAL_FISHEYE, &[]));
}

#[test]
fn a_stitched_camera_with_two_lenses_flies() {
    assert_sound(&fly("stitched", STITCHED, &[]));
}

/// Lenses 16 mm apart, stitched for 3 m, with all that such a camera does to its picture. Nobody
/// states any of it. Before the neighbour crosses the border, poses are off by 7 mm.
#[test]
fn a_stitched_camera_that_nobody_knows_is_learned() {
    let real = [
        "simulator.seed=3",
        "simulator.yaw_deg_s=40",
        "simulator.lens_distance_m=0.016",
        "simulator.stitch.fits_at_m=3",
        "simulator.stitch.blend_deg=3",
        "simulator.stitch.turn_deg=0.1",
        "simulator.stitch.darker=0.07",
        "simulator.stitch.sharpening=0.3",
        "simulator.stitch.tone=0.2",
    ];
    let (report, output) = fly("unknown", "camera: {width: 3840, height: 1920}\n", &real);
    let all = report["bins"].as_array().and_then(|bins| bins.last()).expect("there are bins");
    let share = |key: &str| all[key].as_f64().unwrap_or_else(|| panic!("{key} in {report}"));
    assert!(share("measured") >= 0.98 * share("eligible"), "{report}\n{output}");
    let position_mm = &all["published"]["position_mm"];
    let [median, worst] = ["median", "worst"].map(|key| position_mm[key].as_f64());
    assert!(median.is_some_and(|mm| mm < 1.0), "it is learned: {report}\n{output}");
    assert!(worst.is_some_and(|mm| (5.0..9.0).contains(&mm)), "not at once: {report}");
    // The deviations say both, before and after.
    let nees = report["nees"]["measurements"]["position"]["mean"].as_f64();
    assert!(nees.is_some_and(|nees| (0.5..4.0).contains(&nees)), "{report}");
    assert_eq!(report["false_poses"].as_u64(), Some(0), "{report}");
}

#[test]
fn a_stereographic_camera_flies() {
    assert_sound(&fly("stereographic", STEREOGRAPHIC, &[]));
}

#[test]
fn a_measured_response_is_followed() {
    // Far from any usual curve: dark codes stand for nearly as much light as bright ones.
    let table = "camera.response_table=[0, 0.5, 0.8, 0.95, 1]";
    let flown = fly("response", STITCHED, &["camera.response=table", table]);
    assert_sound(&flown);
}

#[test]
fn behind_a_mask_nothing_is_searched() {
    let scratch = Scratch::new("mask");
    let path = scratch.path("mask.png");
    write_mask(&path, 2048, 1024, 0);
    let mask = format!("camera.mask={}", path.display());
    let (report, output) = fly("masked", STITCHED, &[&mask]);
    assert_eq!(report["measured"].as_u64(), Some(0), "{report}");
    assert!(output.contains("12 of 12 partitions are never searched"), "{output}");
    assert!(output.contains("0 views searched"), "{output}");
}

#[test]
fn a_mask_of_another_size_stops_the_start() {
    let scratch = Scratch::new("small-mask");
    let path = scratch.path("mask.png");
    write_mask(&path, 100, 50, 255);
    let mask = format!("camera.mask={}", path.display());
    for command in ["up", "check"] {
        let (succeeded, output) = run(&[command, "--set", &mask]);
        assert!(!succeeded, "{output}");
        for part in ["camera.mask", "mask.png", "100x50", "3840x1920"] {
            assert!(output.contains(part), "{command} must say {part:?}:\n{output}");
        }
    }
}

fn write_mask(path: &std::path::Path, width: u32, height: u32, grey: u8) {
    let file = std::fs::File::create(path).expect("a temporary file can be made");
    let mut encoder = png::Encoder::new(file, width, height);
    encoder.set_color(png::ColorType::Grayscale);
    let mut writer = encoder.write_header().expect("a header can be written");
    let pixels = vec![grey; width as usize * height as usize];
    writer.write_image_data(&pixels).expect("pixels can be written");
}
