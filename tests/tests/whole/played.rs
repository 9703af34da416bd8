//! Recordings of flights are played: their frames come as they did, and the stages say what they
//! said.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use flockeye_contract::{FrameEnds, FrameHeader, FrameStamp, ImuSample, Rotation, RotationSource};
use flockeye_recording::ContractMessage;
use flockeye_recording::RecordingReader;
use flockeye_recording::channel::FRAME_IMAGES;
use flockeye_recording::images::decode_compressed;
use flockeye_tables::{PoseRow, read};
use flockeye_tests::{Flight, SMALL_FLIGHT, Scratch, WATCHDOG, onlooker, run};
use gstreamer as gst;
use rustix::process::Signal;
use serde_json::Value;

use crate::bad_input::make;
use crate::python::python;
use crate::recording;

/// An observer in gusts with an inertial sensor.
const GUSTS: &[&str] = &[
    "camera.width=2048",
    "camera.height=1024",
    "simulator.distance_m=[0.6, 0.8]",
    "camera.exposure_ms=6.25",
    "simulator.exposure_ms=6.25",
    "simulator.tilt_deg=12",
    "simulator.yaw_swing_deg_s=40",
    "simulator.frames=40",
];

fn text(path: &Path) -> &str {
    path.to_str().expect("a plain path")
}

/// The only file in a folder.
fn only_file(folder: &Path) -> PathBuf {
    let files = std::fs::read_dir(folder).expect("it was made");
    let mut files: Vec<PathBuf> = files.map(|file| file.expect("it is there").path()).collect();
    assert_eq!(files.len(), 1, "{files:?}");
    files.remove(0)
}

/// A lossless flight to its end, which is recorded. Returns the recording, and what was said.
fn fly(name: &str, folder: &Path, arguments: &[&str], set: &[&str]) -> (PathBuf, String) {
    let folder_setting = format!("recording.folder={}", folder.display());
    let set: Vec<&str> = set.iter().copied().chain([folder_setting.as_str()]).collect();
    let arguments: Vec<&str> = ["--profile", "repeat"].iter().chain(arguments).copied().collect();
    let mut flight = Flight::start(name, &arguments, &set);
    assert!(flight.wait().success(), "{}", flight.output());
    let said = flight.output();
    assert!(said.contains("nothing is missing"), "{said}");
    flight.assert_nothing_left();
    (only_file(folder), said)
}

/// The headers of frames, without what differs from run to run.
fn frames(path: &Path) -> Vec<FrameHeader> {
    let timeless = |message: &ContractMessage| {
        let header: FrameHeader = bytemuck::pod_read_unaligned(&message.header);
        FrameHeader { stamp: FrameStamp { published_ns: 0, ..header.stamp }, ..header }
    };
    recording::read(path, "flockeye/frame").0.iter().map(timeless).collect()
}

/// The JPEGs of a recording.
fn pictures(path: &Path) -> Vec<Vec<u8>> {
    let mut reader = RecordingReader::open(path).unwrap_or_else(|error| panic!("{error}"));
    let mut found = Vec::new();
    while let Some(message) = reader.next_message().unwrap_or_else(|error| panic!("{error}")) {
        if message.channel.topic == FRAME_IMAGES {
            let image = decode_compressed(FRAME_IMAGES, &message.bytes).expect("a picture");
            found.push(image.bytes.to_vec());
        }
    }
    found
}

fn samples(path: &Path) -> Vec<[u64; 7]> {
    let of = |sample: ImuSample| {
        let [x, y, z] = sample.rate.map(f64::to_bits);
        let [u, v, w] = sample.specific_force.map(f64::to_bits);
        [sample.at_ns.cast_unsigned(), x, y, z, u, v, w]
    };
    let items = |message: &ContractMessage| {
        let items = message.items.chunks_exact(size_of::<ImuSample>());
        items.map(|bytes| of(bytemuck::pod_read_unaligned(bytes))).collect::<Vec<_>>()
    };
    recording::read(path, "flockeye/imu").0.iter().flat_map(items).collect()
}

/// Frames with a rotation that the inertial sensor has a part in.
fn with_inertial(path: &Path) -> usize {
    let both = RotationSource::PictureAndInertial.code();
    let is_both = |message: &&ContractMessage| {
        bytemuck::pod_read_unaligned::<Rotation>(&message.header).source == both
    };
    recording::read(path, "flockeye/rotation").0.iter().filter(is_both).count()
}

