//! `flockeye explain`: why a frame of a recording gave this pose of a neighbour, or none.

use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};
use std::process::Command;

use flockeye_contract::{BodyTruth, MeasuredBy, Track, TrackHeader, TrackState, TruthHeader};
use flockeye_recording::channel::{ChannelKind, LOSSES};
use flockeye_recording::file::RecordingFile;
use flockeye_recording::losses::{Loss, decode_loss, encode_loss};
use flockeye_recording::{RecordingReader, RecordingWriter};
use flockeye_tests::{Flight, SMALL_FLIGHT, Scratch, flockeye, run, succeeds};
use serde_json::Value;

use crate::recording::{read, text};

/// Two neighbours that come nearer and go, and a body that never flies.
const FLIGHT: &[&str] = &[
    "simulator.frames=50",
    "simulator.seed=903",
    "simulator.neighbours=2",
    "simulator.distance_m=[0.6, 4.0]",
    "bodies.list=[{name: alpha}, {name: bravo, first_id: 17}, {name: charlie, first_id: 34}]",
    "gateway.enabled=false",
];

/// Flies, and gives the recording.
fn flown(name: &str, scratch: &Scratch, arguments: &[&str], set: &[&str]) -> PathBuf {
    let folder = scratch.path("recordings");
    let setting = format!("recording.folder={}", folder.display());
    let set: Vec<&str> = set.iter().copied().chain([setting.as_str()]).collect();
    let mut flight = Flight::start(name, arguments, &set);
    flight.assert_ends_well();
    let mut files = std::fs::read_dir(folder).expect("it was made");
    files.next().expect("one recording").expect("it can be read").path()
}

/// Flies in real time. A recorder loses messages where other tests keep the processors from it for
/// long, and says so in its recording. Then it flies again.
pub(crate) fn flown_without_losses(name: &str, scratch: &Scratch, set: &[&str]) -> PathBuf {
    const FLIGHTS: usize = 4;
    for _ in 0..FLIGHTS {
        let recording = flown(name, scratch, &[], set);
        if !has_losses(&recording) {
            return recording;
        }
        std::fs::remove_file(recording).expect("it is there");
    }
    panic!("the recorder lost messages of each of {FLIGHTS} flights");
}

/// Whether the recorder says that it was too late for some messages. Those that were never sent do
/// not count.
fn has_losses(recording: &Path) -> bool {
    let mut reader = RecordingReader::open(recording).expect("it is a recording");
    while let Some(message) = reader.next_message().expect("it can be read") {
        if message.channel.topic == LOSSES {
            let (_, loss) = decode_loss(&message.bytes).expect("the recorder wrote it");
            if loss.buffer_full + loss.queue_full > 0 {
                return true;
            }
        }
    }
    false
}

/// The answer as data.
fn explained(recording: &Path, target: &str, frame: u64) -> Value {
    let mut command = Command::new(flockeye());
    command.arg("explain").arg(recording).args(["--target", target, "--json"]);
    let output = command.args(["--frame", &frame.to_string()]).output().expect("it can be started");
    let complaint = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{complaint}");
    serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {complaint}"))
}

/// A recorded track of a target, with its frame.
struct Told {
    frame: u64,
    track: Track,
}

fn told(recording: &Path) -> Vec<Told> {
    let (messages, _) = read(recording, "flockeye/track");
    let mut told = Vec::new();
    for message in messages {
        let header: TrackHeader = bytemuck::pod_read_unaligned(&message.header);
        let tracks = message.items.chunks_exact(size_of::<Track>());
        told.extend(tracks.map(|bytes| Told {
            frame: header.stamp.sequence,
            track: bytemuck::pod_read_unaligned(bytes),
        }));
    }
    told
}

fn true_position(recording: &Path, frame: u64, target: u32) -> [f64; 3] {
    let (messages, _) = read(recording, "flockeye/truth");
    let of_frame = messages.iter().find(|message| {
        let header: TruthHeader = bytemuck::pod_read_unaligned(&message.header);
        header.stamp.sequence == frame
    });
    let message = of_frame.expect("there is the truth of each frame");
    let mut bodies = message.items.chunks_exact(size_of::<BodyTruth>());
    let body = bodies.find_map(|bytes| {
        let body: BodyTruth = bytemuck::pod_read_unaligned(bytes);
        (body.target == target).then_some(body)
    });
    body.expect("it flies").observer_from_target.position
}

