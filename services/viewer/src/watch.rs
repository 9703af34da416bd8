//! The ports: reads the pipeline beside its stages, while a page is open, and hands pages and Foxglove's
//! clients what the core makes of it.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use flockeye_config::{Flow, Resolved};
use flockeye_contract::{
    Detections, FrameEnds, Frames, Healths, Peers, Plans, Rotations, Swarms, Topic, Track,
    TrackState, Tracks, Truths,
};
use flockeye_runtime::instance::Instance;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Message, PortError, Ports, Subscriber};
use flockeye_runtime::{clock, onlooker};
use tungstenite::Message as PageMessage;

use crate::closeup::CloseupMaker;
use crate::foxglove_view::FoxgloveView;
use crate::held::Held;
use crate::hub::{Hub, Wanted};
use crate::outbox::Kind;
use crate::picture::PictureMaker;
use crate::scene::{Ended, Scene};
use crate::setting;
use crate::stages::StageReports;
use crate::wire::{self, Head, PictureHead, Status, Text};

/// How often stages and swarm are shown, nanoseconds.
const REPORT_PERIOD_NS: i64 = 500_000_000;
/// How often it is looked whether the pipeline still runs, nanoseconds.
const LIFE_PERIOD_NS: i64 = 1_000_000_000;
/// Pictures that could not be had are tried again after this long, nanoseconds.
const RETRY_PERIOD_NS: i64 = 3_000_000_000;
/// How long messages may gather before they are read: each waking costs time.
const GATHERING: Duration = Duration::from_millis(4);
/// At least so often it is looked what the pages want.
const LOOK_PERIOD: Duration = Duration::from_millis(50);
/// Waits for a page or a pipeline.
const IDLE_PERIOD: Duration = Duration::from_millis(200);
/// Close-ups for each picture: more would cost more than the picture.
const CLOSEUPS: usize = 2;

/// Shows one pipeline to the pages, and to Foxglove's clients.
pub struct Watch {
    instance: Instance,
    audience: Audience,
    rate: f64,
    stopping: Arc<AtomicBool>,
    status: Option<Status>,
    hello: Option<wire::Hello>,
    troubles: Throttle,
    turn: usize,
}

impl Watch {
    /// `rate`: pictures a second at most.
    pub fn new(
        instance: Instance,
        audience: Audience,
        rate: f64,
        stopping: Arc<AtomicBool>,
    ) -> Self {
        let troubles = Throttle::default();
        Self { instance, audience, rate, stopping, status: None, hello: None, troubles, turn: 0 }
    }

    /// Shows it until it is told to stop. While no page is open, or the pipeline does not run, it waits.
    pub fn run(&mut self) {
        while !self.is_stopping() {
            if !self.audience.wanted().anything {
                self.audience.hub.wait(IDLE_PERIOD);
                continue;
            }
            if !self.instance.is_running() {
                self.say(Status { running: false, trouble: String::new() });
                self.audience.hub.wait(IDLE_PERIOD);
                continue;
            }
            if let Err(error) = self.follow() {
                // A pipeline that just starts or ends has no services: it is tried again.
                if let Some(more) = self.troubles.admit() {
                    tracing::warn!(more_since = more, "the pipeline cannot be followed: {error:#}");
                }
                self.say(Status { running: true, trouble: format!("{error:#}") });
                std::thread::sleep(IDLE_PERIOD);
            }
        }
    }

    fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Relaxed)
    }

    /// Tells the pages what is wrong, where that has changed.
    fn say(&mut self, status: Status) {
        if self.status.as_ref() != Some(&status) {
            self.put(Kind::Status, &Text::Status(status.clone()));
            self.status = Some(status);
        }
    }

    fn put(&self, kind: Kind, message: &Text) {
        self.audience.hub.put(kind, &PageMessage::text(wire::text(message)));
    }

    /// Follows the pipeline until the pages want something else or the pipeline ends.
    fn follow(&mut self) -> anyhow::Result<()> {
        let wanted = self.audience.wanted();
        let (mut ports, resolved) = onlooker::join(&self.instance)?;
        ports.follow_hand_overs()?;
        let mut topics = Topics::open(&mut ports)?;
        let mut trouble = String::new();
        let mut pictures =
            match wanted.pictures.then(|| Pictures::open(&mut ports, &resolved, self.rate)) {
                None => None,
                Some(Ok(pictures)) => Some(pictures),
                Some(Err(error)) => {
                    trouble = format!("no pictures: {error:#}");
                    None
                }
            };
        let hello = setting::hello(&resolved, self.instance.name(), self.rate);
        if self.hello.as_ref() != Some(&hello) {
            self.put(Kind::Hello, &Text::Hello(Box::new(hello.clone())));
            if let Some(foxglove) = &mut self.audience.foxglove {
                foxglove.begin(&resolved)?;
            }
            self.hello = Some(hello);
        }
        // While a stage is swapped there may be no room.
        let retry_ns = match trouble.is_empty() {
            true => i64::MAX,
            false => clock::monotonic_ns() + RETRY_PERIOD_NS,
        };
        self.say(Status { running: true, trouble });
        let mut scene = Scene::new(resolved.pipeline.flow == Flow::Latest);
        let mut stages = StageReports::default();
        let (mut report_ns, mut life_ns) = (0, 0);
        ports.attend(|| {
            let now_ns = clock::monotonic_ns();
            if self.is_stopping() || self.audience.wanted() != wanted || now_ns > retry_ns {
                return Ok(None);
            }
            std::thread::sleep(GATHERING);
            if let Some(pictures) = &mut pictures {
                pictures.receive(self.audience.takes_pictures())?;
            }
            for ended in topics.receive(&mut scene, &mut stages, now_ns)? {
                self.put(Kind::Frame, &Text::Frame(Box::new(ended.message.clone())));
                self.audience.to_foxglove(|foxglove| foxglove.frame(&ended));
                if let Some(pictures) = &mut pictures {
                    pictures.ended(&ended, &self.audience, &mut self.turn);
                }
            }
            if let Some(pictures) = &mut pictures {
                pictures.overdue(&self.audience, now_ns);
            }
            if now_ns - report_ns > REPORT_PERIOD_NS {
                report_ns = now_ns;
                let shown = stages.shown(now_ns);
                self.audience.to_foxglove(|foxglove| foxglove.stages(&shown));
                self.put(Kind::Stages, &Text::Stages(shown));
                if let Some(swarm) = scene.swarm(now_ns) {
                    self.put(Kind::Swarm, &Text::Swarm(swarm));
                }
            }
            if now_ns - life_ns > LIFE_PERIOD_NS {
                life_ns = now_ns;
                if !self.instance.is_running() {
                    return Ok(None);
                }
            }
            Ok(Some(LOOK_PERIOD))
        })
    }
}

/// Who watches.
pub struct Audience {
    /// Pages.
    pub hub: Arc<Hub>,
    /// Foxglove's clients, where they are served.
    pub foxglove: Option<FoxgloveView>,
}

impl Audience {
    fn wanted(&self) -> Wanted {
        let wanted = self.foxglove.as_ref().map(FoxgloveView::wanted).unwrap_or_default();
        self.hub.wanted().or(wanted)
    }

    fn takes_pictures(&self) -> bool {
        self.hub.takes_pictures()
            || self.foxglove.as_ref().is_some_and(|foxglove| foxglove.wanted().pictures)
    }

    fn to_foxglove(&self, tell: impl FnOnce(&FoxgloveView)) {
        if let Some(foxglove) = &self.foxglove {
            tell(foxglove);
        }
    }
}

/// Subscribers of everything but frames.
struct Topics {
    plans: Subscriber<Plans>,
    detections: Subscriber<Detections>,
    ends: Subscriber<FrameEnds>,
    rotations: Subscriber<Rotations>,
    truths: Subscriber<Truths>,
    tracks: Subscriber<Tracks>,
    healths: Subscriber<Healths>,
    peers: Subscriber<Peers>,
    swarms: Subscriber<Swarms>,
}

impl Topics {
    fn open(ports: &mut Ports) -> Result<Self, PortError> {
        Ok(Self {
            plans: ports.subscriber()?,
            detections: ports.subscriber()?,
            ends: ports.subscriber()?,
            rotations: ports.subscriber()?,
            truths: ports.subscriber()?,
            tracks: ports.subscriber()?,
            healths: ports.subscriber()?,
            peers: ports.subscriber()?,
            swarms: ports.subscriber()?,
        })
    }