/// A simulated flight with an inertial sensor is recorded with all its frames, and played. Stamps
/// and samples are the same bit by bit. Poses differ by no more than the noise of JPEG.
#[test]
fn a_recorded_flight_is_flown_again() {
    let scratch = Scratch::new("played");
    let [first_poses, second_poses] = ["one.csv", "two.csv"].map(|name| scratch.path(name));
    let set = [SMALL_FLIGHT, GUSTS].concat();
    let flown = [&set[..], &["inertial.source=sim", "recording.frames=every", "recording.every=1"]];
    let poses = ["--poses", text(&first_poses)];
    let (recording, _) = fly("flown", &scratch.path("flown"), &poses, &flown.concat());
    let played = [&set[..], &["inertial.source=recording"]].concat();
    let arguments = ["--source", text(&recording), "--poses", text(&second_poses)];
    let (again, said) = fly("played", &scratch.path("played"), &arguments, &played);
    assert!(said.contains("the recording is complete: 40 frames"), "{said}");
    assert!(said.contains("Cure: fusion.coding: images"), "its pictures are JPEGs: {said}");

    let stamps = frames(&recording);
    assert_eq!(stamps.len(), 40);
    assert_eq!(frames(&again), stamps);
    let measured = samples(&recording);
    assert!(measured.len() > 200, "{}", measured.len());
    assert_eq!(samples(&again), measured);
    let both = [&recording, &again].map(|path| with_inertial(path));
    assert!(both[0] > 10 && both[1] > 10, "{both:?}");

    let [first, second] = [&first_poses, &second_poses]
        .map(|path| read::<PoseRow>(path).expect("the poses are there"));
    let (mut off_mm, mut off_deg) = (Vec::new(), Vec::new());
    for one in &first {
        let same = |other: &&PoseRow| other.frame == one.frame && other.target == one.target;
        let Some(other) = second.iter().find(same) else { continue };
        assert_eq!(one.stamp_s.to_bits(), other.stamp_s.to_bits(), "frame {}", one.frame);
        off_mm.push(1e3 * (one.position - other.position).norm());
        off_deg.push(one.orientation.angle_to(&other.orientation).to_degrees());
    }
    for values in [&mut off_mm, &mut off_deg] {
        values.sort_by(f64::total_cmp);
    }
    println!(
        "{} and {} poses; mm: {off_mm:.3?}; degrees: {off_deg:.3?}",
        first.len(),
        second.len()
    );
    assert!(first.len() > 35 && off_mm.len() + 3 >= first.len(), "{}", off_mm.len());
    let (median, most) = (off_mm.len() / 2, off_mm.len() - 1);
    assert!(off_mm[median] < 1.0 && off_mm[most] < 5.0, "{off_mm:?}");
    assert!(off_deg[median] < 0.3 && off_deg[most] < 1.5, "{off_deg:?}");

    // In real time, over and over.
    let looping = [&played[..], &["source.at_end=loop", "fusion.coding=images"]].concat();
    let mut flight = Flight::with_poses("replayed-rt", &["--source", text(&recording)], &looping);
    std::thread::sleep(Duration::from_secs(3));
    flight.signal(Signal::INT);
    assert!(flight.wait().success(), "{}", flight.output());
    for unsaid in ["is started again", "fusion.coding"] {
        assert!(!flight.output().contains(unsaid), "{}", flight.output());
    }
    flight.assert_nothing_left();

    // Recordings without pictures of frames cannot be played.
    let (is_well, said) = run(&["up", "--profile", "repeat", "--source", text(&again)]);
    assert!(!is_well, "{said}");
    assert!(said.contains("has no pictures of frames: it has headers alone"), "{said}");
    assert!(said.contains("Cure: record with --frames 'every 1'"), "{said}");
    let arguments = ["up", "--profile", "repeat", "--source", text(&recording)];
    let (is_well, said) = run(&[&arguments[..], &["--set", "gateway.enabled=false"]].concat());
    assert!(!is_well, "{said}");
    assert!(said.contains("set camera.width to 2048 and camera.height to 1024"), "{said}");
}

/// A video's own packets are recorded, and give the same pixels when they are played: the
/// recorder's JPEGs of both are the same bytes.
#[test]
fn a_videos_own_packets_give_the_same_pixels() {
    gst::init().expect("GStreamer is installed");
    const RAW: &str = "videotestsrc num-buffers=40 pattern=ball ! \
                       video/x-raw,format=I420,width=256,height=128,framerate=30/1";
    let camera = ["camera.width=256", "camera.height=128", "gateway.enabled=false"];
    let jpegs = [&camera[..], &["recording.frames=every", "recording.every=1"]].concat();
    let packets = [&camera[..], &["recording.frames=camera"]].concat();
    // The second has frames that rest on later ones.
    for (format, file, encoder) in [
        ("h264", "clip.mp4", "openh264enc gop-size=10 ! h264parse ! mp4mux"),
        (
            "h265",
            "clip.mkv",
            "x265enc speed-preset=ultrafast key-int-max=10 ! h265parse ! matroskamux",
        ),
    ] {
        let scratch = Scratch::new("packets");
        let clip = scratch.path(file);
        make(&format!("{RAW} ! {encoder}"), &clip);
        let fly = |name: &str, source: &Path, set: &[&str]| {
            let (recording, said) =
                fly(name, &scratch.path(name), &["--source", text(source)], set);
            assert!(!said.contains("fusion.coding"), "it is video: {said}");
            recording
        };
        let truth = fly("decoded", &clip, &jpegs);
        let video = fly("packets", &clip, &packets);
        let played = fly("again", &video, &jpegs);
        assert_eq!(frames(&truth).len(), 40);
        assert_eq!(frames(&video), frames(&truth));
        assert_eq!(frames(&played), frames(&truth));
        let [one, other] = [&truth, &played].map(|path| pictures(path));
        assert_eq!((one.len(), other.len()), (40, 40));
        assert!(one.windows(2).any(|pair| pair[0] != pair[1]), "the pictures differ");
        assert!(one == other, "{format}: the same bytes of JPEG");

        let Some(python) = python() else { continue };
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/src/video.py");
        let read = Command::new(python).arg(script).arg(&video).arg(format).output();
        let read = read.expect("Python can be started");
        let said = String::from_utf8_lossy(&read.stdout).into_owned();
        assert!(read.status.success(), "{said}\n{}", String::from_utf8_lossy(&read.stderr));
        let report: Value = serde_json::from_str(said.trim()).expect("one JSON object");
        assert_eq!(report["packets"], 40, "{report}");
        assert!(report["key"].as_u64() >= Some(4), "{report}");
    }
}

