//! The reference recordings, made by another renderer than ours and by real cameras.
//!
//! They lie beside the repository; where they do not, these tests say so and pass.

use std::path::{Path, PathBuf};
use std::time::Duration;

use flockeye_lab::evaluation::Evaluation;
use flockeye_tables::{PoseRow, read};
use flockeye_tests::{Flight, Scratch, recordings, run};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion, Vector2, Vector3};

/// A flight of 300 frames of 3840x1920 on loaded cores.
const LONG_WATCHDOG: Duration = Duration::from_secs(480);

/// Flies over a recording, each of its frames worked on, and gives the poses of its bodies.
fn fly(name: &str, source: &Path, bodies: &Path, set: &[&str]) -> (Vec<PoseRow>, String) {
    fly_with(name, None, source, bodies, set)
}

/// Flies as [`fly`] does, with a configuration file.
fn fly_with(
    name: &str,
    configuration: Option<&Path>,
    source: &Path,
    bodies: &Path,
    set: &[&str],
) -> (Vec<PoseRow>, String) {
    let scratch = Scratch::new(name);
    let poses = scratch.path("out.csv");
    let [source, bodies, out] =
        [source, bodies, &poses].map(|path| path.to_str().expect("a plain path"));
    let arguments = ["--source", source, "--bodies", bodies, "--profile", "repeat", "--poses", out];
    let configuration = configuration.map(|path| path.to_str().expect("a plain path"));
    let arguments: Vec<&str> = configuration.into_iter().chain(arguments).collect();
    let set: Vec<&str> = set.iter().copied().chain(["gateway.enabled=false"]).collect();
    let mut flight = Flight::start(name, &arguments, &set);
    assert!(flight.wait_for_end(LONG_WATCHDOG).success(), "{}", flight.output());
    flight.assert_nothing_left();
    (read(&poses).expect("the poses are there"), flight.output())
}

fn judge(poses: &[PoseRow], truth: &Path) -> Evaluation {
    let evaluation = Evaluation::of(poses, &read(truth).expect("the truth is there"));
    println!("{evaluation}");
    evaluation
}

#[test]
fn the_recorded_flight_is_followed_as_promised() {
    let Some(data) = recordings() else { return };
    let video = data.join("flight1/flight1.mp4");
    let (poses, output) = fly("flight1", &video, &data.join("bodies.json"), &[]);
    assert!(output.contains("300 frames searched, 0 skipped"), "{output}");
    let evaluation = judge(&poses, &data.join("flight1/truth.csv"));
    // (from, to), share, median, 95 %: distances in metres, errors in millimetres.
    assert_reached(&evaluation, (0.0, 1.5), 0.97, 1.0, 4.0);
    assert_reached(&evaluation, (1.5, 2.4), 0.98, 2.5, 10.0);
    let rotation =
        evaluation.everything().and_then(|all| all.published).expect("seen").rotation_deg;
    assert!(rotation.median <= 0.2, "rotations are off by {} degrees", rotation.median);
    assert_eq!(evaluation.false_poses, 0, "{:?}", evaluation.false_at);
}

/// At least `share` of the eligible bodies between two distances were measured, with errors no
/// larger than these.
fn assert_reached(
    evaluation: &Evaluation,
    (from_m, to_m): (f64, f64),
    share: f64,
    median_mm: f64,
    p95_mm: f64,
) {
    let bin = evaluation.between(from_m, to_m).expect("there is such a range");
    let which = format!("from {from_m} to {to_m} m");
    assert!(bin.eligible > 0, "the truth has nobody {which}");
    let measured = bin.measured as f64 / bin.eligible as f64;
    assert!(measured >= share, "{which} only {:.1} % are measured", 100.0 * measured);
    let error = bin.published.expect("some are measured").position_mm;
    assert!(error.median <= median_mm, "{which} the median error is {:.2} mm", error.median);
    assert!(error.p95 <= p95_mm, "{which} 95 % of the errors are below {:.2} mm", error.p95);
}

