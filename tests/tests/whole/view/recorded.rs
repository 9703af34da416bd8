//! A recording on the page: at any time of it, for many pages at once, and files that are broken.

use std::collections::BTreeSet;
use std::fs::File;
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use flockeye_config::{Pipeline, Resolved};
use flockeye_contract::{TrackHeader, TrackState};
use flockeye_recording::channel::FRAME_IMAGES;
use flockeye_recording::message::decode;
use flockeye_recording::{IndexedRecording, RecordingReader, layouts};
use flockeye_require::loopback::free_port;
use flockeye_tests::browser::Browser;
use flockeye_tests::{Flight, SMALL_FLIGHT, Scratch, WATCHDOG, run};
use serde_json::Value;
use tungstenite::{Message, WebSocket};

use crate::python::python;
use crate::replaying::copy_without;

use super::{View, assert_corners_are_in_their_places, assert_picture_is_where_the_pose_is, next};

/// Frames of the recorded flight.
const FRAMES: u64 = 75;
/// Interval of frames with a picture.
const EVERY: u64 = 3;

/// A frame that ended in a recording.
struct Ended {
    /// Seconds from the recording's beginning.
    at_s: f64,
    key: String,
    sequence: u64,
    is_confirmed: bool,
}

/// A recorded flight.
struct Recorded {
    path: PathBuf,
    ended: Vec<Ended>,
    resolved: Resolved,
}

impl Recorded {
    /// Flies it.
    fn fly(name: &str, scratch: &Scratch) -> Self {
        let folder = scratch.path("flights");
        let settings = [
            format!("simulator.frames={FRAMES}"),
            format!("recording.folder={}", folder.display()),
            "recording.frames=every".to_owned(),
            format!("recording.every={EVERY}"),
            "simulator.airframes=false".to_owned(),
        ];
        let set: Vec<&str> =
            SMALL_FLIGHT.iter().copied().chain(settings.iter().map(String::as_str)).collect();
        let mut flight = Flight::start(name, &["--profile", "repeat"], &set);
        flight.assert_ends_well();
        let mut files = std::fs::read_dir(folder).expect("it was made");
        let path = files.next().expect("one recording").expect("it can be read").path();
        Self::read(path)
    }

    fn read(path: PathBuf) -> Self {
        let layout = layouts().into_iter().find(|layout| layout.service == "flockeye/track");
        let layout = layout.expect("there is this topic");
        let mut reader = RecordingReader::open(&path).expect("it is a recording");
        let (_, _, json) = &reader.about().attachments[0];
        let pipeline = Pipeline::from_json(json).expect("it is a configuration");
        let resolved = Resolved::of(pipeline).expect("it is valid");
        let (mut ended, mut first_ns) = (Vec::new(), u64::MAX);
        let mut confirmed = BTreeSet::new();
        while let Some(message) = reader.next_message().expect("it can be read") {
            first_ns = first_ns.min(message.utc_ns);
            if message.channel.topic != layout.channel() {
                continue;
            }
            let found = decode(&layout, &message.bytes).expect("it is as it was recorded");
            let header: TrackHeader = bytemuck::pod_read_unaligned(&found.header);
            let tracks = found.items.chunks_exact(size_of::<flockeye_contract::Track>());
            let stamp = header.stamp;
            if tracks
                .map(bytemuck::pod_read_unaligned::<flockeye_contract::Track>)
                .any(|track| track.target == 0 && track.state == TrackState::Confirmed.code())
            {
                confirmed.insert(stamp.sequence);
            }
            // The neighbours of a frame may come one by one.
            if header.is_last != 0 {
                let is_confirmed = confirmed.contains(&stamp.sequence);
                let key = format!("{}.{}.{}", stamp.source_generation, stamp.epoch, stamp.sequence);
                let at_s = (message.utc_ns - first_ns) as f64 * 1e-9;
                ended.push(Ended { at_s, key, sequence: stamp.sequence, is_confirmed });
            }
        }
        assert_eq!(ended.len() as u64, FRAMES);
        Self { path, ended, resolved }
    }

    /// A time at which this frame is the last that had ended.
    fn time_of(&self, frame: usize) -> f64 {
        let next = self.ended.get(frame + 1).map_or(f64::INFINITY, |next| next.at_s);
        let at = self.ended[frame].at_s;
        at + (0.5 * (next - at)).min(0.001)
    }