/// Waits until frames are worked on.
fn wait_for_frames(flight: &mut Flight) {
    let mut ports = onlooker::join(flight);
    let mut ends = onlooker::subscribe::<FrameEnds>(flight, &mut ports);
    let start = Instant::now();
    while ends.receive().expect("it can be read").is_none() {
        assert!(start.elapsed() < WATCHDOG, "no frame comes:\n{}", flight.output());
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// A recorder that joins in flight begins with a key frame; where there is no video, it says what
/// to do.
#[test]
fn a_camera_without_video_is_refused_and_one_with_it_is_joined_in_flight() {
    gst::init().expect("GStreamer is installed");
    let scratch = Scratch::new("no-packets");
    let raw = "videotestsrc is-live=true pattern=ball ! \
               video/x-raw,format=I420,width=256,height=128,framerate=20/1";
    let small = ["camera.width=256", "camera.height=128", "gateway.enabled=false"];
    let ended = |name: &str, source: &str, set: &[&str]| {
        let mut flight = Flight::start(name, &["--source", source], set);
        wait_for_frames(&mut flight);
        let out = scratch.path(&format!("{name}.mcap"));
        let name = flight.instance.name().to_owned();
        let arguments =
            ["record", text(&out), "--frames", "camera", "--for", "3s", "--instance", &name];
        let (is_well, said) = run(&arguments);
        flight.end_by(Signal::INT);
        (is_well, said, out)
    };
    let (is_well, said, out) = ended("sim-packets", "sim", SMALL_FLIGHT);
    assert!(!is_well && said.contains("source sim: "), "{said}");
    assert!(said.contains("Cure: --frames 'every 1'") && !out.exists(), "{said}");
    let mjpeg = format!("{raw} ! jpegenc");
    let (is_well, said, _) = ended("mjpeg-packets", &mjpeg, &small);
    assert!(!is_well && said.contains("Cure: --frames 'every 1'"), "{said}");
    // A recorder of the pipeline's own is not started over and over.
    let folder = scratch.path("mjpeg");
    let setting = format!("recording.folder={}", folder.display());
    let set = [&small[..], &["recording.frames=camera", setting.as_str()]].concat();
    let mut flight = Flight::start("mjpeg-own", &["--source", &mjpeg], &set);
    flight.wait_for("the recorder cannot record, and is not started again");
    wait_for_frames(&mut flight);
    flight.signal(Signal::INT);
    assert!(flight.wait().success(), "{}", flight.output());
    assert!(!flight.output().contains("the recorder is started again"), "{}", flight.output());
    for said in ["decoded by ", "no video is decoded here"] {
        assert!(flight.output().contains(said), "{}", flight.output());
    }
    only_file(&folder);
    flight.assert_nothing_left();
    let h264 = format!("{raw} ! openh264enc gop-size=10 ! h264parse");
    let (is_well, said, out) = ended("h264-packets", &h264, &small);
    assert!(is_well, "{said}");
    let (is_well, said) =
        run(&["check", "--set", "recording.folder=x", "--set", "recording.frames=camera"]);
    assert!(!is_well && said.contains("source.input: sim has no coded video"), "{said}");

    let arguments = ["--source", text(&out)];
    let jpegs = [&small[..], &["recording.frames=every", "recording.every=1"]].concat();
    let (played, _) = fly("h264-again", &scratch.path("again"), &arguments, &jpegs);
    let numbers: Vec<u64> = frames(&played).iter().map(|frame| frame.stamp.sequence).collect();
    assert!(numbers.len() > 20 && numbers[0] > 0, "{numbers:?}");
    // Frames that were not published are left out again, and all others come.
    let recorded: Vec<u64> = frames(&out).iter().map(|frame| frame.stamp.sequence).collect();
    assert!(recorded.ends_with(&numbers) || numbers.len() + 2 >= recorded.len(), "{recorded:?}");
}