#[test]
fn unrelated_stills_give_no_false_pose() {
    let Some(data) = recordings() else { return };
    let images = data.join("stills/images");
    let bodies = data.join("bodies.json");
    let (poses, output) = fly("stills", &images, &bodies, &["profile=stills"]);
    assert!(output.contains("20 frames searched, 0 skipped"), "{output}");
    let evaluation = judge(&poses, &data.join("stills/truth.csv"));
    // A handful of bodies: 95 % is the worst of them.
    assert_reached(&evaluation, (0.0, 1.5), 0.93, 1.0, 5.0);
    assert_reached(&evaluation, (1.5, 2.2), 0.9, 3.0, 10.0);
    assert_eq!(evaluation.false_poses, 0, "{:?}", evaluation.false_at);
    // The stills have nothing to do with each other: nobody is carried from one to the next.
    assert_eq!(evaluation.coasted.count, 0);
}

/// A board of tags before a fisheye with a published calibration, which states no error. Its residuals
/// at the board's saddle points are 0.09 to 0.26 px.
#[test]
fn poses_behind_a_real_fisheye_are_off_by_what_they_state() {
    let Some(data) = recordings() else { return };
    let folder = data.join("real/tumvi");
    let lens = folder.join("lens.yaml");
    let truth = std::fs::read_to_string(folder.join("truth.csv")).expect("the truth is there");
    let truth: Vec<Isometry3<f64>> = truth.lines().skip(1).map(true_pose).collect();
    let (learned, contradicted) = ("1.0 is used from now on", "but the configuration states 2.2");
    let with_residuals = "camera.lens_error_px=0.2";
    // Nothing is told, or the residuals of the lens. Then nobody says that the camera is linear, or
    // somebody does so wrongly, or rightly. By default this lens is taken for a worse one, so rotations
    // are stated cautiously.
    for (told, response, says, least) in [
        ("camera.lens_error_px=", "camera.response=", Some(learned), 0.2),
        (with_residuals, "camera.response=", Some(learned), 0.3),
        (with_residuals, "camera.response=srgb", Some(contradicted), 0.3),
        (with_residuals, "camera.response=linear", None, 0.3),
    ] {
        let (images, bodies) = (folder.join("images"), folder.join("bodies.json"));
        let set = ["profile=stills", told, response];
        let (poses, output) = fly_with("tumvi", Some(&lens), &images, &bodies, &set);
        match says {
            Some(says) => assert!(output.contains(says), "{response}: {output}"),
            None => assert!(!output.contains("the bodies' print shows"), "{output}"),
        }
        assert_eq!(poses.len(), truth.len(), "{output}");
        let mut nees = Vector2::zeros();
        for row in &poses {
            let truth = truth[row.frame as usize];
            let (position, turn) = (
                row.position - truth.translation.vector,
                (row.orientation * truth.rotation.inverse()).scaled_axis(),
            );
            let covariance = row.covariance.expect("it was recorded");
            let squared = |error: Vector3<f64>, at: usize| {
                let inverse = covariance.fixed_view::<3, 3>(at, at).try_inverse();
                error.dot(&(inverse.expect("a covariance") * error))
            };
            nees += Vector2::new(squared(position, 0), squared(turn, 3)) / poses.len() as f64;
        }
        println!("{told} {response}: NEES of position and rotation {nees}");
        // 3 is right. Without the lens's error the position has 10 to 120.
        assert!(nees.max() < 4.0 && nees.min() > least, "{told} {response}: {nees}");
    }
}

/// The pose in columns 3 to 9: x, y, z, then w, x, y, z.
fn true_pose(line: &str) -> Isometry3<f64> {
    let number = |text: &str| text.parse().expect("a number");
    let columns: Vec<f64> = line.split(',').skip(3).take(7).map(number).collect();
    let &[x, y, z, qw, qx, qy, qz] = columns.as_slice() else { panic!("seven columns: {line}") };
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(qw, qx, qy, qz));
    Isometry3::from_parts(Translation3::new(x, y, z), rotation)
}

