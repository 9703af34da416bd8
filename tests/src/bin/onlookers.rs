//! Measures the cost of onlookers for a pipeline: `onlookers [SECONDS]` prints a table.
//!
//! Each row is a flight of the default pipeline: alone, with the view, or with a recorder. A
//! watcher is the socket of a page without a browser. It receives and acknowledges pictures. Its
//! own cost is not counted.

use std::net::TcpStream;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

use anyhow::Context;
use flockeye_require::loopback::free_port;
use flockeye_tests::{Flight, Scratch, flockeye, ticks_of, unique};
use rustix::process::Signal;
use tungstenite::Message;

/// Time after which a pipeline and its onlooker have settled.
const WARM_UP: Duration = Duration::from_secs(5);
/// Clock ticks of /proc per second.
const TICKS: f64 = 100.0;

/// The onlooker of a flight.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Onlooker {
    Nobody,
    ViewWithoutWatchers,
    ViewWithOneWatcher,
    RecorderOfHeaders,
}

impl Onlooker {
    const ALL: [Self; 4] = [
        Self::Nobody,
        Self::ViewWithoutWatchers,
        Self::ViewWithOneWatcher,
        Self::RecorderOfHeaders,
    ];

    fn words(self) -> &'static str {
        match self {
            Self::Nobody => "nobody",
            Self::ViewWithoutWatchers => "view, no watcher",
            Self::ViewWithOneWatcher => "view, one watcher",
            Self::RecorderOfHeaders => "recorder, --frames none",
        }
    }
}

fn main() -> anyhow::Result<()> {
    let seconds = std::env::args().nth(1).map_or(Ok(30), |text| text.parse())?;
    println!("beside the pipeline       of a core  pictures/s  frames searched  skipped");
    for onlooker in Onlooker::ALL {
        measure(onlooker, Duration::from_secs(seconds))?;
    }
    Ok(())
}

fn measure(onlooker: Onlooker, time: Duration) -> anyhow::Result<()> {
    let scratch = Scratch::new("onlookers");
    let mut flight = Flight::start("onlookers", &[], &["gateway.enabled=false"]);
    flight.wait_for("alpha confirmed");
    let port = free_port();
    let mut command = Command::new(flockeye());
    match onlooker {
        Onlooker::Nobody => {}
        Onlooker::ViewWithoutWatchers | Onlooker::ViewWithOneWatcher => {
            command.args(["view", "--listen", &format!("127.0.0.1:{port}")]);
        }
        Onlooker::RecorderOfHeaders => {
            command.arg("record").arg(scratch.path("flight.mcap")).args(["--frames", "none"]);
        }
    }
    command.args(["--instance", flight.instance.name()]);
    let mut beside =
        (onlooker != Onlooker::Nobody).then(|| Flight::launch(&unique("beside"), command));
    let watcher = match (onlooker, &mut beside) {
        (Onlooker::ViewWithOneWatcher, Some(view)) => {
            view.wait_for("the view of");
            Some(Watcher::start(port)?)
        }
        _ => None,
    };
    std::thread::sleep(WARM_UP);
    let pid = beside.as_ref().map(|beside| beside.pid().as_raw_nonzero().get().unsigned_abs());
    let ticks = || pid.map_or(Ok(0.0), ticks_of);
    let pictures =
        || watcher.as_ref().map_or(0, |watcher| watcher.pictures.load(Ordering::Relaxed));
    let (ticks_before, pictures_before, start) = (ticks()?, pictures(), Instant::now());
    std::thread::sleep(time);
    let elapsed = start.elapsed().as_secs_f64();
    let share = 100.0 * (ticks()? - ticks_before) / TICKS / elapsed;
    let rate = f64::from(pictures() - pictures_before) / elapsed;
    if let Some(watcher) = watcher {
        watcher.is_over.store(true, Ordering::Relaxed);
    }
    if let Some(beside) = &mut beside {
        beside.signal(Signal::INT);
        beside.wait();
    }
    flight.signal(Signal::INT);
    flight.wait();
    let output = flight.output();
    let (searched, skipped) =
        counted(&output).with_context(|| format!("no summary in\n{output}"))?;
    let of_core =
        if onlooker == Onlooker::Nobody { String::new() } else { format!("{share:.1} %") };
    let rate =
        if onlooker == Onlooker::ViewWithOneWatcher { format!("{rate:.1}") } else { String::new() };
    println!("{:<24} {of_core:>10}  {rate:>10}  {searched:>15}  {skipped:>7}", onlooker.words());
    Ok(())
}

/// The searched and the skipped frames in a flight's output.
fn counted(output: &str) -> Option<(u64, u64)> {
    let (before, after) = output.split_once(" frames searched, ")?;
    let searched = before.rsplit(|letter: char| !letter.is_ascii_digit()).next()?;
    let skipped = after.split(|letter: char| !letter.is_ascii_digit()).next()?;
    Some((searched.parse().ok()?, skipped.parse().ok()?))
}

/// The socket of a page that receives pictures.
struct Watcher {
    pictures: Arc<AtomicU32>,
    is_over: Arc<AtomicBool>,
}

impl Watcher {
    fn start(port: u16) -> anyhow::Result<Self> {
        let stream = TcpStream::connect(("127.0.0.1", port))?;
        stream.set_read_timeout(Some(Duration::from_secs(20)))?;
        let (mut page, _) = tungstenite::client(format!("ws://127.0.0.1:{port}/live"), stream)?;
        page.send(Message::text(r#"{"pictures":true}"#))?;
        let watcher = Self { pictures: Arc::default(), is_over: Arc::default() };
        let (pictures, is_over) = (watcher.pictures.clone(), watcher.is_over.clone());
        std::thread::spawn(move || {
            while !is_over.load(Ordering::Relaxed) {
                let Ok(message) = page.read() else { return };
                let Message::Binary(bytes) = message else { continue };
                let head = bytes.get(4..60).unwrap_or_default();
                if head.starts_with(br#"{"kind":"picture""#) {
                    pictures.fetch_add(1, Ordering::Relaxed);
                    if page.send(Message::text(r#"{"shown":1}"#)).is_err() {
                        return;
                    }
                }
            }
        });
        Ok(watcher)
    }
}
