//! Plays a recording to Foxglove's clients. All clients are at one position, because the protocol's
//! playback control is one per server.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use flockeye_contract::FrameStamp;
use foxglove::WebSocketServerHandle;
use foxglove::websocket::{
    Capability, PlaybackCommand, PlaybackControlRequest, PlaybackState, PlaybackStatus,
    ServerListener,
};

use super::Recorded;
use super::pictures::RecordedPictures;
use super::playhead::{NewFrames, Playhead};
use crate::foxglove_view::FoxgloveView;
use crate::remote::{Move, Remote};

/// Period at which the player advances and checks for requests.
const TICK: Duration = Duration::from_millis(20);
/// Period at which the stages are sent, and the current frame while paused: clients may have
/// subscribed since.
const REPORT_PERIOD: Duration = Duration::from_millis(500);

/// Requests of the clients, which arrive on the server's threads.
struct Control {
    recorded: Arc<Recorded>,
    remote: Arc<Remote>,
    /// The time that is shown, UTC nanoseconds.
    at_ns: Arc<AtomicU64>,
}

impl ServerListener for Control {
    fn on_playback_control_request(&self, asked: PlaybackControlRequest) -> Option<PlaybackState> {
        let Recorded { first_ns, last_ns, .. } = *self.recorded;
        let seek_ns = asked.seek_time.map(|to_ns| to_ns.clamp(first_ns, last_ns));
        if let Some(to_ns) = seek_ns {
            self.remote.ask(Move::Seek(self.recorded.seconds(to_ns)));
        }
        let plays = asked.playback_command == PlaybackCommand::Play && asked.playback_speed > 0.0;
        let speed = if plays { f64::from(asked.playback_speed) } else { 0.0 };
        self.remote.ask(Move::Play(speed));
        Some(PlaybackState {
            status: if plays { PlaybackStatus::Playing } else { PlaybackStatus::Paused },
            current_time: seek_ns.unwrap_or_else(|| self.at_ns.load(Ordering::Relaxed)),
            playback_speed: asked.playback_speed,
            did_seek: seek_ns.is_some(),
            request_id: Some(asked.request_id),
        })
    }
}

/// Serves a recording at `address`, in threads that end with the process. Returns the port.
///
/// # Errors
/// The address is in use or not this machine's, or no thread can be started.
pub(crate) fn start(address: SocketAddr, recorded: Arc<Recorded>) -> anyhow::Result<u16> {
    let (remote, at_ns) = (Arc::<Remote>::default(), Arc::new(AtomicU64::new(recorded.first_ns)));
    let control =
        Control { recorded: recorded.clone(), remote: remote.clone(), at_ns: at_ns.clone() };
    let Recorded { first_ns, last_ns, .. } = *recorded;
    let file = recorded.hello.recording.as_ref().map_or("", |recording| recording.file.as_str());
    let (view, server) = FoxgloveView::serve(address, file, &recorded.resolved, |server| {
        server
            .capabilities([Capability::Time, Capability::PlaybackControl])
            .playback_time_range(first_ns, last_ns)
            .listener(Arc::new(control))
    })?;
    let port = server.port();
    let pictures =
        recorded.images.is_some().then(|| RecordedPictures::new(recorded.clone())).transpose()?;
    std::thread::Builder::new().name("player".into()).spawn(move || {
        let head = Playhead::new(recorded.clone());
        let player = FoxglovePlayer { recorded, view, server, head, pictures, speed: 1.0, at_ns };
        player.run(&remote);
    })?;
    Ok(port)
}

struct FoxglovePlayer {
    recorded: Arc<Recorded>,
    view: FoxgloveView,
    server: WebSocketServerHandle,
    head: Playhead,
    pictures: Option<RecordedPictures>,
    speed: f64,
    at_ns: Arc<AtomicU64>,
}

impl FoxglovePlayer {
    /// Plays from the beginning, once a client has subscribed.
    fn run(mut self, remote: &Remote) {
        let (mut last, mut reported_at) = (Instant::now(), Instant::now());
        loop {
            let next = remote.next(TICK);
            let now = Instant::now();
            let passed = now - std::mem::replace(&mut last, now);
            if remote.is_closed() {
                return;
            }
            match next {
                Some((Move::Seek(to_s), _)) => {
                    self.head.seek(self.recorded.time_ns(to_s));
                    self.show(1);
                }
                Some((Move::Play(speed), _)) => {
                    if speed > 0.0 && self.head.is_at_end() {
                        self.head.seek(0);
                    }
                    self.speed = speed;
                }
                Some((Move::Step(_), _)) => {}
                None if !self.view.wanted().anything => continue,
                None if self.speed > 0.0 => self.go_on(passed),
                None => {}
            }
            if reported_at.elapsed() >= REPORT_PERIOD {
                reported_at = Instant::now();
                if self.speed == 0.0 {
                    self.show(1);
                }
                let at_ns = self.head.at_ns;
                let stages = self.head.tape.stages(at_ns);
                self.view.set_time(at_ns);
                self.view.stages(&stages);
            }
        }
    }

    fn go_on(&mut self, passed: Duration) {
        let on_ns = passed.as_nanos() as f64 * self.speed;
        let change = self.head.advance(self.head.at_ns.saturating_add(on_ns as u64));
        match change {
            NewFrames::All => self.show(1),
            NewFrames::Last(count) => self.show(count),
        }
        if self.head.is_at_end() {
            self.speed = 0.0;
            self.server.broadcast_playback_state(PlaybackState {
                status: PlaybackStatus::Ended,
                current_time: self.head.at_ns,
                playback_speed: 1.0,
                did_seek: false,
                request_id: None,
            });
        }
    }

    /// Sends the last `frames` frames up to the one that is shown, and its picture.
    fn show(&mut self, frames: usize) {
        self.at_ns.store(self.head.at_ns, Ordering::Relaxed);
        self.server.broadcast_time(self.head.at_ns);
        let recent = &self.head.recent;
        for seen in recent.iter().skip(recent.len().saturating_sub(frames)) {
            self.view.set_time(seen.utc_ns);
            self.view.frame(seen);
        }
        let wanted = self.view.wanted();
        if frames == 0 || !(wanted.pictures || wanted.closeups) {
            return;
        }
        let (Some(pictures), Some(seen)) = (&mut self.pictures, self.head.current()) else {
            return;
        };
        let of = |stamp: &FrameStamp| recent.iter().find(|seen| seen.stamp.is_same_frame(stamp));
        // A picture of an earlier frame was already shown with that frame.
        let nearest = pictures.nearest(&seen.stamp, seen.utc_ns);
        if self.speed > 0.0 && nearest.is_none_or(|nearest| !nearest.is_same_frame(&seen.stamp)) {
            return;
        }
        if let Some(picture) = pictures.picture(&seen.stamp, seen.utc_ns, of) {
            self.view.picture(&picture.stamp, of(&picture.stamp), picture.size, &picture.jpeg);
            for (head, jpeg) in &picture.closeups {
                self.view.closeup(&picture.stamp, head.target, jpeg);
            }
        }
    }
}
