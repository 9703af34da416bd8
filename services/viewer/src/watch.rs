//! The ports: reads the pipeline beside its stages, while a page is open, and hands pages and Foxglove's
//! clients what the core makes of it.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use flockeye_config::Flow;
use flockeye_contract::{
    Detections, FrameEnds, Healths, Peers, Plans, Rotations, Swarms, Topic, Tracks, Truths,
};
use flockeye_runtime::instance::Instance;
use flockeye_runtime::logs::Throttle;
use flockeye_runtime::ports::{Message, PortError, Ports, Subscriber};
use flockeye_runtime::{clock, onlooker};
use tungstenite::Message as PageMessage;

use crate::audience::Audience;
use crate::frame_reader::FrameReader;
use crate::outbox::Kind;
use crate::scene::{Ended, Scene};
use crate::setting;
use crate::stages::StageReports;
use crate::wire::{self, Status, Text};

/// How often stages and swarm are shown, nanoseconds.
const REPORT_PERIOD_NS: i64 = 500_000_000;
/// How often it is looked whether the pipeline still runs, nanoseconds.
const LIFE_PERIOD_NS: i64 = 1_000_000_000;
/// How long messages may gather before they are read: each waking costs time.
const GATHERING: Duration = Duration::from_millis(4);
/// At least so often it is looked what the pages want.
const LOOK_PERIOD: Duration = Duration::from_millis(50);
/// Waits for a page or a pipeline.
const IDLE_PERIOD: Duration = Duration::from_millis(200);

/// Shows one pipeline to the pages, and to Foxglove's clients.
pub struct Watch {
    instance: Instance,
    audience: Audience,
    rate: f64,
    stopping: Arc<AtomicBool>,
    status: Option<Status>,
    hello: Option<wire::Hello>,
    troubles: Throttle,
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
        Self { instance, audience, rate, stopping, status: None, hello: None, troubles }
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
            self.put(Kind::Status, &Text::Status(&status));
            self.status = Some(status);
        }
    }

    fn put(&self, kind: Kind, message: &Text<'_>) {
        self.audience.hub.put(kind, &PageMessage::text(wire::text(message)));
    }

    /// Follows the pipeline until nobody watches or the pipeline ends.
    fn follow(&mut self) -> anyhow::Result<()> {
        let (mut ports, resolved) = onlooker::join(&self.instance)?;
        ports.follow_hand_overs()?;
        let mut topics = Topics::open(&mut ports)?;
        let hello = setting::hello(&resolved, self.instance.name(), self.rate);
        if self.hello.as_ref() != Some(&hello) {
            self.put(Kind::Hello, &Text::Hello(&hello));
            if let Some(foxglove) = &mut self.audience.foxglove {
                foxglove.begin(&resolved)?;
            }
            self.hello = Some(hello);
        }
        let mut scene = Scene::new(resolved.pipeline.flow() == Flow::Latest);
        let mut stages = StageReports::default();
        let (mut report_ns, mut life_ns) = (0, 0);
        let mut frames = FrameReader::new(&ports, &resolved, self.rate);
        ports.attend(|| {
            let now_ns = clock::monotonic_ns();
            let wanted = self.audience.wanted();
            if self.is_stopping() || !wanted.anything {
                return Ok(None);
            }
            std::thread::sleep(GATHERING);
            let trouble = frames.receive(wanted, self.audience.takes_pictures(wanted), now_ns)?;
            self.say(Status { running: true, trouble });
            for ended in topics.receive(&mut scene, &mut stages, now_ns)? {
                self.put(Kind::Frame, &Text::Frame(&ended.message));
                self.audience.to_foxglove(|foxglove| foxglove.frame(&ended));
                frames.ended(&ended, &self.audience, wanted);
            }
            frames.overdue(&self.audience, wanted, now_ns);
            if now_ns - report_ns > REPORT_PERIOD_NS {
                report_ns = now_ns;
                let shown = stages.shown(now_ns);
                self.audience.to_foxglove(|foxglove| foxglove.stages(&shown));
                self.put(Kind::Stages, &Text::Stages(&shown));
                if let Some(swarm) = scene.swarm(now_ns) {
                    self.put(Kind::Swarm, &Text::Swarm(&swarm));
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