    /// The frame that is shown at this time.
    fn at(&self, seconds: f64) -> &Ended {
        self.ended.iter().rfind(|ended| ended.at_s <= seconds).unwrap_or(&self.ended[0])
    }
}

fn copy(from: &Path, to: &Path, is_kept: impl Fn(&str) -> bool) {
    copy_without(from, to, |message| !is_kept(&message.channel.topic));
}

/// The page shows this frame, and nothing is asked any more.
fn shows(key: &str) -> String {
    format!(
        "(!flockeye.playback.isWaiting && !flockeye.playback.next.length \
         && flockeye.history.current.frame.key === '{key}')"
    )
}

#[test]
fn a_recording_is_shown_at_any_time() {
    let Some(mut browser) = Browser::start() else { return };
    let scratch = Scratch::new("view-rec");
    let flight = Recorded::fly("view-rec", &scratch);
    let view = View::of_recording(&flight.path, &[]);
    browser.open(&view.address());
    browser.wait_for(&shows(&flight.ended[0].key));
    let name = flight.path.file_name().expect("a name").to_string_lossy().into_owned();
    assert_eq!(browser.ask("document.title"), format!("{name} · Flockeye"));

    // At two times, of which the later comes first: that very frame, with its picture and close-up
    // under the lines.
    let is_seen = |ended: &&Ended| ended.is_confirmed && ended.sequence.is_multiple_of(EVERY);
    let seen: Vec<&Ended> = flight.ended.iter().filter(is_seen).collect();
    assert!(seen.len() > 10, "{} frames with a picture and a neighbour", seen.len());
    for ended in [seen[seen.len() - 2], seen[4]] {
        let time = flight.time_of(ended.sequence as usize);
        browser.ask(&format!("flockeye.playback.seek({time})"));
        let key = &ended.key;
        browser.wait_for(&format!("{} && flockeye.backdrop.key === '{key}'", shows(key)));
        browser.wait_for("flockeye.history.current.closeups.get(0).head.score.correlation > 0.8");
        browser.ask("flockeye.sphere.reset()");
        assert_corners_are_in_their_places(&mut browser, &flight.resolved);
        assert_picture_is_where_the_pose_is(&mut browser);
        assert_eq!(browser.ask("document.getElementById('caption').hidden"), true);
    }

    // Frame by frame: the picture is then of the frame before, and the page says so.
    let at = seen[4].sequence as usize;
    browser.press("ArrowRight", "ArrowRight");
    browser.wait_for(&shows(&flight.ended[at + 1].key));
    let caption = browser.ask("document.getElementById('caption').textContent");
    let wanted = format!("picture of frame {at}, shown with frame {}", at + 1);
    assert_eq!(caption, wanted);
    browser.press("ArrowLeft", "ArrowLeft");
    browser.press("ArrowLeft", "ArrowLeft");
    browser.wait_for(&shows(&flight.ended[at - 1].key));
    // By a second, and with the bar.
    let from = browser.ask("flockeye.playback.at").as_f64().expect("a number");
    browser.ask("flockeye.step(1, 1)");
    browser.wait_for(&shows(&flight.at(from + 1.0).key));
    let time = flight.time_of(40);
    browser.ask(&format!(
        "(() => {{ const bar = document.getElementById('seek'); bar.value = {time}; \
         bar.dispatchEvent(new Event('input')); }})()"
    ));
    browser.wait_for(&shows(&flight.ended[40].key));

    // The page plays, and stops.
    let sequence = "flockeye.history.current.frame.sequence";
    browser.press(" ", "Space");
    browser.wait_for(&format!("{sequence} >= 45 && flockeye.playback.speed === 1"));
    browser.press(" ", "Space");
    browser.wait_for("!flockeye.playback.isWaiting && flockeye.playback.speed === 0");
    // The overview has the whole flight, and the stages as they were.
    browser.wait_for(
        "flockeye.overview.filter(({ frame }) => frame.tracks.some(({ state }) => state === 'confirmed')).length > 20",
    );
    browser.wait_for("document.querySelectorAll('#stages tr').length >= 5");
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
    // A page whose view has ended tries again, and complains.
    browser.open("about:blank");
    view.end();

    // Without pictures, neighbours are drawn all the same.
    let blind = scratch.path("blind.mcap");
    copy(&flight.path, &blind, |topic| topic != FRAME_IMAGES);
    let view = View::of_recording(&blind, &[]);
    browser.open(&view.address());
    let key = &seen[4].key;
    browser.wait_for(&shows(&flight.ended[0].key));
    browser.ask(&format!("flockeye.playback.seek({})", flight.time_of(at)));
    browser.wait_for(&shows(key));
    let caption = browser.ask("document.getElementById('caption').textContent");
    assert!(caption.as_str().is_some_and(|text| text.contains("no pictures")), "{caption}");
    let drawn =
        "(() => { const { surface } = flockeye.sphere; const { data } = surface.getContext('2d')
        .getImageData(0, 0, surface.width, surface.height); let count = 0;
        for (let k = 3; k < data.length; k += 4) count += data[k] > 128; return count; })()";
    browser.ask("flockeye.follow(0)");
    let frames =
        "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))";
    browser.ask(frames);
    let with = browser.ask(drawn).as_u64().expect("a number");
    browser.ask("flockeye.toggle('bodies')");
    browser.ask(frames);
    let without = browser.ask(drawn).as_u64().expect("a number");
    assert!(with > without + 200, "{with} pixels with bodies, {without} without");
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
    view.end();
}

