//! What the user is told when a file, a recording or the machine is not as it should be.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use flockeye_config::Pipeline;
use flockeye_tables::{PoseRow, TruthRow, read};
use flockeye_tests::{
    Flight, SMALL_FLIGHT, Scratch, WATCHDOG, absent, flockeye, run, succeeds, unique,
};
use gstreamer as gst;
use gstreamer::prelude::*;

/// Size of the recordings made here.
const SMALL_CAMERA: [&str; 3] = ["camera.width=256", "camera.height=128", "gateway.enabled=false"];

/// A path as an argument.
fn text(path: &Path) -> &str {
    path.to_str().expect("temporary paths are plain")
}

/// Runs a GStreamer pipeline to its end, into `file`.
pub(crate) fn make(description: &str, file: &Path) {
    gst::init().expect("GStreamer is installed");
    let description = format!("{description} ! filesink location=\"{}\"", file.display());
    let pipeline = gst::parse::launch(&description).expect("all of its plugins are installed");
    pipeline.set_state(gst::State::Playing).expect("it starts");
    let message = pipeline.bus().expect("pipelines have one").timed_pop_filtered(
        gst::ClockTime::from_seconds(WATCHDOG.as_secs()),
        &[gst::MessageType::Eos, gst::MessageType::Error],
    );
    pipeline.set_state(gst::State::Null).expect("it stops");
    let message = message.expect("it ends");
    assert_eq!(message.type_(), gst::MessageType::Eos, "{description}: {message:?}");
}

/// A recording of this many frames and this size.
fn record(frames: u32, (width, height): (u32, u32), file: &Path) {
    let raw = format!("video/x-raw,format=I420,width={width},height={height},framerate=30/1");
    let source = format!("videotestsrc num-buffers={frames} pattern=ball ! {raw}");
    make(&format!("{source} ! openh264enc gop-size=5 ! h264parse ! matroskamux"), file);
}

/// An image of this size.
fn photograph((width, height): (u32, u32), file: &Path) {
    let raw = format!("video/x-raw,width={width},height={height}");
    make(
        &format!("videotestsrc num-buffers=1 pattern=smpte ! {raw} ! videoconvert ! pngenc"),
        file,
    );
}

/// Flies over a source to the end: the flight, whether it succeeded, and what was said.
fn fly_over(name: &str, source: &Path, set: &[&str]) -> (bool, String) {
    let set: Vec<&str> = SMALL_CAMERA.iter().chain(set).copied().collect();
    let arguments = ["--profile", "repeat", "--source", text(source)];
    let mut flight = Flight::start(name, &arguments, &set);
    let status = flight.wait();
    assert!(flight.stages("").is_empty());
    flight.assert_nothing_left();
    (status.success(), flight.output())
}

fn assert_says(output: &str, parts: &[&str]) {
    for part in parts {
        assert!(output.contains(part), "{part:?} is missing in:\n{output}");
    }
}

#[test]
fn a_malformed_configuration_is_refused_with_line_and_column() {
    let scratch = Scratch::new("malformed");
    let file = scratch.path("pipeline.yaml");
    for (yaml, wanted) in [
        ("camera:\n  widht: 3840\n", &["line 2, column 3", "did you mean 'width'?"][..]),
        ("profile: flight\ncamera: [1, 2\n", &["line ", "column ", "not YAML"]),
        ("camera: {width: wide}\n", &["line 1, column 17", "must be a whole number"]),
    ] {
        std::fs::write(&file, yaml).expect("it can be written");
        for command in ["up", "check"] {
            let (succeeded, output) = run(&[command, text(&file)]);
            assert!(!succeeded, "{command} takes {yaml:?}:\n{output}");
            assert_says(&output, wanted);
            assert_says(&output, &["pipeline.yaml has a problem"]);
        }
    }
}

#[test]
fn a_configuration_that_contradicts_itself_is_refused_with_all_its_problems() {
    let scratch = Scratch::new("senseless");
    let file = scratch.path("pipeline.yaml");
    let yaml = "camera:\n  width: 3840\n  height: 2160\nsimulator:\n  neighbours: 3\n";
    std::fs::write(&file, yaml).expect("it can be written");
    for command in ["up", "check"] {
        let (succeeded, output) = run(&[command, text(&file)]);
        assert!(!succeeded, "{output}");
        let wanted =
            ["2 problems", "line 2, column 10", "3840x2160", "line 5, column 15", "3 neighbours"];
        assert_says(&output, &wanted);
    }
}

#[test]
fn a_configuration_that_is_not_there_is_named() {
    for command in ["up", "check"] {
        let (succeeded, output) = run(&[command, "/nowhere/pipeline.yaml"]);
        assert!(!succeeded, "{output}");
        assert_says(&output, &["cannot read /nowhere/pipeline.yaml: No such file"]);
    }
}

#[test]
fn a_video_that_is_not_there_ends_the_start() {
    let scratch = Scratch::new("gone");
    let (succeeded, output) = fly_over("gone", &scratch.path("gone.mp4"), &[]);
    assert!(!succeeded, "{output}");
    assert_says(
        &output,
        &["gone.mp4 does not exist. Cure: check the path", "capture cannot start"],
    );
}

