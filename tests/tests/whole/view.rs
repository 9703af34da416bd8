//! `flockeye view`: the live view, in a real browser and under bad treatment.

mod foxglove;
mod recorded;
mod why;

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::process::Command;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use flockeye_config::Resolved;
use flockeye_contract::{FrameEnds, Tracks};
use flockeye_geometry::Ray;
use flockeye_require::loopback::free_port;
use flockeye_tests::browser::Browser;
use flockeye_tests::onlooker::{Gated, join, subscribe};
use flockeye_tests::{Flight, SMALL_FLIGHT, Scratch, WATCHDOG, flockeye, small_flight, unique};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use rustix::process::{Signal, kill_process};
use serde_json::Value;
use tungstenite::{Message, WebSocket};

/// The live view of a flight.
struct View {
    port: u16,
    process: Flight,
}

impl View {
    /// Starts it, and waits until it serves.
    fn of(flight: &Flight, arguments: &[&str]) -> Self {
        let port = free_port();
        let mut command = Command::new(flockeye());
        let instance = flight.instance.name();
        command.args(["view", "--instance", instance, "--listen", &format!("127.0.0.1:{port}")]);
        command.args(arguments);
        // Its own instance is that of nobody: a flight's name is never that long.
        Self::launch(&format!("{instance}-view"), port, command)
    }

    /// The view of a recording.
    fn of_recording(path: &Path, arguments: &[&str]) -> Self {
        let port = free_port();
        let mut command = Command::new(flockeye());
        command.arg("view").arg(path).args(["--listen", &format!("127.0.0.1:{port}")]);
        command.args(arguments);
        Self::launch(&unique("recorded-view"), port, command)
    }

    fn launch(name: &str, port: u16, command: Command) -> Self {
        let mut process = Flight::launch(name, command);
        process.wait_for("the view of");
        Self { port, process }
    }

    fn address(&self) -> String {
        format!("http://127.0.0.1:{}/", self.port)
    }

    /// The answer to these bytes.
    fn ask(&self, request: &[u8]) -> String {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port)).expect("it listens");
        stream.set_read_timeout(Some(WATCHDOG)).expect("a socket has a timeout");
        // An error is ignored: the view may refuse before it has read everything.
        let _ = stream.write_all(request);
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        String::from_utf8_lossy(&answer).into_owned()
    }

    /// A page's socket, as a program opens it.
    fn socket(&self, query: &str) -> Result<WebSocket<TcpStream>, String> {
        let stream = TcpStream::connect(("127.0.0.1", self.port)).expect("it listens");
        stream.set_read_timeout(Some(WATCHDOG)).expect("a socket has a timeout");
        let address = format!("ws://127.0.0.1:{}/live{query}", self.port);
        tungstenite::client(address, stream)
            .map(|(socket, _)| socket)
            .map_err(|error| error.to_string())
    }

    fn end(mut self) {
        self.process.signal(Signal::INT);
        assert!(self.process.wait().success(), "{}", self.process.output());
    }
}