/// The next `position` of a page, and the keys of the frames before it.
fn position(page: &mut WebSocket<TcpStream>, answers: u64) -> (Value, Vec<String>) {
    let (start, mut keys) = (Instant::now(), Vec::new());
    loop {
        let Message::Text(text) = next(page, start) else { continue };
        let message: Value = serde_json::from_str(text.as_str()).expect("JSON");
        match message["kind"].as_str() {
            Some("frame") => keys.push(message["key"].as_str().expect("a name").to_owned()),
            Some("position") if message["answers"].as_u64() >= Some(answers) => {
                return (message, keys);
            }
            _ => {}
        }
    }
}

fn say(page: &mut WebSocket<TcpStream>, text: &str) {
    page.send(Message::text(text)).expect("it listens");
}

#[test]
fn pages_have_their_own_places_and_broken_files_say_so() {
    let scratch = Scratch::new("view-many");
    let flight = Recorded::fly("view-many", &scratch);
    let view = View::of_recording(&flight.path, &[]);
    let mut pages: Vec<_> = (0..10).map(|_| view.socket("").expect("there is room")).collect();
    for (number, page) in pages.iter_mut().enumerate() {
        assert_eq!(position(page, 0).0["key"], flight.ended[0].key);
        say(page, &format!(r#"{{"seek":{}}}"#, flight.time_of(7 * number)));
    }
    for (number, page) in pages.iter_mut().enumerate() {
        let (told, keys) = position(page, 1);
        assert_eq!(told["key"], flight.ended[7 * number].key, "page {number}");
        // All that led there came with it.
        assert_eq!(keys.last(), Some(&flight.ended[7 * number].key));
        say(page, r#"{"step":2}"#);
        assert_eq!(position(page, 2).0["key"], flight.ended[7 * number + 2].key);
    }

    // Invalid values are limited.
    let page = &mut pages[0];
    let last = flight.ended.len() - 1;
    let garbage = [
        (r#"{"seek":-5}"#, 0),
        (r#"{"seek":1e300}"#, last),
        (r#"{"step":-2147483648}"#, 0),
        (r#"{"step":2147483647}"#, last),
        (r#"{"play":-1}"#, last),
    ];
    let mut answers = 2;
    for (text, frame) in garbage {
        say(page, text);
        answers += 1;
        let (told, _) = position(page, answers);
        assert_eq!(
            (&told["key"], &told["speed"]),
            (&flight.ended[frame].key.as_str().into(), &0.0.into()),
            "{text}"
        );
    }
    for _ in 0..10_000 {
        say(page, r#"{"seek":0.5}"#);
    }
    let (told, _) = position(page, answers + 10_000);
    assert_eq!(told["key"], flight.at(0.5).key);
    for nonsense in [r#"{"seek":null}"#, r#"{"seek":"now"}"#, r#"{"seek":1e999}"#, r#"{"play":[]}"#]
    {
        let mut page = view.socket("").expect("there is room");
        say(&mut page, nonsense);
        let start = Instant::now();
        while page.read().is_ok_and(|message| !message.is_close()) {
            assert!(start.elapsed() < WATCHDOG, "it is not closed: {nonsense}");
        }
    }
    drop(pages);
    view.end();

    // Files that are no recordings, and one that never was written.
    let bytes = std::fs::read(&flight.path).expect("it is there");
    let bad = scratch.path("bad.mcap");
    let refused = |bytes: &[u8]| {
        std::fs::write(&bad, bytes).expect("it can be written");
        let (is_well, said) = run(&["view", bad.to_str().expect("a plain path")]);
        assert!(!is_well && said.contains("bad.mcap") && said.contains("Cure:"), "{said}");
        said
    };
    assert!(refused(b"").contains("is empty"));
    assert!(refused(b"a text, and no recording").contains("is no MCAP file"));
    assert!(refused(&bytes[..40]).contains("ends within its beginning"));
    File::options()
        .write(true)
        .open(&bad)
        .and_then(|file| file.set_len(100_000_000_000))
        .expect("it is sparse");
    let (is_well, said) = run(&["view", bad.to_str().expect("a plain path")]);
    assert!(!is_well && said.contains("bad.mcap") && said.contains("Cure:"), "{said}");
    let (is_well, said) = run(&["view", "none.mcap"]);
    assert!(!is_well && said.contains("none.mcap: No such file"), "{said}");

    // Cut off, damaged in the middle with its index and without, and with a hole behind it.
    let recording = IndexedRecording::open(&flight.path).expect("it is a recording");
    let chunk = &recording.chunks()[recording.chunks().len() / 2];
    let middle = (chunk.offset + chunk.length / 2) as usize;
    let mut damaged = bytes.clone();
    damaged[middle..middle + 8].fill(0x5a);
    let cut = &bytes[..middle];
    let hole = [&bytes[..chunk.offset as usize], &[0; 1000]].concat();
    for (bytes, said) in [
        (cut, "cut off"),
        (&damaged[..], "damaged near byte"),
        (&damaged[..damaged.len() - 9], "damaged near byte"),
        (&hole, "zeros where a record should be"),
    ] {
        std::fs::write(&bad, bytes).expect("it can be written");
        let view = View::of_recording(&bad, &[]);
        let mut page = view.socket("").expect("there is room");
        assert_eq!(
            position(&mut page, 0).0["key"],
            flight.ended[0].key,
            "what lies before is shown"
        );
        // All of it, to find what is broken.
        say(&mut page, r#"{"step":1000}"#);
        let start = Instant::now();
        let mut heard = view.process.output();
        while !heard.contains(said) {
            if let Message::Text(text) = next(&mut page, start) {
                heard.push_str(text.as_str());
            }
        }
        assert!(said == "cut off" || heard.contains("Cure: `flockeye record --recover"), "{heard}");
        view.end();
    }
}

/// Foxglove's own bar moves a recording.
#[test]
fn foxglove_seeks_in_a_recording() {
    let Some(python) = python() else { return };
    let scratch = Scratch::new("view-fox");
    let flight = Recorded::fly("view-fox", &scratch);
    let address = format!("127.0.0.1:{}", free_port());
    let view = View::of_recording(&flight.path, &["--foxglove", &address]);
    let recording = IndexedRecording::open(&flight.path).expect("it is a recording");
    let (first_ns, last_ns) = recording.span_ns().expect("it has messages");
    for frame in [60, 30] {
        let share = flight.time_of(frame) / ((last_ns - first_ns) as f64 * 1e-9);
        let mut command = Command::new(&python);
        command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("src/foxglove.py"));
        command.arg(format!("ws://{address}")).args(["--seek", &share.to_string()]);
        // The script has a watchdog of its own.
        let output = command.stdin(Stdio::null()).output().expect("it can be started");
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        let complaints = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{said}\n{complaints}");
        let line: Value = serde_json::from_str(said.trim()).expect("one JSON object");
        let number = |name: &str| line[name].as_u64().expect("a number");
        let seconds = (number("sought") - number("begin")) as f64 * 1e-9;
        assert_eq!(line["key"], flight.at(seconds).key, "{line}");
    }
    view.end();
}