#[test]
fn a_text_that_is_called_a_video_is_refused() {
    let scratch = Scratch::new("text");
    let file = scratch.path("flight.mp4");
    std::fs::write(&file, "frame,t_s,body\n0,0.0,alpha\n").expect("it can be written");
    let (succeeded, output) = fly_over("text", &file, &[]);
    assert!(!succeeded, "{output}");
    assert_says(&output, &["flight.mp4 is not a video", "capture cannot start"]);
}

#[test]
fn a_video_that_was_cut_short_is_searched_as_far_as_it_goes() {
    let scratch = Scratch::new("cut");
    let (whole, cut) = (scratch.path("whole.mkv"), scratch.path("cut.mkv"));
    record(30, (256, 128), &whole);
    let bytes = std::fs::read(&whole).expect("it was made");
    std::fs::write(&cut, &bytes[..bytes.len() * 6 / 10]).expect("it can be written");
    let (succeeded, output) = fly_over("cut", &cut, &[]);
    assert!(succeeded, "{output}");
    assert_says(&output, &["WARN", "the recording broke off after", "cut short"]);
    let searched: u64 = output
        .lines()
        .find_map(|line| line.split_once(" frames searched").and_then(|(n, _)| n.parse().ok()))
        .unwrap_or_else(|| panic!("no summary in:\n{output}"));
    assert!((1..30).contains(&searched), "{searched} frames of a part of 30:\n{output}");
}

#[test]
fn a_video_of_another_size_is_refused_with_both_sizes() {
    let scratch = Scratch::new("size");
    let file = scratch.path("flight.mkv");
    record(5, (320, 160), &file);
    let (succeeded, output) = fly_over("size", &file, &[]);
    assert!(!succeeded, "{output}");
    let wanted =
        ["320x160, 256x128 were expected", "set camera.width to 320 and camera.height to 160"];
    assert_says(&output, &wanted);
}

#[test]
fn an_image_of_another_size_is_named_and_the_others_are_searched() {
    let scratch = Scratch::new("mixed");
    for (name, size) in [("a.png", (256, 128)), ("b.png", (320, 160)), ("c.png", (256, 128))] {
        photograph(size, &scratch.path(name));
    }
    let (succeeded, output) = fly_over("mixed", &scratch.path(""), &["profile=stills"]);
    assert!(succeeded, "{output}");
    assert_says(&output, &["b.png is left out", "320x160", "\n2 frames searched, 1 skipped"]);
    assert!(!output.contains("a.png is left out") && !output.contains("c.png is left out"));
}

#[test]
fn a_folder_without_images_ends_the_start() {
    let scratch = Scratch::new("empty");
    let (succeeded, output) = fly_over("empty", &scratch.path(""), &[]);
    assert!(!succeeded, "{output}");
    assert_says(&output, &["holds no image. Cure: put .jpg, .jpeg or .png files in it"]);
}

/// A bodies file of plates with one marker each.
fn bodies(plates: &[(&str, u32)]) -> String {
    let plate = |&(name, id): &(&str, u32)| {
        let corners = serde_json::json!([
            [0.0, 0.025, 0.025],
            [0.0, -0.025, 0.025],
            [0.0, -0.025, -0.025],
            [0.0, 0.025, -0.025]
        ]);
        (name.to_owned(), serde_json::json!({ "markers": [{ "id": id, "corners": corners }] }))
    };
    let bodies: serde_json::Map<_, _> = plates.iter().map(plate).collect();
    serde_json::json!({ "dictionary": "DICT_5X5_250", "bodies": bodies }).to_string()
}

#[test]
fn bodies_that_cannot_be_told_apart_are_refused() {
    let scratch = Scratch::new("bodies");
    let file = scratch.path("bodies.json");
    std::fs::write(&file, bodies(&[("kite", 5), ("wren", 5)])).expect("it can be written");
    for command in ["up", "check"] {
        let (succeeded, output) = run(&[command, "--bodies", text(&file)]);
        assert!(!succeeded, "{output}");
        assert_says(&output, &["bodies.json", "marker id 5 belongs to 'kite' and to 'wren'"]);
    }
    // The same file is fine once they differ.
    std::fs::write(&file, bodies(&[("kite", 5), ("wren", 6)])).expect("it can be written");
    succeeds(&["check", "--bodies", text(&file)]);
}

#[test]
fn a_bodies_file_that_is_broken_or_gone_is_refused() {
    let scratch = Scratch::new("broken");
    let file = scratch.path("bodies.json");
    let whole = bodies(&[("kite", 5)]);
    std::fs::write(&file, &whole[..whole.len() / 2]).expect("it can be written");
    let gone = scratch.path("gone.json");
    for command in ["up", "check"] {
        let (succeeded, output) = run(&[command, "--bodies", text(&file)]);
        assert!(!succeeded, "{output}");
        assert_says(&output, &["bodies.json: not a bodies file", "line 1 column"]);
        let (succeeded, output) = run(&[command, "--bodies", text(&gone)]);
        assert!(!succeeded, "{output}");
        assert_says(&output, &["cannot read the bodies file", "gone.json", "No such file"]);
    }
}