/// The mean grey of the picture on white rims minus that on black borders, and the number of
/// samples on rims. Markers are those of a neighbour that face the camera. They are sampled at its
/// pose, moved aside by `millimetres`.
const GREYS: &str = r"(millimetres) => {
    const { sphere, bodies, history } = flockeye;
    const track = history.pictured.frame.tracks.find(({ target }) => target === 0);
    const { gl } = sphere;
    const sums = { rim: [0, 0], border: [0, 0] };
    const moved = { ...track.pose, p: [...track.pose.p] };
    // Across the line of sight.
    const across = [-moved.p[1], moved.p[0], 0];
    const length = Math.hypot(...across);
    moved.p = moved.p.map((x, k) => x + across[k] / length * millimetres / 1000);
    for (const { points, faces } of bodies.markers(moved, 0)) {
        const middle = [0, 1, 2].map((k) => points.reduce((sum, p) => sum + p[k], 0) / 4);
        const edge = (a, b) => points[a].map((x, k) => points[b][k] - x);
        const [u, v] = [edge(0, 1), edge(1, 2)];
        const normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        const cosine = normal.reduce((sum, x, k) => sum + x * middle[k], 0) / Math.hypot(...normal) / Math.hypot(...middle);
        if (!faces || cosine < 0.6) continue;
        for (const [name, size] of [['rim', 1.13], ['border', 6 / 7]]) {
            for (let side = 0; side < 4; side++) {
                for (let step = 1; step < 10; step++) {
                    const on = [0, 1, 2].map((k) => points[side][k] + (points[(side + 1) % 4][k] - points[side][k]) * step / 10);
                    const at = sphere.project(on.map((x, k) => middle[k] + size * (x - middle[k])));
                    if (!at) continue;
                    const pixel = new Uint8Array(4);
                    const ratio = sphere.canvas.width / sphere.width;
                    gl.readPixels(Math.round(at[0] * ratio), sphere.canvas.height - 1 - Math.round(at[1] * ratio), 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
                    sums[name][0] += pixel[0];
                    sums[name][1] += 1;
                }
            }
        }
    }
    return [sums.rim[0] / sums.rim[1] - sums.border[0] / sums.border[1], sums.rim[1]];
}";

/// The places of the neighbour's marker corners in the page's flat picture, as shares of its sides.
const CORNERS: &str = r"(() => {
    const { sphere, bodies, history } = flockeye;
    const { key, tracks } = history.pictured.frame;
    const { pose } = tracks.find(({ target }) => target === 0);
    const [wide, high] = sphere.extent();
    const places = bodies.markers(pose, 0).flatMap(({ points }) => points).map((point) => {
        const [x, y] = sphere.project(point);
        return [(x / sphere.width - 0.5) * 2 * wide + sphere.window.u, (y / sphere.height - 0.5) * 2 * high + sphere.window.v];
    });
    return { key, pose, places };
})()";

fn numbers<const N: usize>(value: &Value) -> [f64; N] {
    std::array::from_fn(|k| value[k].as_f64().expect("a number"))
}

/// A neighbour that was measured in the frame that is shown, with its close-up, and some pictures
/// before.
const SEEN: &str = "(flockeye.history.frames.filter(({ bitmap }) => bitmap).length > 5 && flockeye.history.pictured.bitmap && flockeye.history.pictured.frame.tracks
    .some(({ target, state, by }) => target === 0 && state === 'confirmed' && by === 'aligned')
    && flockeye.history.frames.some(({ closeups }) => closeups.get(0)?.head.score?.correlation > 0.8))";

/// Fails unless page and camera model have the neighbour's marker corners at the same places.
fn assert_corners_are_in_their_places(browser: &mut Browser, resolved: &Resolved) {
    let drawn = browser.ask(CORNERS);
    let ([x, y, z], q) = (numbers(&drawn["pose"]["p"]), numbers::<4>(&drawn["pose"]["q"]));
    let turn = UnitQuaternion::from_quaternion(Quaternion::from(q));
    let observer_from_target = Isometry3::from_parts(Translation3::new(x, y, z), turn);
    let body = resolved.bodies.get(0).expect("alpha");
    let camera_from_markers =
        resolved.observer_from_camera.inverse() * observer_from_target * body.target_from_markers;
    let (width, height) = (resolved.camera.width(), resolved.camera.height());
    let places = drawn["places"].as_array().expect("a list");
    assert_eq!(places.len(), 4 * body.markers.len());
    for (corner, place) in body.corners().zip(places) {
        let ray = Ray::new_normalize((camera_from_markers * corner).coords);
        let at = resolved.camera.project(&ray).expect("it sees all round").0;
        let [u, v] = numbers(place);
        let off_u = (u * f64::from(width) - 0.5 - at.x).rem_euclid(f64::from(width));
        let off_u = off_u.min(f64::from(width) - off_u);
        let off_v = (v * f64::from(height) - 0.5 - at.y).abs();
        assert!(off_u < 0.1 && off_v < 0.1, "{place} of the page, {at} of the camera");
    }
}

