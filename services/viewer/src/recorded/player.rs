//! Plays a recording to one page: the messages of a running pipeline, at the time of the page's
//! requests.

use std::sync::Arc;
use std::time::{Duration, Instant};

use flockeye_contract::FrameStamp;

use super::Recorded;
use super::pictures::RecordedPictures;
use super::playhead::{NewFrames, Playhead};
use crate::outbox::OutboxKind;
use crate::pages::OpenPage;
use crate::remote::{Move, Remote};
use crate::wire::{self, BinaryHead, TextMessage};

/// Period of playback.
const TICK: Duration = Duration::from_millis(15);
/// Period of the check whether the page can take a picture, while paused.
const LOOK: Duration = Duration::from_millis(500);
/// Maximum messages that wait for the page before playback continues.
const MOST_WAITING: usize = 24;
/// Period at which stages and swarm are shown while it plays.
const REPORT_PERIOD: Duration = Duration::from_millis(500);

/// Starts a player for a page, in a thread that ends with the page.
pub(crate) fn start(recorded: Arc<Recorded>, page: Arc<OpenPage>) -> std::io::Result<()> {
    let thread = std::thread::Builder::new().name("player".into());
    thread.spawn(move || {
        if let Some(remote) = &page.remote {
            Player::new(recorded, &page).run(remote);
        }
    })?;
    Ok(())
}

struct Player<'p> {
    recorded: Arc<Recorded>,
    page: &'p OpenPage,
    head: Playhead,
    pictures: Option<RecordedPictures>,
    speed: f64,
    answers: u64,
    /// The frame of the picture that the page shows, and when it was sent.
    shown: Option<FrameStamp>,
    shown_at: Instant,
    reported_at: Instant,
}

impl<'p> Player<'p> {
    fn new(recorded: Arc<Recorded>, page: &'p OpenPage) -> Self {
        let pictures = recorded.images.is_some().then(|| RecordedPictures::new(recorded.clone()));
        let pictures = pictures.transpose().inspect_err(|error| tracing::warn!("{error:#}"));
        let now = Instant::now();
        Self {
            head: Playhead::new(recorded.clone()),
            pictures: pictures.unwrap_or_default(),
            recorded,
            page,
            speed: 0.0,
            answers: 0,
            shown: None,
            shown_at: now,
            reported_at: now,
        }
    }

    fn run(&mut self, remote: &Remote) {
        self.tell(NewFrames::All);
        let mut last = Instant::now();
        loop {
            let wait = if self.speed > 0.0 { TICK } else { LOOK };
            let next = remote.next(wait);
            let now = Instant::now();
            let passed = now - std::mem::replace(&mut last, now);
            if remote.is_closed() {
                return;
            }
            match next {
                Some((wish, answers)) => {
                    self.answers = answers;
                    let change = self.go(wish);
                    self.tell(change);
                    last = Instant::now();
                }
                None if self.speed > 0.0 => self.go_on(passed),
                None => self.show_picture(),
            }
            // A slow page delays the following frames.
            while self.page.outbox(|outbox| outbox.waiting()) >= MOST_WAITING && !remote.is_closed()
            {
                std::thread::sleep(TICK);
                last = Instant::now();
            }
        }
    }

    fn go(&mut self, wish: Move) -> NewFrames {
        match wish {
            Move::Seek(to_s) => self.head.seek(self.recorded.time_ns(to_s)),
            Move::Step(frames) => {
                self.speed = 0.0;
                self.head.step(frames)
            }
            Move::Play(speed) => {
                self.speed = speed;
                // At the end of the recording it starts again from the beginning.
                match speed > 0.0 && self.head.is_at_end() {
                    true => self.head.seek(0),
                    false => NewFrames::Last(0),
                }
            }
        }
    }

    fn go_on(&mut self, passed: Duration) {
        let on_ns = passed.as_nanos() as f64 * self.speed;
        let change = self.head.advance(self.head.at_ns.saturating_add(on_ns as u64));
        if self.head.is_at_end() {
            self.speed = 0.0;
        }
        self.tell(change);
    }

    /// Sends the page what has changed, and then its position.
    fn tell(&mut self, change: NewFrames) {
        let recent = &self.head.recent;
        let new = match change {
            NewFrames::All => recent.len(),
            NewFrames::Last(count) => count.min(recent.len()),
        };
        for seen in recent.iter().skip(recent.len() - new) {
            self.put(&TextMessage::Frame(&seen.message));
        }
        if change == NewFrames::All {
            // The page has dropped the frames of the old close-ups.
            self.shown = None;
        }
        self.show_picture();
        self.tell_position();
        let is_time = self.reported_at.elapsed() >= REPORT_PERIOD;
        if change == NewFrames::All || self.speed == 0.0 || is_time {
            self.reported_at = Instant::now();
            let at_ns = self.head.at_ns;
            let stages = self.head.tape.stages(at_ns);
            self.put(&TextMessage::Stages { stages: &stages });
            if let Some((drones, sightings)) = self.head.tape.swarm(at_ns) {
                let (drones, sightings) = (&drones[..], &sightings[..]);
                self.put(&TextMessage::Swarm { drones, sightings });
            }
        }
        let trouble = self.head.tape.trouble();
        let of_pictures = self.pictures.as_mut().and_then(RecordedPictures::trouble);
        if let Some(trouble) = trouble.or(of_pictures) {
            self.put(&TextMessage::Status { running: true, trouble: &trouble });
        }
    }

    fn tell_position(&mut self) {
        let current = self.head.current();
        let nearest = match (current, &mut self.pictures) {
            (Some(seen), Some(pictures)) => pictures.nearest(&seen.stamp, seen.utc_ns),
            _ => None,
        };
        self.put(&TextMessage::Position {
            key: current.map(|seen| seen.message.key.as_str()),
            at_s: self.recorded.seconds(self.head.at_ns),
            speed: self.speed,
            picture: nearest.as_ref().map(wire::key).as_deref(),
            answers: self.answers,
        });
    }

    /// Shows the nearest picture before the frame, if it is another one and the page accepts
    /// pictures.
    fn show_picture(&mut self) {
        let (Some(pictures), Some(seen)) = (&mut self.pictures, self.head.current()) else {
            return;
        };
        if !self.page.outbox(|outbox| outbox.takes_pictures()) {
            return;
        }
        let period = Duration::from_secs_f64(1.0 / f64::from(self.recorded.hello.rate));
        if self.speed > 0.0 && self.shown.is_some() && self.shown_at.elapsed() < period {
            return;
        }
        let Some(nearest) = pictures.nearest(&seen.stamp, seen.utc_ns) else { return };
        if self.shown.is_some_and(|shown| shown.is_same_frame(&nearest)) {
            return;
        }
        let recent = &self.head.recent;
        let of = |stamp: &FrameStamp| recent.iter().find(|seen| seen.stamp.is_same_frame(stamp));
        // A frame that cannot be shown is tried only once.
        (self.shown, self.shown_at) = (Some(nearest), Instant::now());
        let Some(picture) = pictures.picture(&seen.stamp, seen.utc_ns, of) else { return };
        let key = wire::key(&picture.stamp);
        let head = BinaryHead::Picture { key, size: picture.size };
        self.page.put(OutboxKind::Picture, wire::binary(&head, &picture.jpeg));
        for (head, jpeg) in picture.closeups {
            let kind = OutboxKind::Closeup(head.target);
            self.page.put(kind, wire::binary(&BinaryHead::Closeup(head), &jpeg));
        }
    }

    fn put(&self, message: &TextMessage<'_>) {
        self.page.put(OutboxKind::Answer, wire::text(message));
    }
}