#[test]
fn a_neighbour_that_nobody_told_us_about_is_ignored() {
    let scratch = Scratch::new("stranger");
    // The world has two neighbours; all but the simulator know of one of them.
    let mut set: Vec<String> = SMALL_FLIGHT.iter().map(|&set| set.to_owned()).collect();
    set.extend(["profile=repeat".to_owned(), "simulator.frames=90".to_owned()]);
    let mut world = set.clone();
    world.push("simulator.neighbours=2".to_owned());
    let world = Pipeline::parse("", &world, "the test").expect("these are settings");
    let resolved = scratch.path("world.json");
    std::fs::write(&resolved, serde_json::to_vec(&world).expect("it is plain data"))
        .expect("it can be written");
    let simulator = flockeye().with_file_name("flockeye-simulator");
    // The source starts last, when everybody else has read the configuration.
    let script = format!(
        "cp '{}' \"$FLOCKEYE_INSTANCE_DIR/pipeline.json\" && exec '{}'",
        resolved.display(),
        simulator.display()
    );
    set.push(format!("stages.simulator.command={}", serde_json::json!(["sh", "-c", script])));
    set.push("bodies.list=[{name: alpha}]".to_owned());
    let set: Vec<&str> = set.iter().map(String::as_str).collect();
    let (poses, truth) = (scratch.path("poses.csv"), scratch.path("truth.csv"));
    let arguments = ["--poses", text(&poses), "--truth", text(&truth)];
    let mut flight = Flight::start("stranger", &arguments, &set);
    flight.assert_ends_well();
    let truths: Vec<TruthRow> = read(&truth).expect("the truth was recorded");
    let shown = truths.iter().filter(|row| row.body == "bravo" && row.localisable == 1).count();
    assert!(shown > 0, "the stranger was never to be seen");
    let poses: Vec<PoseRow> = read(&poses).expect("poses were recorded");
    assert!(poses.iter().any(PoseRow::is_measured), "nobody was found:\n{}", flight.output());
    for row in poses.iter().filter(|row| row.is_measured()) {
        assert_eq!(row.target, "alpha", "a pose of nobody:\n{}", flight.output());
        let truth =
            truths.iter().find(|truth| (truth.frame, truth.body.as_str()) == (row.frame, "alpha"));
        let off = (row.position - truth.expect("alpha flies").position()).norm();
        assert!(off < 0.3, "frame {}: {off:.3} m off, as if the stranger were alpha", row.frame);
    }
}

#[test]
fn too_little_shared_memory_is_said_before_it_is_used() {
    let small_memory = r#"mount -t tmpfs -o size=16m tmpfs /dev/shm && exec "$0" "$@""#;
    let in_private = |arguments: &[&str]| {
        let mut command = Command::new("unshare");
        command.args(["--mount", "sh", "-c", small_memory]).args(arguments);
        command
    };
    match in_private(&["true"]).output() {
        Ok(output) if output.status.success() => {}
        outcome => {
            let what = format!("a /dev/shm of our own, which root alone can mount: {outcome:?}");
            absent("namespaces", &what);
            return;
        }
    }
    for subcommand in ["up", "check"] {
        let name = unique("memory");
        let instance = format!("instance={name}");
        let program = flockeye();
        let command = in_private(&[text(&program), subcommand, "--set", &instance]);
        let mut flight = Flight::launch(&name, command);
        assert_eq!(flight.wait().code(), Some(1), "{}", flight.output());
        let output = flight.output();
        let wanted =
            ["camera 3840x1920 needs", "/dev/shm has 16 MB free. Cure: mount -o remount,size="];
        assert_says(&output, &wanted);
        flight.assert_nothing_left();
    }
}

#[test]
fn a_reader_that_goes_away_does_not_end_the_flight() {
    let scratch = Scratch::new("head");
    let truth = scratch.path("truth.csv");
    let name = unique("head");
    let mut command = Command::new(flockeye());
    command.args(["up", "--profile", "repeat", "--truth", text(&truth)]);
    let instance = format!("instance={name}");
    for assignment in SMALL_FLIGHT.iter().chain(&["simulator.frames=60", &instance]) {
        command.args(["--set", assignment]);
    }
    command.current_dir(std::env::temp_dir());
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut child = command.spawn().expect("flockeye can be started");
    let mut line = String::new();
    // The reader acts like `| head -1`: it reads one line, then closes the pipe.
    let mut reader = BufReader::new(child.stdout.take().expect("it is piped"));
    reader.read_line(&mut line).expect("there is a line");
    drop(reader);
    assert!(!line.is_empty());
    let start = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().expect("it is our child") {
            break status;
        }
        if start.elapsed() > WATCHDOG {
            child.kill().expect("it is our child");
            panic!("the flight does not end");
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    assert!(status.success(), "{status}");
    let truths: Vec<TruthRow> = read(&truth).expect("the truth was recorded");
    assert_eq!(truths.last().map(|row| row.frame), Some(59), "the flight did not go on to its end");
}
