//! The ports: reads the pipeline beside its stages while a page is open, and sends the scene to
//! pages and clients.

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

use crate::audience::Audience;
use crate::frame_reader::FrameReader;
use crate::scene::{EndedFrame, PageScene};
use crate::setting;
use crate::wire::{self, TextMessage};

/// Period at which stages and swarm are shown, nanoseconds.
const REPORT_PERIOD_NS: i64 = 500_000_000;
/// Period of the check whether the pipeline still runs, nanoseconds.
const LIFE_PERIOD_NS: i64 = 1_000_000_000;
/// Time for which messages gather before they are read: each wake-up costs time.
const GATHERING: Duration = Duration::from_millis(4);
/// Maximum period between checks of the pages' requests.
const LOOK_PERIOD: Duration = Duration::from_millis(50);
/// Pause while there is no page or no pipeline.
const IDLE_PERIOD: Duration = Duration::from_millis(200);

/// Shows one pipeline to the pages, and to Foxglove's clients.
pub(crate) struct PipelineWatch {
    instance: Instance,
    audience: Audience,
    rate: f64,
    stopping: Arc<AtomicBool>,
    /// The last status sent to the pages: whether the pipeline runs, and the reason why there are
    /// no pictures.
    status: Option<(bool, String)>,
    hello: Option<wire::Hello>,
    troubles: Throttle,
}

impl PipelineWatch {
    /// A watch that has not read anything. `rate`: maximum pictures per second.
    pub(crate) fn new(
        instance: Instance,
        audience: Audience,
        rate: f64,
        stopping: Arc<AtomicBool>,
    ) -> Self {
        let troubles = Throttle::default();
        Self { instance, audience, rate, stopping, status: None, hello: None, troubles }
    }

    /// Shows the pipeline until the stop flag is set. Waits while no page is open or the pipeline
    /// does not run.
    pub(crate) fn run(&mut self) {
        while !self.is_stopping() {
            if !self.audience.wanted().anything {
                self.audience.pages.wait(IDLE_PERIOD);
                continue;
            }
            if !self.instance.is_running() {
                self.say(false, String::new());
                self.audience.pages.wait(IDLE_PERIOD);
                continue;
            }
            if let Err(error) = self.follow() {
                // A pipeline that starts or ends has no services yet or any more, so it is tried
                // again.
                if let Some(more) = self.troubles.admit() {
                    tracing::warn!(more_since = more, "the pipeline cannot be followed: {error:#}");
                }
                self.say(true, format!("{error:#}"));
                std::thread::sleep(IDLE_PERIOD);
            }
        }
    }

    fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::Relaxed)
    }

    /// Sends the status to the pages, where it has changed.
    fn say(&mut self, running: bool, trouble: String) {
        let status = Some((running, trouble));
        if self.status != status {
            self.status = status;
            let trouble = self.status.as_ref().map_or("", |(_, trouble)| trouble);
            self.audience.pages.tell(&TextMessage::Status { running, trouble });
        }
    }

    /// Follows the pipeline until no page or client is left, or the pipeline ends.
    fn follow(&mut self) -> anyhow::Result<()> {
        let (mut ports, resolved) = onlooker::join(&self.instance)?;
        ports.follow_hand_overs()?;
        let mut topics = Subscribers::open(&mut ports)?;
        let hello = setting::hello(&resolved, self.instance.name(), self.rate);
        if self.hello.as_ref() != Some(&hello) {
            self.audience.pages.tell(&TextMessage::Hello(&hello));
            if let Some(foxglove) = &mut self.audience.foxglove {
                foxglove.begin(&resolved)?;
            }
            self.hello = Some(hello);
        }
        let mut scene = PageScene::new(resolved.pipeline.flow() == Flow::Latest);
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
            self.say(true, trouble);
            for ended in topics.receive(&mut scene, now_ns)? {
                self.audience.pages.tell(&TextMessage::Frame(&ended.message));
                self.audience.to_foxglove(|foxglove| foxglove.frame(&ended));
                frames.ended(&ended, &self.audience, wanted);
            }
            frames.overdue(&self.audience, wanted, now_ns);
            if now_ns - report_ns > REPORT_PERIOD_NS {
                report_ns = now_ns;
                let shown = scene.stages(now_ns);
                self.audience.to_foxglove(|foxglove| foxglove.stages(&shown));
                self.audience.pages.tell(&TextMessage::Stages { stages: &shown });
                if let Some((drones, sightings)) = scene.swarm(now_ns) {
                    let (drones, sightings) = (&drones[..], &sightings[..]);
                    self.audience.pages.tell(&TextMessage::Swarm { drones, sightings });
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

struct Subscribers {
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

impl Subscribers {
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

    /// Passes new messages to the scene. Tracks come last, because the other messages of their
    /// frame come before them.
    fn receive(
        &mut self,
        scene: &mut PageScene,
        now_ns: i64,
    ) -> Result<Vec<EndedFrame>, PortError> {
        let mut tracks = Vec::new();
        // Tracks are taken first: by then the other messages of the frames that they end have
        // arrived.
        each(&mut self.tracks, |message| tracks.push((message.header, message.items().to_vec())))?;
        each(&mut self.plans, |message| scene.plan(&message.header, message.items()))?;
        each(&mut self.detections, |message| scene.detection(&message.header, message.items()))?;
        each(&mut self.ends, |message| scene.frame_end(&message.header))?;
        each(&mut self.rotations, |message| scene.rotation(&message.header))?;
        each(&mut self.truths, |message| scene.truth(&message.header, message.items()))?;
        each(&mut self.healths, |message| scene.health(&message.header))?;
        each(&mut self.peers, |message| scene.sightings(message.items()))?;
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
