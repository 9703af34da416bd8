//! Reads frames beside the stages while pictures or close-ups are requested, and makes these.

use flockeye_config::Resolved;
use flockeye_contract::{Frames, Track, TrackState};
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Message, PortError, Ports, Subscriber};

use crate::audience::Audience;
use crate::closeup::CloseupMaker;
use crate::held::Held;
use crate::outbox::OutboxKind;
use crate::pages::Demand;
use crate::picture::PictureMaker;
use crate::scene::EndedFrame;
use crate::wire::{self, BinaryHead};

/// Pause before a reader that could not be opened is tried again, nanoseconds.
const RETRY_PERIOD_NS: i64 = 3_000_000_000;
/// Maximum close-ups for each picture; more would cost more than the picture.
const CLOSEUPS: usize = 2;

/// Reads frames while a page or client requests pictures.
pub(crate) struct FrameReader<'p> {
    ports: &'p Ports,
    resolved: &'p Resolved,
    rate: f64,
    pictures: Option<FramePictures>,
    /// The reason why there are no pictures, and the time of the next try.
    trouble: Option<(String, i64)>,
    /// Index of the neighbour whose close-up is next.
    turn: usize,
}

impl<'p> FrameReader<'p> {
    /// Starts without frames. `rate`: maximum pictures per second.
    pub(crate) fn new(ports: &'p Ports, resolved: &'p Resolved, rate: f64) -> Self {
        Self { ports, resolved, rate, pictures: None, trouble: None, turn: 0 }
    }

    /// Starts or stops to read, and holds the newest frame while a picture of it `is_due`. Returns
    /// the reason why requested pictures are missing.
    ///
    /// # Errors
    /// Frames cannot be read any more.
    pub(crate) fn receive(
        &mut self,
        wanted: Demand,
        is_due: bool,
        now_ns: i64,
    ) -> Result<String, PortError> {
        if !(wanted.pictures || wanted.closeups) {
            (self.pictures, self.trouble) = (None, None);
            return Ok(String::new());
        }
        // While a stage is replaced there may be no free place among the readers.
        let is_time = self.trouble.as_ref().is_none_or(|(_, retry_ns)| now_ns > *retry_ns);
        if self.pictures.is_none() && is_time {
            match FramePictures::open(self.ports, self.resolved, self.rate) {
                Ok(pictures) => (self.pictures, self.trouble) = (Some(pictures), None),
                Err(error) => {
                    let retry_ns = now_ns + RETRY_PERIOD_NS;
                    self.trouble = Some((format!("no pictures: {error:#}"), retry_ns));
                }
            }
        }
        if let Some(pictures) = &mut self.pictures {
            pictures.receive(is_due)?;
        }
        Ok(self.trouble.as_ref().map(|(trouble, _)| trouble.clone()).unwrap_or_default())
    }

    /// Shows an ended frame, if a picture of it is due.
    pub(crate) fn ended(&mut self, ended: &EndedFrame, audience: &Audience, wanted: Demand) {
        let Some(pictures) = &mut self.pictures else { return };
        let Some(frame) = pictures.held.ended(&ended.stamp) else { return };
        if wanted.pictures {
            pictures.show(&frame, Some(ended), audience);
        }
        if wanted.closeups {
            let tracks: Vec<&Track> = ended.tracks.iter().filter(is_shown_closely).collect();
            // The neighbours take turns.
            for step in 0..tracks.len().min(CLOSEUPS) {
                let track = tracks[(self.turn + step) % tracks.len()];
                pictures.show_closely(&frame, track, &ended.message.key, audience);
            }
            self.turn = self.turn.wrapping_add(CLOSEUPS);
        }
    }

    /// Shows a frame that has not ended within the timeout.
    pub(crate) fn overdue(&mut self, audience: &Audience, wanted: Demand, now_ns: i64) {
        if let Some(pictures) = &mut self.pictures
            && let Some((_, frame)) = pictures.held.overdue(now_ns)
            && wanted.pictures
        {
            pictures.show(&frame, None, audience);
        }
    }
}

/// Whether a track gets a close-up.
pub(crate) fn is_shown_closely(track: &&Track) -> bool {
    TrackState::try_from(track.state).is_ok_and(TrackState::is_present)
}

/// An open reader of frames, and the makers of pictures.
struct FramePictures {
    frames: Subscriber<Frames>,
    held: Held<Message<Frames>>,
    maker: PictureMaker,
    closeups: CloseupMaker,
    troubles: Throttle,
    /// Dropped with this value, which frees its place among the readers of frames.
    _ports: Ports,
}

impl FramePictures {
    fn open(ports: &Ports, resolved: &Resolved, rate: f64) -> anyhow::Result<Self> {
        let mut ports = ports.beside();
        Ok(Self {
            frames: ports.subscriber()?,
            held: Held::new((1e9 / rate) as i64),
            maker: PictureMaker::new(&resolved.camera)?,
            closeups: CloseupMaker::new(resolved)?,
            troubles: Throttle::default(),
            _ports: ports,
        })
    }

    /// Holds the newest frame while a picture is due, and drops it otherwise.
    fn receive(&mut self, is_due: bool) -> Result<(), PortError> {
        if !is_due {
            self.held.clear();
        }
        if let Some(message) = self.frames.newest()?
            && is_due
        {
            self.held.frame(message.header.stamp, message);
        }
        Ok(())
    }

    fn show(&mut self, frame: &Message<Frames>, ended: Option<&EndedFrame>, audience: &Audience) {
        let size = self.maker.size();
        let stamp = &frame.header.stamp;
        match self.maker.jpeg(&frame.header, frame.items()) {
            Ok(jpeg) => {
                let head = BinaryHead::Picture { key: wire::key(stamp), size };
                audience.pages.put(OutboxKind::Picture, &wire::binary(&head, jpeg));
                audience.to_foxglove(|foxglove| foxglove.picture(stamp, ended, size, jpeg));
            }
            Err(error) => self.complain(&error),
        }
    }

    fn show_closely(
        &mut self,
        frame: &Message<Frames>,
        track: &Track,
        key: &str,
        audience: &Audience,
    ) {
        match self.closeups.closeup(&frame.header, frame.items(), track, key) {
            Ok(Some((head, jpeg))) => {
                let message = wire::binary(&BinaryHead::Closeup(head), &jpeg);
                audience.pages.put(OutboxKind::Closeup(track.target), &message);
                let stamp = &frame.header.stamp;
                audience.to_foxglove(|foxglove| foxglove.closeup(stamp, track.target, &jpeg));
            }
            Ok(None) => {}
            Err(error) => self.complain(&error),
        }
    }

    fn complain(&mut self, error: &dyn std::fmt::Display) {
        if let Some(more) = self.troubles.admit() {
            tracing::warn!(more_since = more, "a frame cannot be shown: {error:#}");
        }
    }
}
