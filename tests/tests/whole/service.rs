//! The pipeline as a service of systemd, and the examination of a machine. `deploy/test-package`
//! boots systemd itself.

use std::os::unix::net::UnixDatagram;
use std::process::Command;
use std::time::{Duration, Instant};

use flockeye_tests::{Flight, SMALL_FLIGHT, Scratch, WATCHDOG, flockeye, succeeds, unique};
use rustix::process::Signal;

/// The messages of a pipeline to systemd, with the time of each.
struct Manager {
    socket: UnixDatagram,
    start: Instant,
    heard: Vec<(Duration, String)>,
}

impl Manager {
    /// A pipeline with these settings, under a manager with a watchdog of 4 s.
    fn watch(name: &str, scratch: &Scratch, set: &[&str]) -> (Flight, Self) {
        let path = scratch.path("notify");
        let socket = UnixDatagram::bind(&path).expect("it can be bound");
        socket.set_read_timeout(Some(Duration::from_millis(50))).expect("it can be set");
        let instance = unique(name);
        let mut command = Command::new(flockeye());
        command.arg("up").env("NOTIFY_SOCKET", &path).env("WATCHDOG_USEC", "4000000");
        for assignment in set {
            command.args(["--set", assignment]);
        }
        command.args(["--set", &format!("instance={instance}")]);
        let flight = Flight::launch(&instance, command);
        (flight, Self { socket, start: Instant::now(), heard: Vec::new() })
    }

    /// Listens until `is_enough`, or in vain.
    fn listen(&mut self, flight: &Flight, is_enough: impl Fn(&[(Duration, String)]) -> bool) {
        let mut bytes = [0; 4096];
        while !is_enough(&self.heard) {
            let waited = self.start.elapsed();
            assert!(waited < WATCHDOG, "{:?}\n{}", self.heard, flight.output());
            // Nothing came in time: it is asked for again.
            if let Ok(length) = self.socket.recv(&mut bytes) {
                let text = String::from_utf8_lossy(&bytes[..length]).into_owned();
                self.heard.push((self.start.elapsed(), text));
            }
        }
    }
}

fn has(heard: &[(Duration, String)], word: &str) -> bool {
    heard.iter().any(|(_, text)| text.contains(word))
}

#[test]
fn a_service_is_ready_with_its_first_frame_and_says_how_it_does() {
    let scratch = Scratch::new("ready");
    let (mut flight, mut manager) = Manager::watch("ready", &scratch, SMALL_FLIGHT);
    manager.listen(&flight, |heard| has(heard, "READY=1"));
    let (last, before) = manager.heard.split_last().expect("something was heard");
    assert!(last.1.contains("READY=1") && last.1.contains("WATCHDOG=1"), "{last:?}");
    assert!(!has(before, "WATCHDOG"), "before the first frame: {before:?}");
    manager.listen(&flight, |heard| has(heard, "| alpha confirmed"));
    flight.signal(Signal::TERM);
    manager.listen(&flight, |heard| has(heard, "STOPPING=1"));
    assert!(flight.wait().success(), "{}", flight.output());
    // Each second's line is the status, and not in the log.
    assert!(!flight.output().contains("| alpha confirmed"), "{}", flight.output());
    flight.assert_nothing_left();
}

#[test]
fn a_pipeline_without_frames_does_not_feed_the_watchdog_unless_that_was_asked_for() {
    let scratch = Scratch::new("starving");
    // A camera that gives frames for a second, and is not opened again for the next eight.
    let set = [
        "source.input=gst:videotestsrc is-live=true num-buffers=30 ! video/x-raw,width=1024,height=512",
        "source.reopen_s=[8.0, 8.0]",
        "camera.width=1024",
        "camera.height=512",
        "gateway.enabled=false",
    ];
    let (mut flight, mut manager) = Manager::watch("starving", &scratch, &set);
    manager.listen(&flight, |heard| has(heard, "READY=1"));
    let fed = |heard: &[(Duration, String)]| {
        let feeds = heard.iter().filter(|(_, text)| text.contains("WATCHDOG=1"));
        feeds.map(|(at, _)| *at).collect::<Vec<_>>()
    };
    let is_late = |heard: &[(Duration, String)], wait: Duration| {
        let last_fed = fed(heard).last().copied().unwrap_or_default();
        heard.last().is_some_and(|(at, _)| *at > last_fed + wait)
    };
    manager.listen(&flight, |heard| is_late(heard, Duration::from_secs(4)));
    let feeds = fed(&manager.heard).len();
    // Somebody ends a stage: no frame is owed any more.
    let instance = flight.instance.name().to_owned();
    succeeds(&["stop", "detection", "--instance", &instance]);
    manager.listen(&flight, |heard| fed(heard).len() >= feeds + 3);
    flight.end_by(Signal::TERM);
}

fn examined(set: &[&str]) -> (bool, serde_json::Value) {
    let mut command = Command::new(flockeye());
    command.current_dir(std::env::temp_dir()).args(["doctor", "--json"]);
    for assignment in set {
        command.args(["--set", assignment]);
    }
    let output = command.output().expect("it can be started");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let json = serde_json::from_str(&text).unwrap_or_else(|error| {
        panic!("{error}: {text}{}", String::from_utf8_lossy(&output.stderr))
    });
    (output.status.success(), json)
}

#[test]
fn a_doctor_finds_this_machine_fit_and_names_what_is_missing() {
    let (would_fly, report) = examined(&[]);
    assert!(would_fly && report["would_fly"] == true, "{report:#}");
    let findings = report["findings"].as_array().expect("there are some");
    let about = |topic: &str| findings.iter().filter(|finding| finding["topic"] == topic).count();
    for topic in ["configuration", "processor", "memory", "programs", "graphics", "opencv", "clock"]
    {
        assert!(about(topic) > 0, "nothing about {topic}: {report:#}");
    }

    // A camera that is not there, an address of somebody else's, keys that are missing, too much
    // memory.
    let (would_fly, report) = examined(&[
        "source.input=theta",
        "gateway.listen=[tls/192.0.2.7:7447]",
        "gateway.security={ca: /none/ca.pem, certificate: /none/cert.pem, key: /none/key.pem, roster: /none/r.json}",
    ]);
    assert!(!would_fly && report["would_fly"] == false, "{report:#}");
    let findings = report["findings"].as_array().expect("there are some");
    let problems: Vec<_> =
        findings.iter().filter(|finding| finding["gravity"] == "problem").collect();
    for topic in ["camera", "gstreamer", "network", "keys"] {
        let found = problems.iter().find(|finding| finding["topic"] == topic);
        let found = found.unwrap_or_else(|| panic!("no problem with the {topic}: {report:#}"));
        assert!(found["cure"].is_string(), "{found:#}");
    }
}

#[test]
fn a_doctor_reads_a_broken_configuration() {
    let (would_fly, report) = examined(&["bodies.dictionary=DICT_NONE"]);
    assert!(!would_fly, "{report:#}");
    let text = report.to_string();
    assert!(text.contains("DICT_NONE"), "{report:#}");
}