/// Looks closely, and fails unless the markers' white rims and black borders are where the pose has
/// them.
fn assert_picture_is_where_the_pose_is(browser: &mut Browser) {
    browser.ask("flockeye.follow(0)");
    let drawn_twice =
        "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))";
    browser.ask(drawn_twice);
    let [here, points] = numbers(&browser.ask(&format!("({GREYS})(0)")));
    let [aside, _] = numbers(&browser.ask(&format!("({GREYS})(7)")));
    println!("rims are brighter than borders by {here}, 7 mm aside by {aside}; {points} points");
    assert!(points >= 36.0 && here > 50.0, "{here} at {points} points");
    assert!(aside < 0.5 * here, "{aside} aside, {here} where it is");
}

#[test]
fn a_page_shows_the_neighbour_where_it_is() {
    let Some(mut browser) = Browser::start() else { return };
    let set = small_flight(&["simulator.airframes=false"]);
    let mut flight = Flight::with_poses("view", &[], &set);
    let view = View::of(&flight, &[]);
    browser.open(&view.address());
    browser.wait_for(SEEN);
    assert_eq!(browser.ask("document.title"), format!("{} · Flockeye", flight.instance.name()));

    // Paused where it is seen: the page and the camera model agree where the corners are.
    browser.wait_for(&format!("{SEEN} && (flockeye.pause(true), {SEEN})"));
    let resolved = Resolved::of(flight.instance.pipeline().expect("it runs")).expect("it is valid");
    assert_corners_are_in_their_places(&mut browser, &resolved);
    assert_picture_is_where_the_pose_is(&mut browser);

    // Steps go back and forth over the pictures that are kept, and the last one leads on.
    let key = "flockeye.history.pictured.frame.key";
    let first = browser.ask(key);
    browser.press("ArrowLeft", "ArrowLeft");
    let before = browser.ask(key);
    browser.press("ArrowRight", "ArrowRight");
    assert!(before != first && browser.ask(key) == first, "{before} comes before {first}");
    assert_eq!(browser.ask("document.getElementById('mode').textContent.includes('s')"), true);
    browser.press(" ", "Space");
    browser.wait_for(&format!("!flockeye.history.paused && {key} !== {first}"));
    browser.wait_for("document.querySelectorAll('#stages tr.ready').length >= 5");

    // The pipeline ends, and the page says so; then the view.
    flight.signal(Signal::INT);
    assert!(flight.wait().success(), "{}", flight.output());
    browser.wait_for("document.getElementById('notice').textContent.includes('does not run')");
    flight.assert_nothing_left();

    // Another one of the same name is followed by itself, with pictures, although the page was
    // paused.
    browser.ask("flockeye.pause(true)");
    let name = flight.instance.name().to_owned();
    let mut flight = Flight::start_as(&name, &[], &set);
    flight.wait_for("alpha confirmed");
    browser.wait_for(&format!("document.getElementById('notice').hidden && {SEEN}"));
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
    flight.signal(Signal::INT);
    assert!(flight.wait().success(), "{}", flight.output());
    view.end();
    flight.assert_nothing_left();
}