fn position(pose: &Value) -> [f64; 3] {
    let number = |index: usize| pose["position"][index].as_f64();
    [0, 1, 2].map(|index| number(index).unwrap_or_else(|| panic!("no position in {pose}")))
}

fn distance(one: [f64; 3], other: [f64; 3]) -> f64 {
    one.iter().zip(other).map(|(one, other)| (one - other).powi(2)).sum::<f64>().sqrt()
}

/// The answer about a frame that measured alpha, and the pose: that of its track, to the last bits.
fn explained_exactly(recording: &Path, frame: u64, track: &Track) -> (Value, [f64; 3]) {
    let said = explained(recording, "alpha", frame);
    assert_eq!(said["step"], "measured", "{said}");
    assert_eq!(said["reliance"]["is_exact"], true, "{}", said["reliance"]);
    let measured = position(&said["result"]["measured"]);
    assert!(distance(measured, track.measured_observer_from_target.position) < 1e-12, "{said}");
    (said, measured)
}

#[test]
fn a_lossless_flight_is_explained_exactly() {
    let scratch = Scratch::new("explained");
    let set = [FLIGHT, &["recording.frames=views"]].concat();
    let recording = flown("explained", &scratch, &["--profile", "repeat"], &set);
    let told = told(&recording);

    // A measured pose.
    let is_aligned = |told: &&Told| {
        told.track.target == 0
            && told.track.measured_by == MeasuredBy::Aligned.code()
            && told.frame > 20
    };
    let Told { frame, track } = told.iter().find(is_aligned).expect("alpha is measured");
    let (said, measured) = explained_exactly(&recording, *frame, track);
    let error_m = distance(measured, true_position(&recording, *frame, 0));
    let stated = said["truth"]["error"]["position_m"].as_f64().expect("the truth is recorded");
    assert!((stated - error_m).abs() < 1e-9 && error_m < 0.05, "{stated} and {error_m} m");
    let passes = said["passes"].as_array().expect("fusion was replayed");
    let published =
        passes.iter().find(|pass| pass["outcome"] == "published as the frame's measurement");
    let accepted = |pass: &&Value| {
        let mut hypotheses = pass["hypotheses"].as_array().into_iter().flatten();
        hypotheses.find(|hypothesis| hypothesis["verdict"] == "accepted").cloned()
    };
    let accepted = published.as_ref().and_then(accepted).expect("one was accepted");
    let terms = &accepted["terms"];
    let sum = ["picture", "turn", "tilt"].map(|term| terms[term].as_f64().unwrap_or_default());
    let log_odds = accepted["log_odds"].as_f64().expect("it was aligned");
    assert!((sum.iter().sum::<f64>() - log_odds).abs() < 1e-9 && log_odds > 4.0, "{accepted}");
    assert!(distance(position(&accepted["pose"]), measured) < 0.01, "{accepted}");
    assert!(said["before"]["predicted"]["range_m"].as_f64() > Some(0.5), "{}", said["before"]);
    let views = said["views"].as_array().expect("a list");
    let shows = |view: &&Value| view["region_of"] == "alpha" && view["shows_place"] == true;
    assert!(views.iter().any(|view| shows(&view) && view["is_answered"] == true), "{said}");

    // A predicted one.
    let is_predicted = |told: &&Told| {
        told.track.target == 1
            && told.track.measured_by == MeasuredBy::Nothing.code()
            && told.track.state != TrackState::Lost.code()
    };
    let Told { frame: predicted_in, track } =
        told.iter().find(is_predicted).expect("bravo is far away");
    let said = explained(&recording, "bravo", *predicted_in);
    let steps =
        ["imprecise", "too_late", "not_its_turn", "below_threshold", "nothing_found", "rivals"];
    assert!(steps.iter().any(|step| said["step"] == *step), "{}: {}", said["step"], said["why"]);
    assert_eq!(said["result"]["measured"], Value::Null);
    let pose = position(&said["result"]["pose"]);
    assert!(distance(pose, track.observer_from_target.position) < 1e-12, "{said}");
    let unseen_s = said["result"]["unseen_s"].as_f64().expect("it is stated");
    assert!((unseen_s - track.unseen_ns as f64 * 1e-9).abs() < 1e-9);
    assert_eq!(said["reliance"]["is_exact"], true, "{}", said["reliance"]);

    // A target that is not in view.
    let said = explained(&recording, "charlie", 30);
    assert_eq!(
        (&said["step"], &said["result"]),
        (&"no_place_known".into(), &Value::Null),
        "{said}"
    );
    assert_eq!(said["truth"], Value::Null);

    // The first frame in which bravo was measured, and one before: nobody knew where to look.
    let first = told.iter().find(|told| told.track.target == 1).expect("bravo comes near");
    let said = explained(&recording, "bravo", first.frame - 2);
    assert_ne!(said["step"], "measured", "{said}");
    assert_eq!(said["before"]["state"], Value::Null);
    assert!(said["truth"]["pose"]["range_m"].as_f64() > Some(0.5), "{said}");

    as_text_and_picture(&scratch, &recording, *frame);
    what_is_not_there_is_named(&recording);
    losses_are_told(&scratch, &recording);
}

