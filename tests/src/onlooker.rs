//! A reader of a pipeline's own messages, like a viewer.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use flockeye_contract::{
    FrameEnd, FrameEnds, Rotation, Rotations, Topic, Track, TrackHeader, Tracks, TruthHeader,
    Truths,
};
use flockeye_runtime::onlooker;
use flockeye_runtime::ports::{Ports, Subscriber};

use crate::{Flight, Scratch, WATCHDOG, flockeye};

/// Joins a pipeline like a tool, once its launcher has written the configuration.
pub fn join(flight: &mut Flight) -> Ports {
    retry(flight, |flight| Some(onlooker::join(&flight.instance).ok()?.0))
}

/// Subscribes to a topic, once the launcher has created it.
pub fn subscribe<T: Topic>(flight: &mut Flight, ports: &mut Ports) -> Subscriber<T> {
    retry(flight, |_| ports.subscriber().ok())
}

fn retry<R>(flight: &mut Flight, mut attempt: impl FnMut(&Flight) -> Option<R>) -> R {
    let start = Instant::now();
    loop {
        if let Some(result) = attempt(flight) {
            return result;
        }
        let is_hopeless = flight.has_ended() || start.elapsed() > WATCHDOG;
        assert!(!is_hopeless, "there is nothing to join:\n{}", flight.output());
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A simulated flight whose source waits until a gate opens. Without a gate an onlooker would miss
/// the first messages.
pub struct Gated {
    /// The flight.
    pub flight: Flight,
    gate: PathBuf,
}

impl Gated {
    /// Starts the flight. After the return it can be joined. The gate is a file in `scratch`.
    pub fn start(name: &str, scratch: &Scratch, arguments: &[&str], set: &[&str]) -> Self {
        let gate = scratch.path("gate");
        let source = format!(
            r#"stages.simulator.command=["sh","-c","while [ ! -e '{}' ]; do sleep 0.02; done; exec '{}'"]"#,
            gate.display(),
            flockeye().with_file_name("flockeye-simulator").display()
        );
        let set: Vec<&str> = set.iter().copied().chain([source.as_str()]).collect();
        let mut flight = Flight::start(name, arguments, &set);
        let mut ports = join(&mut flight);
        drop(subscribe::<Tracks>(&mut flight, &mut ports));
        Self { flight, gate }
    }

    /// Opens the gate, which starts the frames.
    pub fn open(&self) {
        std::fs::write(&self.gate, "").expect("the gate can be opened");
    }
}

/// All messages of egomotion, fusion and rectification about a simulated flight's frames, and the
/// truth.
pub struct Tape {
    /// The messages of `track` in order of arrival.
    pub tracks: Vec<(TrackHeader, Vec<Track>)>,
    /// The messages of `frame_end`.
    pub ends: Vec<FrameEnd>,
    /// The messages of `rotation`.
    pub rotations: Vec<Rotation>,
    /// The headers of `truth`.
    pub truths: Vec<TruthHeader>,
    /// Output of the launcher.
    pub output: String,
}

impl Tape {
    /// Runs a flight to its end, and records it from its first frame on.
    pub fn record(name: &str, arguments: &[&str], set: &[&str]) -> Self {
        let scratch = Scratch::new(name);
        let mut gated = Gated::start(name, &scratch, arguments, set);
        let mut ports = join(&mut gated.flight);
        let mut tracks = subscribe::<Tracks>(&mut gated.flight, &mut ports);
        let mut ends = subscribe::<FrameEnds>(&mut gated.flight, &mut ports);
        let mut rotations = subscribe::<Rotations>(&mut gated.flight, &mut ports);
        let mut truths = subscribe::<Truths>(&mut gated.flight, &mut ports);
        gated.open();
        let mut flight = gated.flight;
        let mut tape = Self {
            tracks: Vec::new(),
            ends: Vec::new(),
            rotations: Vec::new(),
            truths: Vec::new(),
            output: String::new(),
        };
        let start = Instant::now();
        let mut ended = false;
        ports
            .attend(|| {
                let was_ended = ended;
                while let Some(message) = tracks.receive()? {
                    tape.tracks.push((message.header, message.items().to_vec()));
                }
                while let Some(message) = ends.receive()? {
                    tape.ends.push(message.header);
                }
                while let Some(message) = rotations.receive()? {
                    tape.rotations.push(message.header);
                }
                while let Some(message) = truths.receive()? {
                    tape.truths.push(message.header);
                }
                assert!(start.elapsed() < WATCHDOG, "it does not end:\n{}", flight.output());
                ended = flight.has_ended();
                Ok((!was_ended).then_some(Duration::from_millis(50)))
            })
            .expect("messages can be waited for");
        drop((tracks, ends, rotations, truths, ports));
        assert!(flight.wait().success(), "{}", flight.output());
        flight.assert_nothing_left();
        tape.output = flight.output();
        tape
    }

    /// Fails unless each of `count` frames has exactly one end and exactly one last message of
    /// tracks.
    pub fn assert_every_frame_ended_once(&self, count: u64) {
        let wanted: Vec<u64> = (0..count).collect();
        let mut ended: Vec<_> = self.ends.iter().map(|end| end.stamp.sequence).collect();
        ended.sort_unstable();
        assert_eq!(ended, wanted, "frames that ended:\n{}", self.output);
        let last = self.tracks.iter().filter(|(header, _)| header.is_last != 0);
        let closed: Vec<_> = last.map(|(header, _)| header.stamp.sequence).collect();
        assert_eq!(closed, wanted, "frames of which the last word was said:\n{}", self.output);
    }
}