#[test]
fn ten_pages_and_one_that_reads_nothing_cost_no_frame() {
    const FRAMES: u64 = 60;
    let scratch = Scratch::new("pages");
    let frames = format!("simulator.frames={FRAMES}");
    let set = [SMALL_FLIGHT, &[frames.as_str()]].concat();
    let mut gated = Gated::start("pages", &scratch, &["--profile", "repeat"], &set);
    let mut ports = join(&mut gated.flight);
    let mut ends = subscribe::<FrameEnds>(&mut gated.flight, &mut ports);
    let mut tracks = subscribe::<Tracks>(&mut gated.flight, &mut ports);
    let view = View::of(&gated.flight, &[]);
    let wants = || Message::text(r#"{"pictures":true}"#);
    let mut stalled = view.socket("").expect("there is room");
    stalled.send(wants()).expect("it listens");
    let (ready, is_ready) = channel();
    let pages: Vec<_> = (0..10)
        .map(|_| {
            let mut page = view.socket("").expect("there is room");
            page.send(wants()).expect("it listens");
            let ready = ready.clone();
            std::thread::spawn(move || {
                wait_until_followed(&mut page);
                ready.send(()).expect("somebody waits");
                read_page(&mut page, FRAMES - 1)
            })
        })
        .collect();
    for _ in &pages {
        is_ready.recv_timeout(WATCHDOG).expect("the view follows the pipeline");
    }
    gated.open();
    let mut flight = gated.flight;
    let (mut ended, mut closed) = (Vec::new(), Vec::new());
    let start = Instant::now();
    ports
        .attend(|| {
            while let Some(message) = ends.receive()? {
                ended.push(message.header.stamp.sequence);
            }
            while let Some(message) = tracks.receive()? {
                if message.header.is_last != 0 {
                    closed.push(message.header.stamp.sequence);
                }
            }
            assert!(start.elapsed() < WATCHDOG, "it does not end:\n{}", flight.output());
            Ok((closed.last() != Some(&(FRAMES - 1))).then_some(Duration::from_millis(50)))
        })
        .expect("messages can be waited for");
    let wanted: Vec<u64> = (0..FRAMES).collect();
    assert_eq!((&ended, &closed), (&wanted, &wanted), "{}", flight.output());
    for page in pages {
        let (frames, pictures) = page.join().expect("the page reads");
        assert_eq!(frames, wanted, "frames that a page was told of");
        assert!(pictures > 0, "a page gets pictures");
    }
    drop((ends, tracks, ports));
    assert!(flight.wait().success(), "{}", flight.output());
    drop(stalled);
    view.end();
    flight.assert_nothing_left();
}

/// The next message to a page.
fn next(page: &mut WebSocket<TcpStream>, start: Instant) -> Message {
    assert!(start.elapsed() < WATCHDOG, "what is waited for does not come");
    page.read().expect("the view goes on")
}

/// Waits until the view reads frames, too: for three reports of the stages. The first may be older
/// than the page's wish. The view follows it by the third.
fn wait_until_followed(page: &mut WebSocket<TcpStream>) {
    let (mut reports, start) = (0, Instant::now());
    while reports < 3 {
        if let Message::Text(text) = next(page, start) {
            reports += u32::from(text.contains(r#""kind":"stages""#));
        }
    }
}

/// Reads what a page reads until frame `last`: the frames it is told of, and how many pictures.
fn read_page(page: &mut WebSocket<TcpStream>, last: u64) -> (Vec<u64>, usize) {
    let (mut frames, mut pictures) = (Vec::new(), 0);
    let start = Instant::now();
    while frames.last() != Some(&last) {
        match next(page, start) {
            Message::Text(text) => {
                let message: Value = serde_json::from_str(text.as_str()).expect("JSON");
                if message["kind"] == "frame" {
                    assert_eq!(message["skipped"], 0);
                    frames.push(message["sequence"].as_u64().expect("a number"));
                }
            }
            Message::Binary(bytes) => {
                let length = u32::from_le_bytes(bytes[..4].try_into().expect("four")) as usize;
                let head: Value = serde_json::from_slice(&bytes[4..4 + length]).expect("JSON");
                assert!(bytes[4 + length..].starts_with(&[0xff, 0xd8]), "a JPEG follows");
                if head["kind"] == "picture" {
                    pictures += 1;
                    page.send(Message::text(r#"{"shown":1}"#)).expect("it listens");
                }
            }
            _ => {}
        }
    }
    (frames, pictures)
}

#[test]
fn bad_requests_are_refused_and_harm_nobody() {
    let mut flight = Flight::with_poses("bad-view", &[], SMALL_FLIGHT);
    let view = View::of(&flight, &["--token", "open-sesame"]);
    let page = |path: &str| format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n");
    let good = view.ask(page("/").as_bytes());
    assert!(good.starts_with("HTTP/1.1 200 OK\r\n") && good.ends_with("</html>\n"), "{good}");
    assert!(good.contains("Content-Security-Policy: default-src 'none'; script-src 'self'"));
    for (request, status) in [
        (page("/../../etc/passwd"), 404),
        (page("/%2e%2e/%2e%2e/etc/passwd"), 404),
        (page("/live"), 401),
        (page("/access?token=open-sesamE"), 401),
        (page("/live?token=open-sesame"), 426),
        (page("/").replace("localhost", "evil.example"), 403),
        (page("/").replace("GET", "DELETE"), 405),
        (page("/").replace("HTTP/1.1", "HTTP/9"), 400),
        ("\u{0}\u{1}\u{2} garbage \r\n\r\n".into(), 400),
        (format!("GET / HTTP/1.1\r\nX: {}\r\n\r\n", "x".repeat(100_000)), 431),
    ] {
        let answer = view.ask(request.as_bytes());
        let wanted = format!("HTTP/1.1 {status} ");
        assert!(
            answer.starts_with(&wanted),
            "{:.60}: {answer}",
            request.escape_debug().to_string()
        );
    }
    let refused = view.socket("?token=wrong-token").expect_err("it is wrong");
    assert!(refused.contains("401"), "{refused}");

    // An invalid message ends its own page, and no other.
    let mut other = view.socket("?token=open-sesame").expect("it is right");
    for nonsense in
        [Message::text("{}"), Message::binary(vec![0; 10]), Message::text("x".repeat(5_000))]
    {
        let mut page = view.socket("?token=open-sesame").expect("it is right");
        page.send(nonsense.clone()).expect("it listens");
        let start = Instant::now();
        while page.read().is_ok_and(|message| !message.is_close()) {
            assert!(start.elapsed() < WATCHDOG, "it is not closed: {nonsense:.20}");
        }
    }
    let many: Vec<_> =
        std::iter::from_fn(|| view.socket("?token=open-sesame").ok()).take(100).collect();
    assert_eq!(many.len(), 15, "sixteen pages are the most");
    let full = view.socket("?token=open-sesame").expect_err("it is full");
    assert!(full.contains("503"), "{full}");
    drop(many);

    // Ten thousand requests, of which some are cut off.
    std::thread::scope(|scope| {
        for thread in 0..4 {
            let (view, page) = (&view, &page);
            scope.spawn(move || {
                for number in 0..2_500 {
                    match (thread + number) % 5 {
                        0 => {
                            drop(TcpStream::connect(("127.0.0.1", view.port)).map(|mut stream| {
                                // Whether it is read or not.
                                let _ = stream.write_all(b"GET / HT");
                            }))
                        }
                        1 => drop(view.ask(b"\xff\xfe\r\n\r\n")),
                        2 => drop(view.ask(page("/live").as_bytes())),
                        3 => drop(view.ask(page("/nothing").as_bytes())),
                        _ => drop(view.ask(page("/maths.js").as_bytes())),
                    }
                }
            });
        }
    });
    let good = view.ask(page("/").as_bytes());
    assert!(good.starts_with("HTTP/1.1 200 OK\r\n"), "{good}");
    let Message::Text(text) = other.read().expect("it is still open") else { panic!("no text") };
    assert!(text.contains(r#""kind":"#), "{text}");

    // Killed again and again, it takes no place of the pipeline's with it.
    kill_process(view.process.pid(), Signal::KILL).expect("it runs");
    for _ in 0..5 {
        let view = View::of(&flight, &[]);
        let mut page = view.socket("").expect("there is room");
        page.send(Message::text(r#"{"pictures":true}"#)).expect("it listens");
        let start = Instant::now();
        while let Message::Text(text) = next(&mut page, start) {
            assert!(!text.contains("no pictures"), "{text}");
        }
        kill_process(view.process.pid(), Signal::KILL).expect("it runs");
    }
    flight.end_by(Signal::INT);
}