fn as_text_and_picture(scratch: &Scratch, recording: &Path, frame: u64) {
    let picture = scratch.path("alpha.png");
    let number = frame.to_string();
    let arguments = ["explain", text(recording), "--target", "alpha", "--image", text(&picture)];
    let said = succeeds(&[&arguments[..], &["--frame", number.as_str()]].concat());
    for wanted in ["alpha in frame", "measured by aligning", "log odds", "accepted", "Truth"] {
        assert!(said.contains(wanted), "{wanted:?} is missing in:\n{said}");
    }
    assert!(said.contains("fusion gives again what was recorded, byte by byte"), "{said}");
    let file = BufReader::new(File::open(&picture).expect("it was written"));
    let mut reader = png::Decoder::new(file).read_info().expect("a PNG");
    let mut rgb = vec![0; reader.output_buffer_size().expect("it is small")];
    let info = reader.next_frame(&mut rgb).expect("a PNG");
    assert_eq!((info.width, info.height), (960, 720));
    let green = rgb.chunks_exact(3).filter(|pixel| **pixel == [40, 220, 60]).count();
    assert!(green > 200, "the accepted pose is drawn: {green} pixels");
    // The same frame by its time: a tenth of a millisecond after its exposure.
    let at = format!("{:.4}s", frame as f64 / 30.0 + 1e-4);
    let (is_well, by_time) = run(&[&arguments[..4], &["--at", at.as_str()]].concat());
    assert!(is_well && by_time.starts_with(&format!("alpha in frame {frame} ")), "{by_time}");
}

fn what_is_not_there_is_named(recording: &Path) {
    let refused = |more: &[&str], wanted: &str| {
        let (is_well, said) = run(&[&["explain", text(recording)], more].concat());
        assert!(!is_well && said.contains(wanted), "{wanted:?} is missing in:\n{said}");
    };
    let nobody = "has no body 'delta'. It has alpha, bravo, charlie";
    refused(&["--target", "delta", "--frame", "3"], nobody);
    refused(&["--target", "alpha", "--at", "100s"], "Its frames are 0 to 49, from 0.000 s to");
    refused(&["--target", "alpha", "--frame", "50"], "frame 50 is not in the recording");
    refused(&["--target", "alpha", "--at", "soon"], "is no time. Cure:");
}

/// A recording that says what it lacks.
fn losses_are_told(scratch: &Scratch, recording: &Path) {
    let lossy = scratch.path("lossy.mcap");
    let mut reader = RecordingReader::open(recording).expect("it is a recording");
    let file = RecordingFile::create(&lossy).expect("it is new");
    let mut writer = RecordingWriter::begin(file, reader.about()).expect("it can be written");
    let mut last_ns = 0;
    while let Some(message) = reader.next_message().expect("it can be read") {
        let (kind, sequence) = (&message.channel, message.sequence);
        writer.write_as(kind, sequence, message.utc_ns, &message.bytes).expect("it can be written");
        last_ns = message.utc_ns;
    }
    let loss = encode_loss(
        "flockeye/view",
        &Loss { recorded: 900, buffer_full: 2, queue_full: 5, ..Loss::default() },
    );
    writer.write_as(&ChannelKind::of_losses(), 1, last_ns, &loss).expect("it can be written");
    writer.finish().expect("it can be written");
    let (is_same, said) = run(&["replay", text(&lossy)]);
    assert!(is_same && said.contains("a difference may come: flockeye/view 7"), "{said}");
    let said = explained(&lossy, "alpha", 3);
    assert_eq!(said["reliance"]["lost"], serde_json::json!([["flockeye/view", 7]]), "{said}");
}