/// The lens of these pictures is off by 0.3 to 1 pixel. Then corners fit no square.
#[test]
fn a_single_tag_behind_a_wrong_lens_has_a_pose() {
    let Some(data) = recordings() else { return };
    let folder = data.join("real/turntable/rotation");
    let lens = folder.join("lens.yaml");
    let scratch = Scratch::new("tag");
    let bodies = scratch.path("bodies.json");
    const TAG: &str = r#"{"dictionary": "DICT_APRILTAG_36h11", "bodies": {"tag": {"markers": [
        {"id": 76, "normal": [0, 0, 1], "corners": [[-0.0325, 0.0325, 0], [0.0325, 0.0325, 0],
        [0.0325, -0.0325, 0], [-0.0325, -0.0325, 0]]}]}}}"#;
    std::fs::write(&bodies, TAG).expect("it can be written");
    let images = folder.join("images");
    let (poses, output) = fly_with("tag", Some(&lens), &images, &bodies, &["profile=stills"]);
    // 5 without the lens's error.
    assert!(poses.len() >= 13, "{} of 15:\n{output}", poses.len());
}

/// The equirectangular pictures of real cameras, with their sizes; the other pictures beside them
/// are single lenses and other projections.
const REAL: [(&str, u32, u32); 3] = [
    ("real/theta_s/eqrect_example.png", 1920, 960),
    ("real/theta_s/eqrect_example_good.png", 1920, 960),
    ("real/panorama/examplepano.jpg", 4096, 2048),
];

#[test]
fn real_pictures_without_a_neighbour_give_no_pose_at_all() {
    let Some(data) = recordings() else { return };
    for (picture, width, height) in REAL {
        let file = data.join(picture);
        let folder = Scratch::new("picture");
        let name: PathBuf = file.file_name().expect("a file").into();
        std::fs::copy(&file, folder.path(&name.to_string_lossy())).expect("it can be copied");
        let (width, height) = (format!("camera.width={width}"), format!("camera.height={height}"));
        let set = ["profile=stills", width.as_str(), height.as_str()];
        let (poses, output) = fly("real", &folder.path(""), &data.join("bodies.json"), &set);
        assert!(output.contains("1 frames searched, 0 skipped"), "{picture}:\n{output}");
        assert_eq!(poses, [], "{picture} shows nobody");
        println!("{picture}: no pose, as it should be");
    }
}

#[test]
fn opencv_finds_no_marker_on_photographs_that_ours_does_not_find() {
    let Some(data) = recordings() else { return };
    let text = |path: &Path| path.to_str().expect("a text").to_owned();
    let compare = |folder: &Path, dictionary: &str| {
        let folder = text(folder);
        let photographs = ["--photographs", &folder, "--dictionary", dictionary];
        run(&[&["experiment", "detectors", "--json"], &photographs[..]].concat())
    };
    let folder = data.join("real/opencv_aruco");
    let own_dictionary = text(&folder.join("tutorial_dict.yml"));
    for (dictionary, least) in [(own_dictionary.as_str(), 50), ("DICT_6X6_250", 20)] {
        let (succeeded, output) = compare(&folder, dictionary);
        assert!(succeeded, "{output}");
        let json = output.lines().find(|line| line.starts_with('{')).expect("one object");
        let found: serde_json::Value = serde_json::from_str(json).expect("JSON");
        let found = &found["photographs"];
        assert_eq!(found["opencv_alone"], serde_json::json!([]), "{dictionary}");
        let ours = |counts: &serde_json::Value| {
            ["both", "ours_alone"]
                .map(|who| counts[who].as_u64().expect("a count"))
                .iter()
                .sum::<u64>()
        };
        let ours: u64 = found["by_size"].as_object().expect("by size").values().map(ours).sum();
        assert!(ours >= least, "{dictionary}: {output}");
    }
    let (succeeded, output) = compare(&data.join("flight4"), "DICT_6X6_250");
    assert!(!succeeded && output.contains("holds no photograph. Cure:"), "{output}");
}
