//! Why this pose, or why none, asked on the page.

use std::process::Command;

use flockeye_contract::TrackHeader;
use flockeye_tests::browser::Browser;
use flockeye_tests::{Flight, SMALL_FLIGHT, Scratch, flockeye};
use rustix::process::Signal;

use super::View;
use crate::recording::read;

/// The screen position of the first neighbour's row, at the shown time.
const ROW: &str = r"(() => {
    const { rows, begin, end, canvas } = flockeye.timelines;
    const box = canvas.getBoundingClientRect();
    const at = flockeye.playback.recording ? flockeye.playback.at : flockeye.history.current.at;
    const share = (at - begin) / (end - begin);
    return rows.length > 0 && [box.left + 78 + share * (box.width - 92), box.top + rows[0].top + 5];
})()";

/// The panel has an answer.
const ANSWERED: &str = "(!flockeye.explanation.root.hidden && !flockeye.explanation.root.classList.contains('waiting'))";

#[test]
fn a_click_on_a_recordings_timelines_says_why() {
    let Some(mut browser) = Browser::start() else { return };
    let scratch = Scratch::new("why-rec");
    let folder = scratch.path("flights");
    let recording = format!("recording.folder={}", folder.display());
    let more = ["simulator.frames=30", "recording.frames=views", recording.as_str()];
    let set: Vec<&str> = SMALL_FLIGHT.iter().copied().chain(more).collect();
    let mut flight = Flight::start("why-rec", &["--profile", "repeat"], &set);
    assert!(flight.wait().success(), "{}", flight.output());
    let mut files = std::fs::read_dir(folder).expect("it was made");
    let path = files.next().expect("one recording").expect("it can be read").path();

    let view = View::of_recording(&path, &[]);
    browser.open(&view.address());
    browser.wait_for("flockeye.overview.length > 0 && !flockeye.playback.isWaiting");
    browser.ask("flockeye.playback.seek(0.6 * flockeye.hello.recording.duration_s)");
    browser.wait_for("!flockeye.playback.isWaiting && flockeye.history.current");
    let at = browser.wait_for(ROW);
    browser.click(at[0].as_f64().expect("a number"), at[1].as_f64().expect("a number"));
    browser.wait_for(ANSWERED);
    let key = browser.ask("flockeye.history.current.frame.key");
    let key = key.as_str().expect("a name");
    // The same words as in a terminal, and what was seen there.
    let output = Command::new(flockeye())
        .arg("explain")
        .arg(&path)
        .args(["--target", "alpha", "--frame", key])
        .output()
        .expect("it can be started");
    let told = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(told.contains("fusion gives again what was recorded, byte by byte"), "{told}");
    assert_eq!(browser.ask("flockeye.explanation.text.textContent"), told);
    browser.wait_for("flockeye.explanation.picture.naturalWidth > 50");
    browser.press("Escape", "Escape");
    assert_eq!(browser.ask("flockeye.explanation.root.hidden"), true);

    // By its key, of a frame that has no such neighbour, and of none at all.
    browser.press("w", "KeyW");
    browser.wait_for(ANSWERED);
    assert_eq!(browser.ask("flockeye.explanation.text.textContent"), told);
    browser.ask("flockeye.explanation.ask('nobody', flockeye.history.current.frame.key)");
    let refused = browser.ask("flockeye.explanation.text.textContent");
    assert!(
        refused.as_str().is_some_and(|text| text.contains("has no body 'nobody'")),
        "{refused}"
    );
    browser.ask("flockeye.explanation.ask('alpha', '9.9.9')");
    let refused = browser.ask("flockeye.explanation.text.textContent");
    assert!(refused.as_str().is_some_and(|text| text.contains("9.9.9 is not in")), "{refused}");
    // The browser itself notes that those two were refused.
    let others = browser.complaints.iter().filter(|complaint| !complaint.contains("409"));
    assert_eq!(others.count(), 0, "{:?}", browser.complaints);
    view.end();
    flight.assert_nothing_left();
}

#[test]
fn a_live_page_says_why_from_the_recording_that_is_being_written() {
    let scratch = Scratch::new("why-live");
    let mut flight = Flight::with_poses("why-live", &[], SMALL_FLIGHT);
    let view = View::of(&flight, &[]);
    let ask = |frame: &str| {
        let target = format!("/explain?target=alpha&frame={frame}");
        view.ask(format!("GET {target} HTTP/1.1\r\nHost: localhost\r\n\r\n").as_bytes())
    };
    // Nobody records.
    let answer = ask("0.0.3");
    assert!(answer.starts_with("HTTP/1.1 409 ") && answer.contains("Cure: recording.folder"));
    let path = scratch.path("live.mcap");
    let mut recorder = Command::new(flockeye());
    recorder.arg("record").arg(&path).args(["--instance", flight.instance.name()]);
    let mut recorder = Flight::launch(&format!("{}-r", flight.instance.name()), recorder);
    // Some frames later one of those that were recorded is asked for.
    let frame = wait_for_frame(&path, 20);
    let answer = ask(&frame);
    assert!(answer.starts_with("HTTP/1.1 200 "), "{answer}");
    let number = frame.rsplit('.').next().expect("it has a number");
    assert!(answer.contains(&format!("alpha in frame {number} at ")), "{answer}");
    recorder.signal(Signal::INT);
    assert!(recorder.wait().success(), "{}", recorder.output());
    let answer = ask(&frame);
    assert!(answer.contains("not recorded"), "{answer}");
    flight.signal(Signal::INT);
    assert!(flight.wait().success(), "{}", flight.output());
    view.end();
    flight.assert_nothing_left();
}

/// The name of a frame in a recording that is being written, after so many.
fn wait_for_frame(path: &std::path::Path, after: usize) -> String {
    let start = std::time::Instant::now();
    loop {
        assert!(start.elapsed() < flockeye_tests::WATCHDOG, "nothing is recorded");
        std::thread::sleep(std::time::Duration::from_millis(200));
        // The recorder makes an empty file before it writes the first bytes.
        if std::fs::metadata(path).map_or(true, |file| file.len() == 0) {
            continue;
        }
        let (messages, _) = read(path, "flockeye/track");
        if let Some(message) = messages.get(after) {
            let TrackHeader { stamp, .. } = bytemuck::pod_read_unaligned(&message.header);
            return format!("{}.{}.{}", stamp.source_generation, stamp.epoch, stamp.sequence);
        }
    }
}