/// The decisions of a flight in real time are known from its journal.
#[test]
fn a_flight_in_real_time_is_explained_exactly() {
    let scratch = Scratch::new("explained-live");
    let more = ["simulator.frames=30", "simulator.frames_per_second=10", "recording.frames=views"];
    let recording =
        flown_without_losses("explained-live", &scratch, &[SMALL_FLIGHT, &more].concat());
    let is_measured = |told: &&Told| told.track.measured_by == MeasuredBy::Aligned.code();
    let told = told(&recording);
    let Told { frame, track } = told.iter().rfind(is_measured).expect("alpha is near");
    let (said, _) = explained_exactly(&recording, *frame, track);
    let passes = said["passes"].as_array().expect("a list");
    let published =
        passes.iter().any(|pass| pass["outcome"] == "published as the frame's measurement");
    assert!(published, "{said}");
    assert_ne!(said["before"]["state"], Value::Null, "{}", said["before"]);
    assert!(said["before"]["predicted"]["range_m"].as_f64() > Some(0.3), "{}", said["before"]);
}

/// Without pixels a flight is explained from its messages alone.
#[test]
fn a_flight_without_pixels_is_explained_from_its_messages() {
    let scratch = Scratch::new("told-alone");
    let set = [SMALL_FLIGHT, &["simulator.frames=60"]].concat();
    let recording = flown("told-alone", &scratch, &[], &set);
    let told = told(&recording);
    let is_measured = |told: &&Told| told.track.measured_by != MeasuredBy::Nothing.code();
    let Told { frame, track } = told.iter().rfind(is_measured).expect("alpha is near");
    let said = explained(&recording, "alpha", *frame);
    assert_eq!(said["step"], "measured", "{said}");
    assert_eq!(said["reliance"]["is_exact"], false);
    let measured = position(&said["result"]["measured"]);
    assert!(distance(measured, track.measured_observer_from_target.position) < 1e-12, "{said}");
    assert!(said["result"]["latency_ms"]["total"].as_f64() > Some(0.0), "{said}");
    assert_eq!(said["passes"], serde_json::json!([]));
    let untold = said["reliance"]["untold"].to_string();
    assert!(
        untold.contains("fusion cannot be replayed") && untold.contains("no pixels"),
        "{untold}"
    );
    let picture = scratch.path("none.png");
    let number = frame.to_string();
    let arguments = ["explain", text(&recording), "--target", "alpha", "--frame", &number];
    let (is_well, said) = run(&[&arguments[..], &["--image", text(&picture)]].concat());
    assert!(!is_well && said.contains("has no pixels of views"), "{said}");
    let (is_well, said) = run(&arguments);
    assert!(is_well && said.contains("Untold"), "{said}");
}

/// The recording has its bodies: the file may be gone, or have changed.
#[test]
fn a_recording_is_replayed_without_its_bodies_file() {
    let scratch = Scratch::new("bodies-gone");
    let file = scratch.path("bodies.json");
    let pipeline = flockeye_config::Pipeline::default();
    let resolved = flockeye_config::Resolved::of(pipeline).expect("the defaults are right");
    let json = resolved.bodies.to_json().to_string();
    std::fs::write(&file, &json).expect("it can be written");
    let setting = format!("bodies.file={}", file.display());
    let more = [setting.as_str(), "simulator.frames=12", "recording.frames=views"];
    let set = [SMALL_FLIGHT, &more].concat();
    let recording = flown("bodies-gone", &scratch, &["--profile", "repeat"], &set);
    let replayed = || {
        let (is_same, said) = run(&["replay", text(&recording)]);
        assert!(is_same && said.contains("of 12 frames are the same, byte by byte"), "{said}");
    };
    replayed();
    std::fs::write(&file, json.replace("0.03125", "0.04")).expect("it can be written");
    assert!(json.contains("0.03125"), "the edge of the solid is in it");
    replayed();
    std::fs::remove_file(&file).expect("it is there");
    replayed();
}