    /// Hands on what has come. Tracks are the last: what belongs to their frame comes before them.
    fn receive(
        &mut self,
        scene: &mut Scene,
        stages: &mut StageReports,
        now_ns: i64,
    ) -> Result<Vec<Ended>, PortError> {
        let mut tracks = Vec::new();
        // Taken first: what they end has come by now.
        each(&mut self.tracks, |message| tracks.push((message.header, message.items().to_vec())))?;
        each(&mut self.plans, |message| scene.plan(&message.header, message.items()))?;
        each(&mut self.detections, |message| scene.detection(&message.header, message.items()))?;
        each(&mut self.ends, |message| scene.frame_end(&message.header))?;
        each(&mut self.rotations, |message| scene.rotation(&message.header))?;
        each(&mut self.truths, |message| scene.truth(&message.header, message.items()))?;
        each(&mut self.healths, |message| stages.health(&message.header))?;
        each(&mut self.peers, |message| scene.sightings(&message.header, message.items()))?;
        each(&mut self.swarms, |message| scene.drones(&message.header, message.items()))?;
        let ended = tracks.iter().filter_map(|(header, items)| scene.tracks(header, items, now_ns));
        Ok(ended.collect())
    }
}

fn each<T: Topic>(
    subscriber: &mut Subscriber<T>,
    mut take: impl FnMut(&Message<T>),
) -> Result<(), PortError> {
    while let Some(message) = subscriber.receive()? {
        take(&message);
    }
    Ok(())
}

/// What makes pictures of frames.
struct Pictures {
    frames: Subscriber<Frames>,
    held: Held<Message<Frames>>,
    maker: PictureMaker,
    closeups: CloseupMaker,
    troubles: Throttle,
}

impl Pictures {
    fn open(ports: &mut Ports, resolved: &Resolved, rate: f64) -> anyhow::Result<Self> {
        Ok(Self {
            frames: ports.subscriber()?,
            held: Held::new((1e9 / rate) as i64),
            maker: PictureMaker::new(&resolved.camera)?,
            closeups: CloseupMaker::new(resolved)?,
            troubles: Throttle::default(),
        })
    }

    /// Holds the newest frame while a picture is due, and lets it go otherwise.
    fn receive(&mut self, is_wanted: bool) -> Result<(), PortError> {
        if !is_wanted {
            self.held.clear();
        }
        if let Some(message) = self.frames.newest()?
            && is_wanted
        {
            self.held.frame(message.header.stamp, message);
        }
        Ok(())
    }

    /// Shows a frame that has ended, if it is the one that a picture is due of.
    fn ended(&mut self, ended: &Ended, audience: &Audience, turn: &mut usize) {
        let Some(frame) = self.held.ended(&ended.stamp) else { return };
        self.show(&frame, Some(ended), audience);
        let is_shown = |track: &&Track| {
            matches!(
                TrackState::try_from(track.state),
                Ok(TrackState::Confirmed | TrackState::Coasting | TrackState::Measured)
            )
        };
        let tracks: Vec<&Track> = ended.tracks.iter().filter(is_shown).collect();
        // Each neighbour in turn.
        for step in 0..tracks.len().min(CLOSEUPS) {
            let track = tracks[(*turn + step) % tracks.len()];
            self.show_closely(&frame, track, &ended.message.key, audience);
        }
        *turn = turn.wrapping_add(CLOSEUPS);
    }

    /// Shows a frame that does not end.
    fn overdue(&mut self, audience: &Audience, now_ns: i64) {
        if let Some((_, frame)) = self.held.overdue(now_ns) {
            self.show(&frame, None, audience);
        }
    }

    fn show(&mut self, frame: &Message<Frames>, ended: Option<&Ended>, audience: &Audience) {
        let size = self.maker.size();
        let stamp = &frame.header.stamp;
        match self.maker.jpeg(&frame.header, frame.items()) {
            Ok(jpeg) => {
                let head = Head::Picture(PictureHead { key: wire::key(stamp), size });
                let message = PageMessage::binary(wire::binary(&head, jpeg));
                audience.hub.put(Kind::Picture, &message);
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
                let message = wire::binary(&Head::Closeup(head), &jpeg);
                audience.hub.put(Kind::Closeup(track.target), &PageMessage::binary(message));
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
